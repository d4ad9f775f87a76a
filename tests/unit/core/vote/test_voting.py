"""One task's voting at one robot: who must answer, when it ends, who commits (in a whole round: `test_rounds.py`)."""

from __future__ import annotations

import math

import pytest

from support.allocations import allocation_of
from support.fleets import fleet_of, task_of, tuning_of
from support.proposals import proposal_of
from zsched.core.values.in_force import InForce
from zsched.core.values.model import PeerState, Proposal
from zsched.core.vote.tally import VoteOutcome
from zsched.core.vote.voting import Voting, vote_time

ROBOTS = ("robot1", "robot2", "robot3")
ALL = dict.fromkeys(ROBOTS, PeerState.ALIVE)
TUNING = tuning_of(cpu=1.0, memory=0.0)
FLEET = fleet_of(task_of(tuning=TUNING), of=ROBOTS, electors=ROBOTS)
VALUE = allocation_of(5, tuning=TUNING)
VOTE_S = vote_time(FLEET.timing)


def paper(voter: str, candidate: str = "edge2", base: int = 5) -> Proposal:
    return proposal_of(voter, candidate, base_revision=base, aggregate=2.0, is_escape=False, reason=voter)


def test_a_move_opens_a_vote_and_calls_who_has_not_proposed_lately() -> None:
    voting = Voting(InForce(FLEET), "robot1")
    assert voting.absorb(paper("robot2"), VALUE, 10.0)
    assert voting.opened_at == 10.0
    assert not voting.absorb(paper("robot1"), VALUE, 10.1), "our own calls nobody"
    assert not voting.absorb(paper("robot3"), VALUE, 10.0 + VOTE_S), "we have answered"
    assert voting.absorb(paper("robot3"), VALUE, 10.2 + VOTE_S), "that was long ago"
    assert voting.opened_at == 10.0


def test_staying_opens_nothing_and_a_stranger_to_the_vote_answers_nobody() -> None:
    voting = Voting(InForce(FLEET), "robot1")
    assert not voting.absorb(paper("robot2", "edge1"), VALUE, 10.0)
    assert voting.opened_at is None
    assert voting.count(VALUE, ALL, 10.0) is None
    assert not Voting(InForce(FLEET), "edge1").absorb(paper("robot2"), VALUE, 10.0)


@pytest.mark.parametrize("base", [4, 6])
def test_another_base_leaves_no_trace(base: int) -> None:
    voting = Voting(InForce(FLEET), "robot1")
    assert not voting.absorb(paper("robot2", base=base), VALUE, 10.0)
    assert (voting.opened_at, voting.proposals) == (None, {})


def test_a_majority_ends_it_and_its_voters_commit_in_turn_once() -> None:
    voting = Voting(InForce(FLEET), "robot3")
    voting.absorb(paper("robot3"), VALUE, 10.0)
    assert voting.count(VALUE, ALL, 10.0) is None
    voting.absorb(paper("robot2"), VALUE, 10.1)
    ended = voting.count(VALUE, ALL, 10.1)
    assert ended is not None
    assert (ended.outcome, ended.winner, voting.opened_at) == (VoteOutcome.WON, "edge2", None)
    assert voting.next_deadline() == pytest.approx(10.1 + FLEET.timing.stagger_s), "robot2 comes first"
    assert voting.take_commit(10.1) is None
    change = voting.take_commit(voting.next_deadline())
    assert change is not None
    assert (change.owner, change.base_revision, change.reason) == ("edge2", 5, "robot3")
    assert voting.take_commit(99.0) is None
    assert voting.next_deadline() == math.inf


def test_what_nobody_completes_ends_with_its_time_and_old_papers_do_not_count() -> None:
    voting = Voting(InForce(FLEET), "robot1")
    voting.absorb(paper("robot2"), VALUE, 10.0)
    assert voting.next_deadline() == 10.0 + VOTE_S
    ended = voting.count(VALUE, ALL, 10.0 + VOTE_S)
    assert ended is not None
    assert ended.outcome is VoteOutcome.NO_QUORUM
    voting.absorb(paper("robot3"), VALUE, 10.1 + VOTE_S)
    assert voting.count(VALUE, ALL, 10.1 + VOTE_S) is None, "robot2's paper is too old to make the majority"


def test_a_learnt_value_forgets_all_but_a_commit_that_the_register_has() -> None:
    voting = Voting(InForce(FLEET), "robot1")
    for handed_out in (False, True):
        voting.absorb(paper("robot1"), VALUE, 10.0)
        voting.absorb(paper("robot2"), VALUE, 10.0)
        assert voting.count(VALUE, ALL, 10.0) is not None
        assert voting.awaited_until > 10.0
        if handed_out:
            assert voting.take_commit(10.0) is not None
        voting.on_learnt()
        assert (voting.commit is not None) is handed_out
        assert (voting.proposals, voting.awaited_until) == ({}, -math.inf)
    voting.end_commit()
    assert voting.commit is None


def test_who_commits_a_move_is_called_to_no_other_vote_until_that_has_ended() -> None:
    voting = Voting(InForce(FLEET), "robot1")
    for voter in ROBOTS[:2]:
        voting.absorb(paper(voter), VALUE, 10.0)
    assert voting.count(VALUE, ALL, 10.0) is not None
    late = 10.1 + VOTE_S
    assert not voting.absorb(paper("robot3", "edge3"), VALUE, late)
    voting.end_commit()
    assert voting.absorb(paper("robot3", "edge3"), VALUE, late)
