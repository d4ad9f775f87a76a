"""What a new generation begins with: agreed everywhere, and leased only where nobody can be at work without a lease."""

from __future__ import annotations

import pytest

from support.allocations import allocation_of
from support.ballots import ballot_of
from support.fleets import fleet_of, task_of
from zsched.core.values.model import NO_BALLOT, Acceptance, Allocation, RegisterState
from zsched.core.vote.belief import GENERATION_STEP
from zsched.core.vote.generations import first_registers

FLEET = fleet_of(
    task_of("guard", ("robot1",), exclusive=True),
    task_of(candidates=("robot1",)),
    of=("robot1",),
    electors=("robot1",),
)


def value(revision: int, owner: str | None = "robot1", *, leased: bool = False) -> Allocation:
    return allocation_of(revision, owner, task="guard", leased=leased)


def state(learnt: Allocation | None = None, accepted: Allocation | None = None) -> RegisterState:
    ballot = ballot_of(5)
    held = None if accepted is None else Acceptance(ballot=ballot, value=accepted)
    return RegisterState(task="guard", promised=ballot, accepted=held, learnt=learnt)


def test_every_task_begins_without_an_owner_learnt_and_accepted_at_the_generation_s_first_revision() -> None:
    registers = first_registers(FLEET, 2, ())
    assert [one.task for one in registers] == ["guard", "merge"]
    for one in registers:
        assert one.learnt is not None
        assert (one.learnt.revision, one.learnt.epoch, one.learnt.owner) == (2 * GENERATION_STEP,) * 2 + (None,)
        assert one.accepted == Acceptance(ballot=NO_BALLOT, value=one.learnt)
        assert one.promised == NO_BALLOT


def test_where_a_generation_begins_never_changes() -> None:
    """It is in every state file: another number would be another generation's."""
    assert GENERATION_STEP == 4_294_967_296


def test_generation_0_begins_blank() -> None:
    assert first_registers(FLEET, 0, (state(value(3)),)) == ()
    assert len(first_registers(FLEET, 1, ())) == 2


@pytest.mark.parametrize(
    ("before", "is_leased"),
    [
        ((), True),
        ((state(),), True),
        ((state(value(3, leased=True)),), True),
        ((state(value(1)),), False),
        ((state(value(3)),), False),
        ((state(accepted=value(3)),), False),
        ((state(value(3, leased=True), value(4)),), False),  # the newest counts, learnt or accepted
        ((state(value(4, leased=True), value(3)),), True),
        ((state(value(4), value(3, leased=True)),), False),
        ((state(value(0, None)),), True),  # nobody has ever owned it
        ((state(value(3, None)),), False),  # somebody has: it was taken from them
    ],
)
def test_an_exclusive_task_is_leased_unless_somebody_may_be_at_it_without_a_lease(
    before: tuple[RegisterState, ...], is_leased: bool
) -> None:
    guard, merge = first_registers(FLEET, 1, before)
    assert guard.learnt is not None
    assert merge.learnt is not None
    assert guard.learnt.leased is is_leased
    assert not merge.learnt.leased, "its file does not say that it is exclusive"
