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


class RunningMean:
    """Mean of a rate since it began; what is older than the time constant hardly counts.

    No sample counts for more than its own time, and nothing is taken as known before the first (the bias correction of
    Kingma and Ba 2015, section 3). So two such means of the same time tell the quotient of what they have counted.
    """

    __slots__ = ("_at", "_sum", "_weight", "tau_s")

    def __init__(self, tau_s: float, now: float) -> None:
        self.tau_s = tau_s
        self._at = now
        self._sum = self._weight = 0.0

    def update(self, rate: float, now: float) -> None:
        """Take in what the rate was since the last time, on the mean; what was before the begin counts nothing."""
        if now <= self._at:
            return
        kept = math.exp(-(now - self._at) / self.tau_s)
        self._sum = kept * self._sum + (1.0 - kept) * rate
        self._weight = kept * self._weight + 1.0 - kept
        self._at = now

    @property
    def value(self) -> float | None:
        """The mean; ``None`` before the first sample."""
        return self._sum / self._weight if self._weight > 0.0 else None
