"""The vote's rules that a fleet's safety does not hang on, so that no schedule shows them broken."""

from __future__ import annotations

import pytest

from support.allocations import allocation_of
from support.fleets import fleet_of, task_of, tuning_of
from support.proposals import proposal_of
from support.robots import Decider
from zsched.core.gateway.gateway import Gateway
from zsched.core.values import events as ev
from zsched.core.values.fleet import WorkerSpec
from zsched.core.values.in_force import InForce
from zsched.core.values.model import PeerState, Proposal, Reach
from zsched.core.vote.tally import VoteOutcome, tally
from zsched_lab.sim.simulator import Simulator
from zsched_lab.sim.swarm import plan

VOTERS = ("robot1", "robot2", "robot3")


def proposal(voter: str, candidate: str, *, is_escape: bool = False) -> Proposal:
    return proposal_of(voter, candidate, base_revision=3, is_escape=is_escape, reason="x")


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
    robot = Decider(fleet, "robot1", Gateway(InForce(fleet)))
    spec = fleet.task("merge")
    value = allocation_of(3, tuning=spec.tuning)
    states = dict.fromkeys((node.name for node in fleet.nodes), PeerState.ALIVE)
    for voter, candidate in (("robot1", mine), ("robot2", "edge2"), ("robot3", "edge2")):
        robot.absorb_proposal(proposal(voter, candidate), value, states, 1.0)
    assert len(robot.votes.due_commits(5.0)) == commits


def reaching_all(robots: int) -> Simulator:
    """Robots and three edges at rest; the task's owner must be reached by every robot."""
    voters, edges = tuple(f"robot{i}" for i in range(1, robots + 1)), ("edge1", "edge2", "edge3")
    task = task_of(
        candidates=edges,
        tuning=tuning_of(cpu=1.0, memory=0.0),
        price_s=0.0,
        worker=WorkerSpec(command=("true",)),
        reach=Reach.ALL,
    )
    fleet = fleet_of(task, of=edges + voters)
    sim = Simulator(fleet=fleet, seed=3)
    sim.start()
    assert sim.run_until(lambda: not sim.unsettled(), 20), sim.unsettled()
    sim.run(5)
    return sim


@pytest.mark.parametrize("robots", [2, 3])
def test_a_suspicion_that_the_next_beat_refutes_moves_nothing_though_every_robot_must_reach_the_owner(
    robots: int,
) -> None:
    sim = reaching_all(robots)
    owner, epochs = sim.agreed("merge") or "", len(sim.owners)
    for _ in range(5):
        sim.deliver(sim.machines["robot1"], ev.TokenLost(node=owner, incarnation=sim.node(owner).incarnation))
        assert sim.sees("robot1", owner) is PeerState.SUSPECT
        assert sim.run_until(lambda: sim.sees("robot1", owner) is PeerState.ALIVE, 1.0)
        sim.run(1.3)
    assert len(sim.owners) == epochs, "\n".join(sim.stories[-20:])


def test_an_owner_that_one_robot_has_really_lost_is_left_once_it_had_its_time_where_all_must_reach_it() -> None:
    sim = reaching_all(3)
    owner = sim.agreed("merge") or ""
    sim.cut(("robot1",), (owner,))
    at = sim.now
    assert sim.run_until(lambda: sim.agreed("merge") not in (None, owner), 10), "\n".join(sim.stories[-20:])
    timing = sim.fleet.timing
    assert sim.now - at > timing.suspect_s + timing.confirm_s - timing.beat_s
    assert all(sim.sees(robot, owner) is PeerState.ALIVE for robot in ("robot2", "robot3"))


def scores(sim: Simulator, edge: str) -> list[float]:
    """What each robot makes of an edge: the joint utility, less what is held against it."""
    judgements = [sim.node(voter).rounds.tasks["merge"].judgement for voter in VOTERS]
    return [-1.0 if judgement is None else judgement.aggregates.get(edge, -1.0) for judgement in judgements]
