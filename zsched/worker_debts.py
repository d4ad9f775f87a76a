"""Holds back that an input is done until its answers have reached the robots.

Knows: which answers each input was given in its callback, and in which order inputs are done. Does not know: how far a
robot is with them (`zsched.worker_lanes`), what an acknowledgement says (`zsched.hop_acks`).

An acknowledgement overtakes the answers: on a full link it would call an input done whose answer is lost with the
machine that holds it. So an input of class ``reliable`` *owes* the answers of class ``reliable`` that its callback has
put, and counts as processed when everybody has them for whom it waits (`KeptLane.settled`). What is processed is told
by one number per source, so whatever comes behind such an input waits with it. A callback that puts nothing owes
nothing, and so does one whose answers another thread puts.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from zsched.hop_acks import MAX_SOURCES, Acknowledger, SourceName
from zsched.worker_lanes import KeptLane

MAX_HELD: Final = 4096
"""Inputs of a source that are held one by one (a relay sends at most 2048 ahead); further ones share the last place."""


@dataclass(slots=True, eq=False)
class _Held:
    """An input that is done but for its answers' way; ``owed``: {lane: what lies below this number must be there}."""

    number: int
    size: int
    owed: dict[KeptLane, int]


class Debts:
    """The inputs whose answers are on their way. Its lock is held around lanes' locks, and around nothing else."""

    def __init__(self, acks: Acknowledger) -> None:
        """``acks`` is told what is processed, in the order of each source."""
        self._acks = acks
        self._lock = threading.Lock()
        self._held: dict[SourceName, deque[_Held]] = {}

    @property
    def is_waiting(self) -> bool:
        """Whether an input is held back."""
        return bool(self._held)

    def processed(self, name: SourceName, number: int, size: int, owed: Mapping[KeptLane, int]) -> None:
        """A callback has returned (dispatch thread); ``owed`` are the answers that it has put."""
        with self._lock:
            line = self._held.get(name)
            is_held = bool(owed) or line is not None
            if is_held:
                self._hold(name, line, _Held(number, size, dict(owed)))
        if not is_held:
            self._acks.processed(name, number, size)

    def _hold(self, name: SourceName, line: deque[_Held] | None, held: _Held) -> None:
        for lane in held.owed:
            if not lane.wake.is_set():
                lane.wake.set()  # the keeper may have been at rest since the answers were put
        if line is None:
            if len(self._held) >= MAX_SOURCES:
                self._held.pop(next(iter(self._held)))  # its next sample tells of them
            line = self._held[name] = deque()
        if line and (not held.owed or len(line) >= MAX_HELD):
            last = line[-1]
            last.number, last.size = held.number, last.size + held.size
            for lane, number in held.owed.items():
                last.owed[lane] = max(number, last.owed.get(lane, 0))
        else:
            line.append(held)

    def settle(self, now: float) -> None:
        """Tell of every input whose answers are where they should be (the keeper's thread, after what it has heard)."""
        lows: dict[tuple[KeptLane, str], int] = {}
        done: list[tuple[SourceName, _Held]] = []
        with self._lock:
            for name, line in tuple(self._held.items()):
                while line and _is_settled(line[0], name[1], lows, now):
                    done.append((name, line.popleft()))
                if not line:
                    del self._held[name]
        for name, held in done:
            self._acks.processed(name, held.number, held.size)


def _is_settled(held: _Held, relay: str, lows: dict[tuple[KeptLane, str], int], now: float) -> bool:
    for lane, number in held.owed.items():
        low = lows.get((lane, relay))
        if low is None:
            low = lows[lane, relay] = lane.settled(relay, now)
        if low < number:
            return False
    return True
