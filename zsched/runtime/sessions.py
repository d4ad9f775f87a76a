"""Remembers which session every worker that somebody else starts has read: one that has changed since is reported.

Such a worker reads `<node>-<task>.zenoh.json5` once, when it starts, and goes on when its node's daemon starts again
with another fleet file: then it does not know the robots that have come, and zsched does not start it again. What the
earlier daemon wrote is kept in the state folder, for this boot of the machine only: no process lives longer.

Knows: sessions' texts, the file that they are kept in. Does not know: when a worker is another one
(`zsched.runtime.crew`).
"""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Final

from zsched.core.values.model import TaskId
from zsched.core.values.struct import Struct
from zsched.host.files import read_regular, write_regular
from zsched.host.workers.comparison import lacking

NAME: Final = "sessions.json"
MAX_BYTES: Final = 4 << 20
BOOT_ID: Final = Path("/proc/sys/kernel/random/boot_id")

_log = logging.getLogger("zsched.daemon")


class _Read(Struct):
    """What one worker has read, and which life of it (0: its lives have no numbers)."""

    text: str
    life: int = 0


class SessionsRead:
    """The sessions of one node's workers that somebody else starts."""

    def __init__(self, folder: Path, boot_id: Path = BOOT_ID) -> None:
        """``folder`` is the state folder; nothing is known of a machine that does not tell its boots apart."""
        self._path = folder / NAME
        self._boot = _first_line(boot_id)
        self._read = self._load()
        self._now: dict[TaskId, str] = {}

    def begin(self, task: TaskId, text: str) -> None:
        """The task's session has been written; a worker that starts from now on reads this one."""
        self._now[task] = text
        self._read.setdefault(task, _Read(text))

    def save(self) -> None:
        """Keep what is known for the next daemon; without it nothing is reported, and nothing else is missing."""
        kept = {task: {"text": one.text, "life": one.life} for task, one in self._read.items() if task in self._now}
        content = json.dumps({"boot": self._boot, "workers": kept})
        try:
            write_regular(self._path, content.encode())
        except OSError as error:
            _log.warning("cannot write %s: %s", self._path, error.strerror)

    def life(self, task: TaskId) -> int:
        """The number of the life that was seen last; 0: none has been told."""
        one = self._read.get(task)
        return 0 if one is None else one.life

    def seen(self, task: TaskId, life: int, *, is_new: bool) -> str:
        """A worker is there, ``is_new``: it has started since `begin`; what it lacks of today's session."""
        now, one = self._now.get(task), self._read.get(task)
        if now is None or one is None:
            return ""
        text = now if is_new else one.text
        if (text, life) != (one.text, one.life):
            one.text, one.life = text, life
            self.save()
        return lacking(text, now)

    def _load(self) -> dict[TaskId, _Read]:
        try:
            found = json.loads(read_regular(self._path, MAX_BYTES))
            if not self._boot or found["boot"] != self._boot:
                return {}
            return {str(task): _Read(str(one["text"]), int(one["life"])) for task, one in found["workers"].items()}
        except (OSError, ValueError, KeyError, TypeError, AttributeError):  # not there, cut, or somebody else's
            return {}


def _first_line(path: Path) -> str:
    try:
        return path.read_text(encoding="ascii").strip()
    except (OSError, ValueError):
        return ""
