"""Holds back that an input is done until its answers have reached the robots.

Knows: locks, where to report what is done. Does not know: which input waits for what (`zsched.core.hop.held`), how far
a robot is (`zsched.worker.lanes`), what an acknowledgement says (`zsched.hop.acknowledger`).

An acknowledgement overtakes the answers: on a full link it would call an input done whose answer is lost with the
machine that holds it. So an input of class ``reliable`` *owes* the answers of class ``reliable`` that its callback has
put, and counts as processed when all robots for which it waits have them (`KeptLane.settled`). A callback that puts
nothing owes nothing, and so does one whose answers another thread puts.

Where an answer was withheld, since the worker was not the owner, its input waits until it has been processed again.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping

from zsched.core.hop.held import Held as HeldOf
from zsched.core.hop.held import HeldInputs
from zsched.core.hop.receiver import SourceName
from zsched.hop.acknowledger import Acknowledger
from zsched.worker.lanes import KeptLane

Held = HeldOf[KeptLane]


class Debts:
    """The inputs whose answers are on their way. Its lock is held around lanes' locks, and around nothing else."""

    def __init__(self, acks: Acknowledger) -> None:
        """``acks`` hears what is processed, in the order of each source."""
        self._acks = acks
        self._lock = threading.Lock()
        self._held = HeldInputs[KeptLane]()

    @property
    def is_waiting(self) -> bool:
        """Whether an input is held back."""
        return bool(self._held.lines)

    def processed(
        self, name: SourceName, number: int, size: int, owed: Mapping[KeptLane, int], *, is_unanswered: bool = False
    ) -> Held | None:
        """A callback has returned (dispatch thread); ``owed`` are the answers that it has put.

        ``is_unanswered``: an answer was withheld; what is given back is for `answered`.
        """
        with self._lock:
            held = self._held.hold(name, number, size, owed, is_unanswered=is_unanswered)
        if held is None:
            self._acks.processed(name, number, size)
        _wake(owed)
        return held

    def answered(self, held: Held, owed: Mapping[KeptLane, int], now: float) -> None:
        """An input whose answer was withheld has been processed again, or was given up."""
        with self._lock:
            held.unanswered -= 1
            held.owe(owed)
        _wake(owed)
        if not owed:
            self.settle(now)

    def forget(self, name: SourceName) -> None:
        """Nobody waits for this source's inputs any more."""
        with self._lock:
            self._held.forget(name)

    def settle(self, now: float) -> None:
        """Tell of every input whose answers are where they should be (any thread; the keeper's when it has heard)."""
        with self._lock:
            done = self._held.settle(now)
        for one in done:
            self._acks.processed(one.name, one.number, one.size)


def _wake(lanes: Iterable[KeptLane]) -> None:
    for lane in lanes:
        if not lane.wake.is_set():
            lane.wake.set()  # the keeper may have been at rest since the answer was put
