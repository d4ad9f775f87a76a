"""Belief: which values could be true, and whose word is enough for one."""

from __future__ import annotations

from dataclasses import replace
from random import Random

import pytest

from support.allocations import allocation_of
from support.ballots import ballot_of
from support.fleets import fleet_of, task_of
from zsched.core.register.register import MAX_REVISION
from zsched.core.register.task_register import TaskRegister
from zsched.core.values.fleet import Timing
from zsched.core.values.messages import Learnt
from zsched.core.values.model import Acceptance, Allocation, RegisterState
from zsched.core.vote.belief import GENERATION_STEP, MAX_AHEAD, MAX_GENERATION, is_fit, is_proven

TASK = task_of(candidates=("edge1", "robot2"))
NAMES = ("edge1", "robot1", "robot2")
FLEET = fleet_of(TASK, of=NAMES, electors=("robot1", "robot2"))
STRAY = MAX_AHEAD * 3


def register(learnt: Allocation | None = None, accepted: Allocation | None = None) -> TaskRegister:
    ballot = ballot_of(5)
    held = None if accepted is None else Acceptance(ballot=ballot, value=accepted)
    return TaskRegister(
        me="robot1",
        incarnation=1,
        electors=FLEET.electors,
        electorate="e",
        is_elector=True,
        initial=TASK.first_value(0),
        state=RegisterState(task="merge", promised=ballot, accepted=held, learnt=learnt),
        clocks=lambda: Timing(ballot_s=1.0, stagger_s=0.1),
        rng=Random(1),
    )


@pytest.mark.parametrize(
    ("new", "fits"),
    [
        (allocation_of(11), True),
        (allocation_of(11, None), True),
        (allocation_of(11, "robot1"), True),
        (allocation_of(11, "robot9"), False),
        (allocation_of(11, epoch=11), True),
        (allocation_of(11, epoch=12), False),
        (allocation_of(10 + MAX_AHEAD), True),
        (allocation_of(10 + MAX_AHEAD + 1), False),
    ],
)
def test_a_value_names_a_node_of_the_fleet_and_is_not_absurdly_far_ahead(new: Allocation, fits: bool) -> None:
    assert is_fit(FLEET, new, register(learnt=allocation_of(10))) is fits


def test_ahead_is_counted_from_whatever_is_newest() -> None:
    assert is_fit(FLEET, allocation_of(20 + MAX_AHEAD), register(learnt=allocation_of(10), accepted=allocation_of(20)))
    assert is_fit(FLEET, allocation_of(20 + MAX_AHEAD), register(learnt=allocation_of(20), accepted=allocation_of(10)))
    assert is_fit(FLEET, allocation_of(30 + MAX_AHEAD), register(learnt=allocation_of(20)), start=30)
    assert not is_fit(FLEET, allocation_of(31 + MAX_AHEAD), register(learnt=allocation_of(20)), start=30)
    assert is_fit(FLEET, allocation_of(MAX_AHEAD), register())
    assert not is_fit(FLEET, allocation_of(MAX_AHEAD + 1), register())


def test_what_is_known_here_already_fits_whatever_it_is() -> None:
    """A fleet file that names other nodes must not make a node refuse what it has agreed to."""
    old = allocation_of(7, "robot9")
    assert is_fit(FLEET, old, register(learnt=old))
    assert is_fit(FLEET, old, register(learnt=allocation_of(8), accepted=old))
    assert not is_fit(FLEET, old, register(learnt=allocation_of(8)))


def test_an_owner_that_has_left_the_fleet_stays_it_until_the_task_moves() -> None:
    """It was pinned there (hard), and no order was agreed any more: neither its unpin nor new weights."""
    old = allocation_of(7, "robot9")
    for known in (register(learnt=old), register(learnt=allocation_of(6), accepted=old)):
        assert is_fit(FLEET, allocation_of(8, "robot9"), known)
        assert not is_fit(FLEET, allocation_of(8, "robot8"), known)


@pytest.mark.parametrize(
    ("by", "new", "accepted", "is_enough"),
    [
        ("robot2", allocation_of(3), None, True),
        ("edge1", allocation_of(3), None, False),
        ("edge1", allocation_of(3), allocation_of(3), True),
        ("edge1", allocation_of(3), allocation_of(4), False),
        ("robot2", allocation_of(STRAY), None, False),
        ("robot2", allocation_of(STRAY), allocation_of(STRAY), True),
    ],
)
def test_an_elector_s_answer_is_enough_or_what_was_accepted_here(
    by: str, new: Allocation, accepted: Allocation | None, is_enough: bool
) -> None:
    said = Learnt(node=by, values=(new,))
    assert is_proven(FLEET, FLEET.electors, said, new, register(accepted=accepted), has_generation=True) is is_enough


def test_only_a_node_without_a_state_counts_from_the_generation_that_it_is_told() -> None:
    new = allocation_of(3 * GENERATION_STEP + 5)
    said = Learnt(node="robot2", values=(new,), generation=3)
    assert is_proven(FLEET, FLEET.electors, said, new, register(), has_generation=False)
    assert not is_proven(FLEET, FLEET.electors, said, new, register(), has_generation=True)
    ahead = allocation_of(MAX_AHEAD + 1)
    assert not is_proven(FLEET, FLEET.electors, replace(said, values=(ahead,)), ahead, register(), has_generation=True)
    assert not is_proven(FLEET, FLEET.electors, replace(said, generation=2), new, register(), has_generation=False)


def test_a_node_that_was_cut_off_for_twelve_days_of_a_move_a_second_believes_what_it_hears_then() -> None:
    assert is_fit(FLEET, allocation_of(10 + 12 * 86400), register(learnt=allocation_of(10)))


def test_the_last_generation_has_room_to_count_like_any_other() -> None:
    assert (MAX_GENERATION + 1) * GENERATION_STEP <= MAX_REVISION
    assert (MAX_GENERATION + 2) * GENERATION_STEP > MAX_REVISION, "and the next one would not"
