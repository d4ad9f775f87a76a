"""The mark of a creation of a fleet that has begun: what it writes is its own, and goes if it was broken off.

Knows: the mark, and by which content a file is its own. Does not know: which files there are, in which order they are
written (`zsched.commands.members.belongings`), how certificates are made.

The mark lies beside the fleet file from before anything is written until everything is: in the state folder, which is
the service's, somebody else could say with it what root deletes. It names no place, but what was written.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from zsched.core.values.struct import Struct
from zsched.host.files import read_regular

SUFFIX: Final = ".creating"
"""Behind the name of the fleet file."""
MAX_BYTES: Final = 1 << 20


class Creation(Struct, frozen=True, kw_only=True):
    """One creation; tries after the first one are the same."""

    id: str
    """Of this creation, in the record of the authority that it makes, too."""
    written: frozenset[str] = frozenset()
    """The digest of each file that it writes."""

    def adding(self, contents: Iterable[bytes]) -> Creation:
        """The same, which also writes files of these contents."""
        return Creation(id=self.id, written=self.written | {_digest(one) for one in contents})

    def encoded(self) -> bytes:
        """The mark's content."""
        return (json.dumps({"creation": self.id, "written": sorted(self.written)}) + "\n").encode()

    def has_written(self, path: Path) -> bool:
        """Whether a file holds what this creation writes."""
        try:
            return _digest(read_regular(path, MAX_BYTES)) in self.written
        except OSError:
            return False


def mark_of(config: Path) -> Path:
    """Where the mark of a creation lies."""
    return config.with_name(f"{config.name}{SUFFIX}")


def unfinished(config: Path) -> Creation | None:
    """The creation that was broken off beside this fleet file; ``None``: there is none."""
    try:
        told = json.loads(read_regular(mark_of(config), MAX_BYTES))
        return Creation(id=str(told["creation"]), written=frozenset(map(str, told["written"])))
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _digest(content: bytes) -> str:
    return hashlib.blake2s(content).hexdigest()
