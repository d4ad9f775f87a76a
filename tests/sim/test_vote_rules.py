"""The vote's rules that a fleet's safety does not hang on, so that no schedule shows them broken."""

from __future__ import annotations

from random import Random

import pytest

from zsched.core.gateway import Gateway
from zsched.core.model import Allocation, PeerState, Proposal
from zsched.core.rounds import Rounds
from zsched.core.vote import VoteOutcome, tally
from zsched.lab.sim_swarm import plan

VOTERS = ("robot1", "robot2", "robot3")


def proposal(voter: str, candidate: str, *, is_escape: bool = False) -> Proposal:
    return Proposal(
        voter=voter, task="merge", base_revision=3, candidate=candidate, aggregate=0.5, is_escape=is_escape, reason="x"
    )


@pytest.mark.parametrize(
    ("present", "votes", "outcome"),
    [
        (VOTERS, 1, VoteOutcome.NO_QUORUM),
        (VOTERS, 2, VoteOutcome.WON),
        (VOTERS[:2], 1, VoteOutcome.NO_QUORUM),
        (VOTERS[:2], 2, VoteOutcome.WON),
        (VOTERS[:1], 1, VoteOutcome.WON),
    ],
)
def test_an_escape_needs_a_majority_of_the_robots_that_are_not_gone(
    present: tuple[str, ...], votes: int, outcome: VoteOutcome
) -> None:
    ballots = {voter: proposal(voter, "edge2", is_escape=True) for voter in VOTERS[:votes]}
    counted = tally(ballots, voters=VOTERS, present=frozenset(present), owner="edge1", is_over=True)
    assert counted.outcome is outcome


@pytest.mark.parametrize(("mine", "commits"), [("edge1", 0), ("edge2", 1)])
def test_only_a_robot_that_voted_for_the_winner_commits_it(mine: str, commits: int) -> None:
    fleet = next(one.fleet for one in map(plan, range(1000)) if one.fleet.voters == VOTERS)
    rounds = Rounds(fleet, "robot1", Gateway(fleet), Random(1), 0.0)
    spec = fleet.task("merge")
    value = Allocation(task="merge", revision=3, epoch=3, owner="edge1", tuning=spec.tuning)
    states = dict.fromkeys((node.name for node in fleet.nodes), PeerState.ALIVE)
    for voter, candidate in (("robot1", mine), ("robot2", "edge2"), ("robot3", "edge2")):
        rounds.absorb_proposal(proposal(voter, candidate), value, states, 1.0)
    assert len(rounds.due_commits(5.0)) == commits
