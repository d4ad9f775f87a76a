"""A founded fleet of three under a `reliable` stream of 100 Hz: join, renewal, revocation, and another authority.

Real daemons, real certificates, the verbs of an operator. What is measured is printed by `benchmarks.reopened`.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from zsched_lab.fleet.openings import Openings


@pytest.mark.timeout(600)
def test_nothing_is_lost_or_doubled_while_sessions_are_opened_anew(tmp_path: Path) -> None:
    with Openings(tmp_path) as fleet:
        relays: set[int | None] = set()
        for one in fleet.steps():
            assert (one.step, one.lost, one.doubled) == (one.step, 0, 0), one
            relays.add(fleet.relay())
        assert "opens its data session anew" in fleet.hall.log("robot1")
    assert len(relays) == 1, "the robot's relay is the same process all the while"
