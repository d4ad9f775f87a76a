"""What every node's status says of a calm fleet is held against the truth, at the end of every schedule."""

from __future__ import annotations

from dataclasses import replace

import pytest

from zsched.core.node import status
from zsched_lab.sim.faults import play
from zsched_lab.sim.swarm import plan

WITHOUT_A_STATE = 9000028
"""A seed at whose end an elector has no state, and enough others have theirs."""


def test_a_schedule_ends_with_every_status_held_against_the_truth() -> None:
    assert play(plan(WITHOUT_A_STATE)).violation == ""


def test_a_quorum_that_counts_an_elector_without_its_state_is_a_violation(monkeypatch: pytest.MonkeyPatch) -> None:
    """That is what a fleet said with two electors of three without a state: quorum 3 of 3, ok."""
    monkeypatch.setattr(status, "_has_lost_state", lambda *_: False)
    violation = play(plan(WITHOUT_A_STATE)).violation
    assert violation.startswith("status is wrong")
    assert "says that 3 electors can answer (ok: True), and 2 can" in violation


def test_a_status_that_names_no_owner_is_a_violation(monkeypatch: pytest.MonkeyPatch) -> None:
    built = status._task_status
    monkeypatch.setattr(status, "_task_status", lambda *given: replace(built(*given), owner=None))
    assert "says that merge is at None (alive)" in play(plan(WITHOUT_A_STATE)).violation
