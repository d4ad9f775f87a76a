"""Several tasks on the same candidates, in a fleet of full nodes: no herd, and nobody waits for ever."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import pytest

from support.fleets import fleet_of, task_of
from zsched.core.values.fleet import Demand, Fleet, WorkerSpec
from zsched.core.values.model import NodeId, Tuning
from zsched_lab.decisions.world import EVEN
from zsched_lab.sim.simulator import CORES, MEMORY_MB, Simulator

ROBOTS = ("robot1", "robot2", "robot3")
STARTED_AT_S = 100.0
Load = Callable[[NodeId, float], tuple[float, float]]


def fleet(tasks: int, edges: int) -> Fleet:
    names = tuple(f"edge{index}" for index in range(1, edges + 1))
    specs = tuple(
        task_of(
            f"task{index}",
            names,
            tuning=Tuning(weights=EVEN),
            demand=Demand(cpu_cores=0.25 * CORES, memory_mb=0.25 * MEMORY_MB),
            worker=WorkerSpec(command=("work",)),
        )
        for index in range(1, tasks + 1)
    )
    return fleet_of(*specs, of=(*names, *ROBOTS))


def busy(shares: dict[NodeId, float]) -> Load:
    """Background only, as shares of the machine: what the tasks use themselves does not show in these readings."""
    return lambda node, _now: (shares.get(node, 0.2) * CORES, shares.get(node, 0.2) * MEMORY_MB)


def owners(sim: Simulator) -> list[NodeId | None]:
    return [sim.agreed(task.name) for task in sim.fleet.tasks]


def most_at_once(sim: Simulator, seconds: float) -> int:
    """The largest number of tasks that one node owned at any time."""
    worst = 0

    def look() -> bool:
        nonlocal worst
        held = Counter(owner for owner in owners(sim) if owner is not None)
        worst = max(worst, *held.values(), 0)
        return False

    sim.run_until(look, seconds)
    return worst


@pytest.mark.parametrize("seed", [1, 2])
def test_first_placements_do_not_all_go_to_the_idlest_node(seed: int) -> None:
    sim = Simulator(fleet=fleet(3, 3), seed=seed, load=busy({"edge1": 0.1}))
    sim.start()
    assert most_at_once(sim, 8.0) == 1
    assert sorted(map(str, owners(sim))) == ["edge1", "edge2", "edge3"]


@pytest.mark.parametrize("seed", [1, 2])
def test_tasks_that_flee_the_same_load_do_not_meet_on_the_same_idle_node(seed: int) -> None:
    shares = {"edge1": 0.1, "edge2": 0.1, "edge3": 0.3, "edge4": 0.32}
    sim = Simulator(fleet=fleet(2, 4), seed=seed, load=busy(shares))
    sim.start()
    sim.run(20.0)
    assert sorted(map(str, owners(sim))) == ["edge1", "edge2"]
    shares.update(edge1=0.75, edge2=0.75)
    assert most_at_once(sim, 30.0) == 1
    assert sorted(map(str, owners(sim))) == ["edge3", "edge4"]


def test_every_task_gets_its_turn() -> None:
    sim = Simulator(fleet=fleet(6, 3), seed=1, load=busy({}))
    sim.start()
    assert sim.run_until(lambda: None not in owners(sim), 10.0)
    assert Counter(owners(sim)) == {"edge1": 2, "edge2": 2, "edge3": 2}
