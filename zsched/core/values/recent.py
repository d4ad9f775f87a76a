"""The worst of a figure in the last while, in a constant amount of memory.

Knows: two halves of a window. Does not know: what is measured, clocks.
"""

from __future__ import annotations

import math


class RecentWorst:
    """The largest value of the last ``window_s`` seconds, or of up to half as much before."""

    def __init__(self, window_s: float) -> None:
        self._half_s = window_s / 2
        self._began_at = -math.inf
        self._before = self._now = 0.0

    def note(self, value: float, now: float) -> None:
        """A value (>= 0) at ``now`` (monotonic seconds)."""
        self._turn(now)
        self._now = max(self._now, value)

    def worst(self, now: float) -> float:
        """The largest of late; 0 without any.

        >>> recent = RecentWorst(20.0)
        >>> recent.note(3.0, 100.0)
        >>> [recent.worst(now) for now in (100.0, 119.0, 121.0, 130.0)]
        [3.0, 3.0, 3.0, 0.0]
        """
        self._turn(now)
        return max(self._before, self._now)

    def _turn(self, now: float) -> None:
        if now < self._began_at + self._half_s:
            return
        is_next = now < self._began_at + 2 * self._half_s
        self._before, self._now, self._began_at = (self._now if is_next else 0.0), 0.0, now
