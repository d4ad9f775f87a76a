"""How long a lease excludes others."""

from __future__ import annotations

import pytest

from zsched.core.values.lease import RHO, hold_s


@pytest.mark.parametrize("lease_s", [0.2, 2.0, 3600.0])
def test_the_hold_outlasts_a_lease_on_the_two_clocks_that_differ_most(lease_s: float) -> None:
    assert hold_s(lease_s) / (1 + RHO) >= lease_s / (1 - RHO) - 1e-12 * lease_s
