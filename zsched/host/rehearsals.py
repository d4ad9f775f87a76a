"""The rehearsals that this node has kept: one JSON file each in the state folder, the newest `MAX_KEPT`.

Knows: files, how many. Does not know: what a rehearsal is.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

from zsched.core.values.errors import AdapterError
from zsched.core.values.model import check_name
from zsched.core.values.rehearsal import MAX_KEPT_BYTES
from zsched.host.files import read_regular
from zsched.host.state_file import replace_synced

FOLDER_NAME: Final = "rehearsals"
NEW_NAME: Final = "new"
SUFFIX: Final = ".json"
MAX_KEPT: Final = 20


class RehearsalStore:
    """The rehearsals in ``folder``/rehearsals. Their names sort by age: they begin with the time."""

    def __init__(self, folder: Path) -> None:
        """Name the place; touches nothing."""
        self.folder = folder / FOLDER_NAME

    def save(self, name: str, body: str) -> None:
        """Keep one, and delete those that are too many.

        Raises:
            AdapterError: the disk is full, read-only or gone.
        """
        check_name("rehearsal", name)
        try:
            self.folder.mkdir(mode=0o700, exist_ok=True)
            replace_synced(self.folder / f"{name}{SUFFIX}", self.folder / NEW_NAME, body.encode())
            for old in self.names()[:-MAX_KEPT]:
                (self.folder / f"{old}{SUFFIX}").unlink(missing_ok=True)
        except OSError as error:
            raise AdapterError(
                f"cannot keep the rehearsal in {self.folder}: {error.strerror}; free or remount the disk"
            ) from error

    def names(self) -> tuple[str, ...]:
        """Of those that are kept, the newest last; none where the folder cannot be read."""
        try:
            return tuple(sorted(file.stem for file in self.folder.iterdir() if file.suffix == SUFFIX))
        except OSError:
            return ()

    def load(self, name: str) -> str:
        """One of them; empty: it is not there, or cannot be read."""
        check_name("rehearsal", name)
        try:
            return read_regular(self.folder / f"{name}{SUFFIX}", MAX_KEPT_BYTES).decode("utf-8", "replace")
        except OSError:
            return ""
