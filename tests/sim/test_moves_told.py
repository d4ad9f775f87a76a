"""What nodes remember of a move: every robot its reason and its votes, also one that has not committed it."""

from __future__ import annotations

from dataclasses import replace

from support.fleets import fleet_of, task_of, tuning_of
from zsched.core.node.work import FROM_A_PEER, _move_of
from zsched.core.values.fleet import WorkerSpec
from zsched_lab.sim.simulator import Simulator

ROBOTS, EDGES = ("robot1", "robot2", "robot3"), ("edge1", "edge2")
SPEC = task_of(candidates=EDGES, tuning=tuning_of(cpu=1.0, memory=0.0), worker=WorkerSpec(command=("worker",)))


def test_a_robot_that_did_not_commit_a_move_tells_why_it_was_made() -> None:
    sim = Simulator(fleet=fleet_of(SPEC, of=sorted((*ROBOTS, *EDGES)), electors=ROBOTS), seed=11)
    sim.start(*ROBOTS, *EDGES)
    assert sim.run_until(lambda: sim.agreed("merge", *ROBOTS) is not None, 10.0)
    owner = sim.agreed("merge", *ROBOTS)
    assert owner is not None
    (other,) = set(EDGES) - {owner}
    sim.run(3.0)
    sim.crash(owner)
    assert sim.run_until(lambda: sim.agreed("merge", *ROBOTS, other) == other, 20.0)
    told = {name: sim.node(name).history["merge"][-1].reason for name in (*ROBOTS, other)}
    assert set(told.values()) <= {f"{owner} is gone", f"{owner} is silent", FROM_A_PEER}
    assert [name for name, reason in told.items() if reason == FROM_A_PEER] == [other], "an edge hears no proposals"


def test_votes_of_another_revision_are_no_votes_for_a_move() -> None:
    sim = Simulator(fleet=fleet_of(SPEC, of=sorted((*ROBOTS, *EDGES)), electors=ROBOTS), seed=12)
    sim.start(*ROBOTS, *EDGES)
    node = sim.node("robot1")
    assert sim.run_until(lambda: bool(node.votes.tasks["merge"].proposals), 10.0)
    (voter, (proposal, _)) = next(iter(node.votes.tasks["merge"].proposals.items()))
    value = sim.node("robot1").registers["merge"].value
    assert proposal.base_revision == value.revision
    for ahead, votes in ((1, ((voter, proposal.candidate),)), (2, ())):
        learnt = replace(value, revision=value.revision + ahead, epoch=1, owner=proposal.candidate)
        assert _move_of(node, learnt, None, is_known=False).votes[:1] == votes
