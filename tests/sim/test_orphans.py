"""Whole nodes: tasks that lose one owner together find places that hold all of them, and each of them moves once."""

from __future__ import annotations

from dataclasses import replace

import pytest

from support.plays import FLEET, TASK
from zsched.core.values.fleet import Demand, Fleet
from zsched.core.values.model import NodeId, Weights
from zsched_lab.sim.simulator import Simulator

TASKS = (TASK, "plan", "watch")
LOADS = {"edge1": (0.5, 500.0), "edge2": (1.0, 2300.0), "robot3": (3.0, 500.0)}
"""{node: (cores, MiB in use)}: all tasks are best on edge1, then on edge2, which holds two of them."""


def fleet() -> Fleet:
    first = replace(
        FLEET.tasks[0],
        candidates=("edge1", "edge2", "robot3"),
        exclusive=False,
        demand=Demand(cpu_cores=0.1, memory_mb=700.0),
        tuning=replace(FLEET.tasks[0].tuning, weights=Weights(cpu=1.0, memory=0.0, network=0.0), bonus=0.0),
    )
    return replace(FLEET, tasks=tuple(replace(first, name=name) for name in TASKS))


def load(node: NodeId, _now: float) -> tuple[float, float]:
    return LOADS.get(node, (1.0, 1000.0))


@pytest.mark.parametrize("seed", range(8))
def test_three_tasks_of_a_dead_machine_share_the_room_of_the_others_at_once(seed: int) -> None:
    """All three went to the same machine, and one had to leave it again for want of memory."""
    sim = Simulator(fleet=fleet(), seed=seed, load=load)
    sim.start(*(node.name for node in sim.fleet.nodes))
    assert sim.run_until(lambda: all(sim.agreed(task) == "edge1" for task in TASKS), 30)
    sim.run(5.0)
    before = set(sim.owners)
    sim.crash("edge1")
    assert sim.run_until(lambda: all(sim.agreed(task) in ("edge2", "robot3") for task in TASKS), 20)
    sim.run(20.0)
    owners = [sim.agreed(task, "robot1", "robot2", "robot3", "edge2") for task in TASKS]
    assert sorted(owners, key=str) == ["edge2", "edge2", "robot3"]
    moved = [one for one in sim.owners if one not in before]
    assert len(moved) == len(TASKS), "each of them once"


@pytest.mark.parametrize("seed", range(8))
def test_a_task_with_one_place_left_gets_it_though_another_one_with_a_choice_is_before_it(seed: int) -> None:
    """The other one had taken it, and had no reason to leave."""
    first, *_ = fleet().tasks
    tasks = (replace(first, name="a"), replace(first, name="b", candidates=("edge1", "edge2")))
    loads = {**LOADS, "edge2": (1.0, 3000.0)}
    sim = Simulator(
        fleet=replace(FLEET, tasks=tasks), seed=seed, load=lambda node, _now: loads.get(node, (1.0, 1000.0))
    )
    sim.start()
    assert sim.run_until(lambda: sim.agreed("a") == sim.agreed("b") == "edge1", 30)
    sim.run(5.0)
    sim.crash("edge1")
    assert sim.run_until(lambda: sim.agreed("b") == "edge2" and sim.agreed("a") in ("edge2", "robot3"), 20)
    sim.run(20.0)
    assert sim.agreed("b") == "edge2"
