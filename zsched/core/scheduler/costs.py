"""SCHEDULER, what a move costs: the outputs that are missing around it, in seconds of the task's usual work.

Knows: what this robot's relay has counted of one task's streams. Does not know: stickiness, why a move was made.

A relay reports once a second, so a silence of a few hundred milliseconds has no time of its own. What is *missing* has:
over the window around a move, the usual rate times its length, less what came. It
counts the gap and the lost work alike.
Only planned moves are measured (an escape's cost is the fault's), and only while the inputs flow as usual.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from zsched.core.values.model import TaskId
from zsched.core.values.plan import StreamCount

WINDOW_S = 4.0
"""So long after a move its outputs are counted: a slow handover has ended, and a new lead has not come yet."""
USUAL = 0.1
"""Share of a new report in the usual rate: the last ten or so count."""
NEWEST = 0.3
"""Share of a new move in the cost of a move."""


@dataclass(frozen=True, slots=True)
class _Counted:
    taken: int
    given: int
    at: float


@dataclass(slots=True)
class MoveCost:
    """What one task's planned moves have cost at this robot."""

    task: TaskId
    seconds: float = 0.0
    """Of the task's usual work, an exponential mean over the moves; 0 before the first."""
    moves: int = 0
    _newest: _Counted | None = None
    _usual: tuple[float, float] | None = None
    """(inputs, outputs) per second between moves."""
    _before: _Counted | None = None
    """The newest report before the move that is being measured."""
    _until: float = 0.0

    def on_moved(self, *, is_planned: bool, now: float) -> None:
        """The owner has changed; a second move within the window spoils both."""
        is_free = self._before is None
        self._before = self._newest if is_planned and is_free else None
        self._until = now + WINDOW_S

    def absorb(self, counts: Iterable[StreamCount], now: float) -> None:
        """Take the relay's newest counters in."""
        new = self._sum(counts, now)
        old, self._newest = self._newest, new
        if old is None or new.taken < old.taken or new.given < old.given:
            self._before = self._usual = None  # another relay: it counts from 0
            return
        if now < self._until:
            return
        if self._before is not None:
            self._measure(self._before, new)
            self._before = None
        elif now > old.at:
            self._learn((new.taken - old.taken) / (now - old.at), (new.given - old.given) / (now - old.at))

    def _sum(self, counts: Iterable[StreamCount], now: float) -> _Counted:
        taken = given = 0
        for count in counts:
            taken += count.messages if count.stream.startswith(f"{self.task}/in/") else 0
            given += count.messages if count.stream.startswith(f"{self.task}/out/") else 0
        return _Counted(taken, given, now)

    def _learn(self, taken_hz: float, given_hz: float) -> None:
        before = self._usual or (taken_hz, given_hz)
        self._usual = (before[0] + USUAL * (taken_hz - before[0]), before[1] + USUAL * (given_hz - before[1]))

    def _measure(self, before: _Counted, after: _Counted) -> None:
        if self._usual is None:
            return  # nothing to compare with
        length_s = after.at - before.at
        taken_hz, given_hz = self._usual
        if given_hz <= 0.0 or after.taken - before.taken < 0.5 * taken_hz * length_s:
            return  # no outputs to miss, or nothing was asked of the task
        missing_s = max(length_s - (after.given - before.given) / given_hz, 0.0)
        self.seconds += (NEWEST if self.moves else 1.0) * (missing_s - self.seconds)
        self.moves += 1
