"""How long a lease excludes others: the clocks' bound, and the time after the last grant that elector and settler wait.

Knows: the rates at which clocks may differ. Does not know: grants and echoes (`zsched.core.vote.lease`).
"""

from __future__ import annotations

RHO = 1e-3
"""Bound on the relative difference of two clocks' rates (a crystal is within 1e-4)."""


def hold_s(lease_s: float) -> float:
    """How long after its last grant an elector must refuse others, on its own clock.

    >>> round(hold_s(1.0), 4)
    1.002
    """
    return lease_s * (1 + RHO) / (1 - RHO)
