"""A machine that disappointed for no visible cause: for how long it is avoided before it is tried again.

Knows: times. Does not know: of what it is a doubt (`zsched.core.scheduler.rested`).

What has a cause that is seen ends with it. What has none would be believed for good, or be forgotten and found again
without end. So it counts for a minute, and twice as long each time that a trial fails (exponential backoff).
"""

from __future__ import annotations

import math
from typing import Final

from zsched.core.values.struct import Struct

DOUBT_S: Final = 60.0
"""It counts for so long, the first time."""
LONGEST_DOUBT_S: Final = 3600.0
TRUST_S: Final = 600.0
"""A machine that keeps its promises for so long is doubted for half as long the next time."""
TOLD_S: Final = 5.0
"""Two figures of one owner are further apart only where it had no figures, or the task was elsewhere."""


class Doubt(Struct):
    """For how long something counts that nothing explains.

    >>> doubt = Doubt(seen_at=0.0)
    >>> [doubt.is_over(59.9), doubt.is_over(60.0)]
    [False, True]
    >>> doubt.see(60.0)
    >>> [doubt.is_over(179.9), doubt.is_over(180.0)]
    [False, True]
    """

    seen_at: float
    for_s: float = DOUBT_S
    kept_s: float = 0.0
    """For how long the machine has kept what it promised since then, with the task on it."""
    kept_at: float = -math.inf

    def is_over(self, now: float) -> bool:
        """Whether the machine may be tried again."""
        return now >= self.seen_at + self.for_s

    def see(self, now: float) -> None:
        """It has happened again: once the machine was tried again, twice as long counts the next time."""
        if self.is_over(now):
            halved = self.for_s * 0.5 ** (self.kept_s // TRUST_S)
            self.for_s = min(max(2 * halved, DOUBT_S), LONGEST_DOUBT_S)
        self.seen_at, self.kept_s, self.kept_at = now, 0.0, now

    def keep(self, now: float) -> None:
        """The machine has kept what it promised; a time of which nobody has told anything proves nothing."""
        if now - self.kept_at <= TOLD_S:
            self.kept_s += now - self.kept_at
        self.kept_at = now
