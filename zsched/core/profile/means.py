"""PROFILE, means over time, for samples at uneven times.

Knows: arithmetic. Does not know: what is smoothed.
"""

from __future__ import annotations

import math

STALE_S = 5.0
"""A radio, a worker or a sampler without a valid reading for this long counts as not measured."""


class Ewma:
    """Exponentially weighted mean with a time constant, for samples at uneven times.

    ``alpha = 1 - exp(-dt / tau)``; the first value is taken as it is. ``tau_s`` of 0 means no smoothing.
    """

    __slots__ = ("_at", "tau_s", "value")

    def __init__(self, tau_s: float) -> None:
        self.tau_s = tau_s
        self.value: float | None = None
        self._at = 0.0

    def update(self, sample: float, now: float) -> float:
        """Take a sample in and return the new mean."""
        if self.value is None or self.tau_s <= 0.0:
            self.value = sample
        else:
            alpha = 1.0 - math.exp(-max(now - self._at, 0.0) / self.tau_s)
            self.value += alpha * (sample - self.value)
        self._at = now
        return self.value

    def look(self, now: float) -> None:
        """Without a sample for `STALE_S` there is no mean."""
        if now - self._at > STALE_S:
            self.value = None

    def share(self) -> Ewma:
        """The mean of a part of this figure; the part was 0 until now."""
        part = Ewma(self.tau_s)
        if self.value is not None:
            part.update(0.0, self._at)
        return part
