"""The newest lines that a worker has printed, kept for operators; written by one thread, read by another.

Knows: how many lines are kept, how many go into one answer. Does not know: processes, askers.
"""

from __future__ import annotations

import threading
from collections import deque
from typing import Final

from zsched.core.values.messages import WorkerLine
from zsched.core.values.struct import Struct
from zsched.host.clock import awake_s

MOST_LINES: Final = 400
"""Per task; the oldest go."""
MOST_CHARS: Final = 400
"""Of one line: with `MOST_LINES` a bound of the daemon's memory, and below what a frame's string may have."""
PER_ANSWER: Final = 100
"""Lines in one answer, so that it fits into a frame in any script."""


class _Line(Struct, frozen=True):
    number: int
    at: float
    text: str


class KeptLines:
    """The output of all processes of one task since the daemon started."""

    def __init__(self) -> None:
        self._lines: deque[_Line] = deque(maxlen=MOST_LINES)
        self._count = 0
        self._lock = threading.Lock()

    def add(self, text: str) -> None:
        """Keep one line; the end of a long one is cut off."""
        shown = text if len(text) <= MOST_CHARS else f"{text[: MOST_CHARS - 4]} ..."
        with self._lock:
            self._count += 1
            self._lines.append(_Line(self._count, awake_s(), shown))

    def behind(self, after: int) -> tuple[tuple[WorkerLine, ...], int]:
        """The oldest lines behind number ``after``, at most `PER_ANSWER`, and the number of the newest there is."""
        now = awake_s()
        with self._lock:
            lines = [line for line in self._lines if line.number > after][:PER_ANSWER]
            newest = self._count
        told = (WorkerLine(number=line.number, age_s=max(now - line.at, 0.0), text=line.text) for line in lines)
        return tuple(told), newest
