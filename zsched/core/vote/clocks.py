"""VOTE, this machine's clock: does a second last as long here as elsewhere? Leases depend on it.

Knows: how far two clocks of one machine may drift apart before one of them is wrong. Does not know: clocks
(`zsched.host.clock` reads and compares them), which of the two is wrong, what follows for leases.

The machine's time service slews one clock and not the other. When their rates differ by more than the bound of the
leases, or when they jump apart (a suspend, whose length some machines know only to a second), other nodes cannot trust
a time that was measured here: the clock is *in doubt*. A clock that stands still together with all others of its
machine is not noticed.
"""

from __future__ import annotations

import math

from zsched.core.values.events import ClockCompared
from zsched.core.values.lease import RHO
from zsched.core.values.struct import Struct

JUMP_S = 1e-3
"""Two clocks may move apart by this at once, beyond their rates; reading both takes a fiftieth of it."""
DOUBT_S = 2.0
"""The clock is in doubt for this long after the last bad comparison."""


def is_bad(event: ClockCompared) -> bool:
    """Whether a comparison says that one of the clocks is wrong."""
    return abs(event.error_ratio) > RHO or abs(event.jump_s) > JUMP_S + RHO * event.since_s


class ClockDoubt(Struct):
    """Decides whether this machine's clock is in doubt."""

    complaint: str | None = None
    """The status's problem while it is in doubt."""
    _until: float = -math.inf

    def absorb(self, event: ClockCompared, now: float) -> bool:
        """Take a comparison in; whether the clock is in doubt."""
        if is_bad(event):
            self._until = now + DOUBT_S
            self.complaint = _complaint(event)
        elif now >= self._until:
            self.complaint = None
        return self.complaint is not None


def _complaint(event: ClockCompared) -> str:
    """The problem for the status."""
    if abs(event.error_ratio) > RHO:
        found = f"this machine's clock is slewed by {event.error_ratio:+.2%}, leases allow for {RHO:.2%}"
    else:
        found = f"this machine's clock has jumped by {event.jump_s:+.3f} s"
    return f"{found}: it takes no part in exclusive tasks"
