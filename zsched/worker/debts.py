"""Holds back that an input is done until its answers have reached the robots.

Knows: which answers each input was given in its callback, and in which order inputs are done. Does not know: how far a
robot is with them (`zsched.worker.lanes`), what an acknowledgement says (`zsched.hop.acknowledger`).

An acknowledgement overtakes the answers: on a full link it would call an input done whose answer is lost with the
machine that holds it. So an input of class ``reliable`` *owes* the answers of class ``reliable`` that its callback has
put, and counts as processed when everybody has them for whom it waits (`KeptLane.settled`). What is processed is told
by one number per source, so whatever comes behind such an input waits with it. A callback that puts nothing owes
nothing, and so does one whose answers another thread puts.

Where an answer was withheld, since the worker was not the owner, its input waits until it has been processed again.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from zsched.hop.acknowledger import MAX_SOURCES, Acknowledger, SourceName
from zsched.worker.lanes import KeptLane

MAX_HELD: Final = 4096
"""Inputs of a source that are held one by one (a relay sends at most 2048 ahead); further ones share the last place."""


@dataclass(slots=True, eq=False)
class Held:
    """Inputs of a source that are held; ``owed``: {lane: what lies below this number must be there}."""

    number: int = 0
    """The newest of them."""
    size: int = 0
    owed: dict[KeptLane, int] = field(default_factory=dict)
    unanswered: int = 0
    """So many of them are to be processed again: what they were answered was withheld."""


class Debts:
    """The inputs whose answers are on their way. Its lock is held around lanes' locks, and around nothing else."""

    def __init__(self, acks: Acknowledger) -> None:
        """``acks`` is told what is processed, in the order of each source."""
        self._acks = acks
        self._lock = threading.Lock()
        self._held: dict[SourceName, deque[Held]] = {}

    @property
    def is_waiting(self) -> bool:
        """Whether an input is held back."""
        return bool(self._held)

    def processed(
        self, name: SourceName, number: int, size: int, owed: Mapping[KeptLane, int], *, is_unanswered: bool = False
    ) -> Held | None:
        """A callback has returned (dispatch thread); ``owed`` are the answers that it has put.

        ``is_unanswered``: an answer was withheld; what is given back is for `answered`.
        """
        with self._lock:
            line = self._held.get(name)
            if owed or is_unanswered or line is not None:
                held = self._place(name, line, is_own=bool(owed) or is_unanswered)
                held.number, held.size = number, held.size + size
                held.unanswered += is_unanswered
                _owe(held, owed)
                return held
        self._acks.processed(name, number, size)
        return None

    def answered(self, held: Held, owed: Mapping[KeptLane, int], now: float) -> None:
        """An input whose answer was withheld has been processed again, or was given up."""
        with self._lock:
            held.unanswered -= 1
            _owe(held, owed)
        if not owed:
            self.settle(now)

    def forget(self, name: SourceName) -> None:
        """Nobody waits for this source's inputs any more."""
        with self._lock:
            self._held.pop(name, None)

    def _place(self, name: SourceName, line: deque[Held] | None, *, is_own: bool) -> Held:
        """A place of its own at the end of a source's line, or the last one."""
        if line is None:
            if len(self._held) >= MAX_SOURCES:
                self._held.pop(next(iter(self._held)))  # its next sample tells of them
            line = self._held[name] = deque()
        if not line or (is_own and len(line) < MAX_HELD):
            line.append(Held())
        return line[-1]

    def settle(self, now: float) -> None:
        """Tell of every input whose answers are where they should be (any thread; the keeper's when it has heard)."""
        lows: dict[tuple[KeptLane, str], int] = {}
        done: list[tuple[SourceName, Held]] = []
        with self._lock:
            for name, line in tuple(self._held.items()):
                while line and _is_settled(line[0], name[1], lows, now):
                    done.append((name, line.popleft()))
                if not line:
                    del self._held[name]
        for name, held in done:
            self._acks.processed(name, held.number, held.size)


def _owe(held: Held, owed: Mapping[KeptLane, int]) -> None:
    for lane, number in owed.items():
        held.owed[lane] = max(number, held.owed.get(lane, 0))
        if not lane.wake.is_set():
            lane.wake.set()  # the keeper may have been at rest since the answer was put


def _is_settled(held: Held, relay: str, lows: dict[tuple[KeptLane, str], int], now: float) -> bool:
    if held.unanswered:
        return False
    for lane, number in held.owed.items():
        low = lows.get((lane, relay))
        if low is None:
            low = lows[lane, relay] = lane.settled(relay, now)
        if low < number:
            return False
    return True
