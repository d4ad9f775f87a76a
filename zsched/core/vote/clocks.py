"""Membership's question about time: does a second here take as long as elsewhere? Leases hang on it.

Knows: how far two clocks of one machine may run apart before one of them is wrong. Does not know: clocks
(`zsched.clock` reads and compares them), which of the two is wrong, what follows for leases (`zsched.core.vote.lease`).

One is slewed by the machine's time service, the other is not. When they differ by more than the bound that leases
allow for, or move apart at once (a suspend; its length is known to a second only on some machines), no time that was
measured here can be trusted by others. A clock that stands still together with all others of its machine is not seen.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from zsched.core.events import ClockCompared
from zsched.core.vote.lease import RHO

JUMP_S = 1e-3
"""What two clocks may move apart at once, beyond their rates; reading them both takes a fiftieth of it."""
DOUBT_S = 2.0
"""So long after the last bad comparison the clock is in doubt."""


def is_bad(event: ClockCompared) -> bool:
    """Whether a comparison says that one of the clocks is wrong."""
    return abs(event.error_ratio) > RHO or abs(event.jump_s) > JUMP_S + RHO * event.since_s


@dataclass(slots=True)
class ClockDoubt:
    """Whether this machine's clock may be believed."""

    complaint: str | None = None
    """How status says that it may not."""
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
    """What the operator reads."""
    if abs(event.error_ratio) > RHO:
        found = f"this machine's clock is slewed by {event.error_ratio:+.2%}, leases allow for {RHO:.2%}"
    else:
        found = f"this machine's clock has jumped by {event.jump_s:+.3f} s"
    return f"{found}: it takes no part in exclusive tasks"
