"""Something that has to be there and is away again and again: when it has been away for too long, in all.

Knows: times. Does not know: what is away (`zsched.core.scheduler.judge`, `zsched.core.scheduler.unseen`,
`zsched.core.executor.tenure`).

What is there now and then, and never for long, would have its whole time anew for each absence, and be waited for
without end. So absences add up.
"""

from __future__ import annotations

from typing import Final

from zsched.core.values.struct import Struct

FORGIVEN_RATIO: Final = 0.3
"""Time in which it is there makes up so much of the time in which it was away: what is there for 77 % of it is kept."""


class Absences(Struct):
    """How long something has been away.

    Each absence counts for ``limit_s`` at most, and what is there for a second is forgiven a part of one. What is more
    than ``limit_s`` in all counts to the next absence: who is away once or twice for a good reason has the whole time.

    >>> relay = Absences()
    >>> [relay.look(is_away, at, limit_s=10.0) for is_away, at in ((True, 0.0), (True, 9.0), (False, 9.0))]
    [0.0, 9.0, 0.0]
    >>> [relay.look(is_away, at, limit_s=10.0) for is_away, at in ((True, 19.0), (False, 27.0), (True, 37.0))]
    [0.0, 0.0, 1.0]
    """

    forgiven_ratio: float = FORGIVEN_RATIO
    since: float | None = None
    """Since when it is away; earlier by what former absences count. ``None``: it is there."""
    total_s: float = 0.0
    """What of the absences before this one, or before it came back last, is not forgiven yet."""
    back_at: float | None = None
    """When it came back last; ``None``: it has always been there, or is away."""
    looked_at: float | None = None
    """When last."""

    def look(self, is_away: bool, now: float, limit_s: float) -> float:
        """For how many seconds it has been away, with what former absences count; 0 while it is there."""
        self.looked_at = now
        if not is_away:
            if self.since is not None:
                away_s = now - self.since - self.held_s(limit_s)
                self.total_s = min(self.total_s + min(away_s, limit_s), 2.0 * limit_s)
                self.since, self.back_at = None, now
            return 0.0
        if self.since is None:
            self.total_s, self.back_at = self._left_s(now), None
            self.since = now - self.held_s(limit_s)
        return now - self.since

    def skip(self, now: float) -> None:
        """Nobody knows whether it has been there since the last look: that time counts as neither."""
        passed_s = 0.0 if self.looked_at is None else now - self.looked_at
        self.since = None if self.since is None else self.since + passed_s
        self.back_at = None if self.back_at is None else self.back_at + passed_s
        self.looked_at = now

    def held_s(self, limit_s: float) -> float:
        """What former absences count, in seconds: up to ``limit_s``."""
        return max(self.total_s - limit_s, 0.0)

    def is_held(self, now: float, limit_s: float) -> bool:
        """Whether former absences count to the next one, if that begins now."""
        return self._left_s(now) > limit_s

    def _left_s(self, now: float) -> float:
        forgiven_s = 0.0 if self.back_at is None else self.forgiven_ratio * (now - self.back_at)
        return max(self.total_s - forgiven_s, 0.0)
