"""`on_isolation`: what a robot does that is cut off from the owner and from a quorum."""

from __future__ import annotations

import pytest

from support.fleets import fleet_of, task_of
from zsched.core.node.status import build_snapshot
from zsched.core.values.fleet import Fleet, OnIsolation, WorkerSpec
from zsched.core.values.plan import WorkerRole
from zsched_lab.sim.simulator import Simulator

TASK = "merge"
ROBOTS = ("robot1", "robot2", "robot3")
EDGES = ("edge1", "edge2")


def fleet(on_isolation: OnIsolation) -> Fleet:
    task = task_of(TASK, EDGES, worker=WorkerSpec(command=("true",)), on_isolation=on_isolation)
    return fleet_of(task, of=sorted(EDGES + ROBOTS))


def started(on_isolation: OnIsolation, seed: int = 1) -> Simulator:
    sim = Simulator(fleet=fleet(on_isolation), seed=seed)
    sim.start()
    assert sim.run_until(lambda: sim.agreed(TASK) is not None, 20)
    sim.run(3)
    return sim


def served_by(sim: Simulator, robot: str) -> str | None:
    plan = sim.plans.get((robot, TASK))
    return None if plan is None or plan.current is None else plan.current.owner


def test_hold_keeps_the_routes_as_they_are() -> None:
    sim = started(OnIsolation.HOLD)
    owner = sim.agreed(TASK)
    sim.cut(("robot1",), tuple(name for name in sim.running() if name != "robot1"))
    sim.run(10)
    assert served_by(sim, "robot1") == owner


@pytest.mark.parametrize("seed", range(5))
def test_local_robot_works_alone_while_cut_off_and_comes_back(seed: int) -> None:
    sim = started(OnIsolation.LOCAL, seed)
    owner, epoch = sim.agreed(TASK), sim.node("robot1").registers[TASK].value.epoch
    rest = tuple(name for name in sim.running() if name != "robot1")
    sim.cut(("robot1",), rest)
    assert sim.run_until(lambda: served_by(sim, "robot1") == "robot1", 4)
    robot = sim.node("robot1")
    assert robot.executors[TASK].role.role is WorkerRole.ACTIVE
    (task,) = build_snapshot(robot, sim.now).tasks
    assert "works alone, degraded" in task.problems[0]
    assert all(served_by(sim, other) == owner for other in ("robot2", "robot3"))
    sim.run(3)
    sim.heal()
    assert sim.run_until(lambda: served_by(sim, "robot1") == sim.agreed(TASK), 3)
    assert robot.executors[TASK].role.role is WorkerRole.IDLE
    assert robot.registers[TASK].value.epoch == epoch


def test_local_robot_that_missed_a_move_goes_to_the_new_owner() -> None:
    sim = started(OnIsolation.LOCAL)
    owner = sim.agreed(TASK) or ""
    rest = tuple(name for name in sim.running() if name != "robot1")
    sim.cut(("robot1",), rest)
    sim.run(3)
    sim.crash(owner)
    others = tuple(name for name in rest if name != owner)
    assert sim.run_until(lambda: sim.agreed(TASK, *others) not in (None, owner), 5)
    assert served_by(sim, "robot1") == "robot1"
    sim.heal()
    assert sim.run_until(lambda: served_by(sim, "robot1") == sim.agreed(TASK, *others), 5)
    assert sim.node("robot1").executors[TASK].role.role is WorkerRole.IDLE


def test_robot_with_a_quorum_never_works_alone() -> None:
    """Two robots of three are together: they vote, they do not improvise."""
    sim = started(OnIsolation.LOCAL)
    owner = sim.agreed(TASK) or ""
    sim.cut((owner, "robot3"), tuple(name for name in sim.running() if name not in {owner, "robot3"}))
    sim.run(10)
    assert served_by(sim, "robot1") == served_by(sim, "robot2") not in (None, owner, "robot1", "robot2")
    assert served_by(sim, "robot3") == owner, "it hears the owner, so it is not alone"


def test_an_edge_that_is_left_alone_sleeps() -> None:
    """The robots are switched off and the owner is away: nothing is due (the simulator finds a loop that spins)."""
    sim = started(OnIsolation.LOCAL)
    owner = sim.agreed(TASK) or ""
    (last,) = (name for name in EDGES if name != owner)
    for name in sim.running():
        if name != last:
            sim.crash(name)
    sim.run(5)
    woken = sim.events
    sim.run(10)
    assert sim.events - woken < 200, "a beat, a sample and a round now and then"
