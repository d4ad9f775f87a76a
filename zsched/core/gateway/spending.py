"""GATEWAY: CPU time per answer of a worker that tells nothing: what it has spent, over the answers that robots counted.

Knows: sums that only rise. Does not know: machines, what a job needs (`zsched.core.gateway.job_need`).

The owner and the robots tell sums, and this node takes what each has risen by. So nobody's figures must begin at the
same moment, and a robot that comes, goes or starts again changes nothing. A worker of few large jobs uses a core or
nothing: only many answers tell what one takes.

Robots count once a second, and their profiles come when they come, so a sum of answers is up to some seconds older than
the owner's. That is as old at each moment at which one robot's count has just risen, and so these are the moments from
which and to which both sums are taken.
"""

from __future__ import annotations

import math
from typing import Final

from zsched.core.values.model import NodeId

MEAN_S: Final = 60.0
"""Time constant: what was spent and answered long ago counts less and less."""
LEAST_ANSWERS: Final = 5.0
"""Fewer answers do not tell the CPU time of one."""


SILENT_S: Final = 3.0
"""A robot that has told of no more answers for so long, and for so many of its gaps, is the clock no more."""
SILENT_GAPS: Final = 3.0


class Spending:
    """One worker's, for as long as its task stays where it is."""

    def __init__(self) -> None:
        self._spent_s: float | None = None
        self._counts: dict[NodeId, float] | None = None
        """Both by the last look that counted; ``None``: none has."""
        self._cpu_s = self._answers = self._for_s = 0.0
        self._clock: NodeId | None = None
        """The robot whose rises are waited for."""
        self._at = self._gap_s = 0.0
        """When a look last counted, and how long after the one before."""

    def absorb(self, spent_s: float, counts: tuple[tuple[NodeId, float], ...], now: float) -> None:
        """Take the newest sums in; a first one, or one that begins anew, is what the next is compared with.

        Args:
            spent_s: CPU seconds, by the owner.
            counts: (robot, answers).
            now: monotonic seconds.
        """
        if self._counts is None:
            self._counts, self._at = dict(counts), now
            return
        risen = [robot for robot, count in counts if count != self._counts.setdefault(robot, count)]
        longest_s = max(SILENT_S, min(SILENT_GAPS * self._gap_s, MEAN_S))
        is_silent = now - self._at > longest_s
        if not risen or not (self._clock is None or self._clock in risen or is_silent):
            return
        if self._clock not in risen:
            self._clock = risen[0]
        self._gap_s, self._at = now - self._at, now
        if self._spent_s is not None:
            kept = math.exp(-self._gap_s / MEAN_S)
            self._cpu_s = kept * self._cpu_s + _risen(self._spent_s, spent_s)
            answers = sum(_risen(self._counts.get(robot), count) for robot, count in counts)
            self._answers = kept * self._answers + answers
            self._for_s = kept * self._for_s + min(self._gap_s, longest_s)  # a pause is no rate
        self._spent_s = spent_s
        self._counts |= dict(counts)

    @property
    def per_answer_s(self) -> float | None:
        """CPU seconds per answer, of all threads; ``None``: there were too few answers."""
        return self._cpu_s / self._answers if self._answers >= LEAST_ANSWERS else None

    @property
    def answers_hz(self) -> float | None:
        """How often answers came, on the mean; ``None``: there were too few."""
        return self._answers / self._for_s if self._answers >= LEAST_ANSWERS else None


def _risen(before: float | None, now: float) -> float:
    return 0.0 if before is None else max(now - before, 0.0)
