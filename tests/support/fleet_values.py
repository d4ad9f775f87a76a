"""Fleet values, as short as a test wants them. Knows: `zsched.core.values.electorate`."""

from __future__ import annotations

from typing import Any

from zsched.core.values.electorate import Elector, FleetValue


def fleet_value_of(revision: int = 1, *electors: Elector, number: int = 1, **more: Any) -> FleetValue:
    """The settled value of fleet ``hall`` at a revision, with leases of 1 s; by default robot1 elects alone."""
    fields = {"fleet": "hall", "generation_id": "ab" * 16, "settled": True, "lease_s": 1.0, "guard_lease_s": 1.0}
    chosen = electors or (Elector(name="robot1", disk="01", joining=1),)
    return FleetValue(revision=revision, number=number, electors=chosen, **{**fields, **more})
