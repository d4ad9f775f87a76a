"""A higher epoch means another owner: neither a vote that ends in *stay* nor any change of the register breaks it."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from support.fleets import fleet_of, task_of
from support.proposals import proposal_of
from support.registers import (
    BLANK,
    ELECTORS,
    INITIAL,
    TUNING,
    accept,
    accepted,
    allocation,
    did,
    make,
    promise_all,
)
from zsched.core.register.task_register import TaskRegister
from zsched.core.values.change import Change, MoveOwner, Retune, RoundOutcome
from zsched.core.values.in_force import InForce
from zsched.core.values.model import PeerState
from zsched.core.vote.tally import VoteOutcome
from zsched.core.vote.voting import Voting

TODAY = allocation(3)
STAY = MoveOwner(base_revision=3, owner="e1", reason="test")
SAME = Retune(base_revision=3, tuning=TUNING)
ROBOTS = ("r1", "r2", "r3")
FLEET = fleet_of(task_of(candidates=("e1", "e2"), tuning=TUNING), of=ROBOTS, electors=ROBOTS)


def agreed_on_today() -> list[TaskRegister]:
    """Three electors that have accepted and learnt the value of revision 3."""
    electors = [make(name, state=replace(BLANK, learnt=TODAY)) for name in ELECTORS]
    for elector in electors:
        accepted(elector, accept(1, TODAY), 0.0)
    return electors


@pytest.mark.parametrize("change", [STAY, SAME])
def test_a_change_that_changes_nothing_writes_nothing(change: Change) -> None:
    """A new epoch with the same owner would open a slot beside the one that carries, on every robot, for nothing."""
    electors = agreed_on_today()
    step = promise_all(electors[0], did(electors[0].propose, change, 0.0), electors)
    assert (step.accept, step.learnt, step.finished) == (None, None, (change, RoundOutcome.UNCHANGED))
    assert {elector.value for elector in electors} == {TODAY}
    assert not electors[0].is_busy


@pytest.mark.parametrize("change", [STAY, SAME])
def test_what_follows_in_the_queue_is_tried_all_the_same(change: Change) -> None:
    electors = agreed_on_today()
    asked = did(electors[0].propose, change, 0.0)
    did(electors[0].propose, replace(STAY, owner="e2"), 0.0)
    then = promise_all(electors[0], asked, electors)
    step = promise_all(electors[0], then, electors)
    assert step.accept is not None
    assert step.accept.acceptance.value == replace(TODAY, revision=4, epoch=4, owner="e2")


def test_the_first_placement_is_a_change() -> None:
    assert STAY.apply(INITIAL) == replace(INITIAL, revision=1, epoch=1, owner="e1")


def test_a_vote_that_ends_in_stay_commits_nothing_and_awaits_nothing() -> None:
    voting = Voting(InForce(FLEET), "r1")
    for voter, candidate in (("r2", "e2"), ("r1", "e1"), ("r3", "e1")):
        paper = proposal_of(voter, candidate, base_revision=3, aggregate=1.0)
        voting.absorb(paper, TODAY, 10.0)
    ended = voting.count(TODAY, dict.fromkeys(ROBOTS, PeerState.ALIVE), 10.0)
    assert ended is not None
    assert (ended.outcome, ended.winner) == (VoteOutcome.STAY, "e1")
    assert (voting.commit, voting.awaited_until, voting.next_deadline()) == (None, -math.inf, math.inf)
    assert voting.take_commit(99.0) is None
