"""GATEWAY: CPU time per answer of a worker that tells nothing: what it has spent, over the answers that robots counted.

Knows: sums that only rise. Does not know: machines, what a job needs (`zsched.core.gateway.job_need`).

The owner and the robots tell sums, and this node takes what each has risen by from look to look. So nobody's figures
must begin at the same moment, and a robot that comes, goes or starts again changes nothing. A worker of few large jobs
uses a core or nothing: only many answers tell what one takes.
"""

from __future__ import annotations

import math
from typing import Final

from zsched.core.values.model import NodeId

MEAN_S: Final = 60.0
"""Time constant: what was spent and answered long ago counts less and less."""
LEAST_ANSWERS: Final = 5.0
"""Fewer answers do not tell the CPU time of one."""


class Spending:
    """One worker's, for as long as its task stays where it is."""

    def __init__(self) -> None:
        self._spent_s: float | None = None
        self._counts: dict[NodeId, float] = {}
        self._cpu_s = self._answers = 0.0
        self._at = 0.0

    def absorb(self, spent_s: float, counts: tuple[tuple[NodeId, float], ...], now: float) -> None:
        """Take the newest sums in; a first one, or one that begins anew, is what the next is compared with.

        Args:
            spent_s: CPU seconds, by the owner.
            counts: (robot, answers).
            now: monotonic seconds.
        """
        if self._spent_s is None:
            self._counts = dict(counts)  # of the same moment as the first sum of the owner
        kept = math.exp(-max(now - self._at, 0.0) / MEAN_S)
        self._cpu_s = kept * self._cpu_s + _risen(self._spent_s, spent_s)
        self._answers = kept * self._answers + sum(_risen(self._counts.get(robot), count) for robot, count in counts)
        self._spent_s, self._at = spent_s, now
        self._counts |= dict(counts)

    @property
    def per_answer_s(self) -> float | None:
        """CPU seconds per answer, of all threads; ``None``: there were too few answers."""
        return self._cpu_s / self._answers if self._answers >= LEAST_ANSWERS else None


def _risen(before: float | None, now: float) -> float:
    return 0.0 if before is None else max(now - before, 0.0)
