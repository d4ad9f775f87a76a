"""A task that nobody owns: a robot waits for candidates that are still starting, unless another one calls the vote."""

from __future__ import annotations

import pytest

from support.allocations import allocation_of
from support.fleets import fleet_of, task_of, tuning_of
from zsched.core.scheduler.judge import INITIAL_SETTLE_S, Judge, Outcome
from zsched.core.scheduler.standing import Standing
from zsched.core.values.fleet import WorkerSpec
from zsched_lab.sim.simulator import Simulator

TUNING = tuning_of(cpu=1.0, memory=0.0)
SPEC = task_of(candidates=("edge1", "edge2", "edge3"), tuning=TUNING, worker=WorkerSpec(command=("worker",)))
NOBODY = allocation_of(0, None, tuning=TUNING)
SOME = Standing(aggregates={"edge1": 0.5, "edge2": 0.6}, vetoed={}, vectors=(), voters_heard=3)


@pytest.mark.parametrize(("is_called", "outcome"), [(False, Outcome.WAIT), (True, Outcome.PROPOSE)])
def test_a_called_robot_answers_during_its_own_wait(is_called: bool, outcome: Outcome) -> None:
    judge = Judge(spec=SPEC)
    for now in (100.0, 100.0 + INITIAL_SETTLE_S / 2):
        found = judge.judge(SOME, NOBODY, escape=None, is_called=is_called, now=now)
        assert found.outcome is outcome
        assert found.candidate == ("edge2" if is_called else None)


def test_a_robot_that_has_just_started_does_not_hold_up_a_vote_that_the_others_have_called() -> None:
    """Two robots of three and a candidate that never comes; one of the two is restarted during the wait."""
    robots, edges = ("robot1", "robot2", "robot3"), SPEC.candidates
    fleet = fleet_of(SPEC, of=sorted((*robots, *edges)), electors=robots)
    sim = Simulator(fleet=fleet, seed=3)
    sim.start("robot1", "robot2", "edge1", "edge2")
    assert sim.run_until(lambda: sim.node("robot1").rounds.tasks["merge"].judge.seen_first_at is not None, 5.0)
    at = sim.now
    sim.run(INITIAL_SETTLE_S / 2)
    sim.crash("robot2")
    sim.start("robot2")
    assert sim.run_until(lambda: sim.agreed("merge", "robot1", "robot2") is not None, 10.0), sim.stories[-20:]
    assert INITIAL_SETTLE_S - 0.1 < sim.now - at < INITIAL_SETTLE_S + 1.2
