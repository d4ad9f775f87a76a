"""Workers that somebody else runs: a node that has none gets no task, and an owner without one is left."""

from __future__ import annotations

from support.fleets import fleet_of, task_of, tuning_of
from zsched.core.node.status import build_snapshot
from zsched.core.values.fleet import Fleet, WorkerSpec
from zsched.core.values.plan import ReadyWhen
from zsched.core.values.struct import replace
from zsched_lab.sim.simulator import Simulator
from zsched_lab.sim.swarm import plan

ROBOTS, EDGES = ("robot1", "robot2", "robot3"), ("edge1", "edge2")
DEADLINE_S = 3.0


def fleet() -> Simulator:
    task = task_of(
        candidates=EDGES,
        tuning=tuning_of(cpu=1.0, memory=0.0),
        price_s=0.0,
        worker=WorkerSpec(ready_when=ReadyWhen.MATCHING, start_deadline_s=DEADLINE_S),
    )
    return Simulator(fleet=fleet_of(task, of=EDGES + ROBOTS), seed=3)


def problems(sim: Simulator, node: str) -> tuple[str, ...]:
    return build_snapshot(sim.node(node), sim.now).tasks[0].problems


def test_nobody_owns_a_task_that_nobody_can_do() -> None:
    sim = fleet()
    for edge in EDGES:
        sim.work.leave(sim.machines[edge])
    sim.start()
    sim.run(15)
    assert sim.agreed("merge") is None
    sim.work.come(sim.machines["edge2"])
    assert sim.run_until(lambda: sim.agreed("merge") == "edge2" and not sim.unsettled(), 5), sim.unsettled()


def test_an_owner_whose_worker_is_away_is_left_at_its_deadline_and_not_before() -> None:
    sim = fleet()
    sim.start()
    assert sim.run_until(lambda: sim.agreed("merge") is not None and not sim.unsettled(), 15), sim.unsettled()
    owner = sim.agreed("merge") or ""
    sim.work.leave(sim.machines[owner])
    at = sim.now
    assert sim.run_until(lambda: all(problems(sim, robot) for robot in ROBOTS), 1.5), "everybody says what is wrong"
    assert sim.run_until(lambda: sim.agreed("merge") not in (None, owner), 2 * DEADLINE_S)
    assert DEADLINE_S < sim.now - at < DEADLINE_S + 1.5
    assert sim.run_until(lambda: not sim.unsettled(), 3), sim.unsettled()
    sim.run(10)
    assert sim.agreed("merge") != owner, "nobody goes back to where no worker is"


def take_over(sim: Simulator, fleet: Fleet) -> None:
    """Every node that runs takes another file over."""
    sim.fleet = fleet
    for machine in sim.machines.values():
        machine.fleet = fleet
        sim.reload(machine)


def rest(sim: Simulator) -> None:
    assert sim.run_until(lambda: not sim.unsettled(), 15), sim.unsettled()


def with_extra(fleet: Fleet) -> Fleet:
    return replace(fleet, tasks=(replace(fleet.tasks[0], name="extra"), *fleet.tasks))


def test_a_task_that_comes_to_running_nodes_finds_its_workers() -> None:
    sim = fleet()
    sim.start()
    rest(sim)
    take_over(sim, with_extra(sim.fleet))
    rest(sim)
    assert sim.agreed("extra") in EDGES


def test_a_task_that_comes_to_running_nodes_without_a_worker_has_no_owner_and_no_rest() -> None:
    sim = fleet()
    sim.start()
    rest(sim)
    for edge in EDGES:
        sim.work.leave(sim.machines[edge])
    take_over(sim, with_extra(sim.fleet))
    sim.run(15)
    assert sim.agreed("extra") is None
    assert sim.unsettled() == "extra: owner None is not alive", "a real stand-still is found"
    sim.work.come(sim.machines["edge2"])
    rest(sim)
    assert sim.agreed("extra") == "edge2"


def without_extra() -> tuple[Simulator, Fleet]:
    """A fleet that had the task and has it no more, and the file with it."""
    sim = fleet()
    before, after = sim.fleet, with_extra(sim.fleet)
    sim.start()
    for file in (after, before):
        take_over(sim, file)
        rest(sim)
    return sim, after


def test_a_worker_that_ran_on_while_its_task_was_away_is_found_again() -> None:
    sim, after = without_extra()
    take_over(sim, after)
    rest(sim)
    assert sim.agreed("extra") in EDGES


def test_a_worker_that_ended_while_its_task_was_away_is_not_found_again() -> None:
    sim, after = without_extra()
    sim.work.leave(sim.machines["edge1"])
    take_over(sim, after)
    rest(sim)
    assert sim.agreed("extra") == "edge2"


def test_random_schedules_have_such_workers_too() -> None:
    kinds = [{fault.kind for fault in plan(seed).faults} for seed in range(100)]
    assert 5 <= sum("absence" in one for one in kinds) <= 40
