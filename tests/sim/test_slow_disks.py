"""Disks that take their time for a save: a successor is found all the same, and the status names them."""

from __future__ import annotations

import pytest

from support.fleets import fleet_of, task_of, tuning_of
from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.fleet import WorkerSpec
from zsched.core.values.model import NodeId
from zsched_lab.sim.simulator import Simulator

ROBOTS, EDGES = ("robot1", "robot2", "robot3"), ("edge1", "edge2", "edge3")
FLEET = fleet_of(
    task_of("merge", EDGES, tuning=tuning_of(cpu=1.0, memory=0.0), worker=WorkerSpec(command=("true",))),
    of=(*EDGES, *ROBOTS),
    electors=ROBOTS,
)


def owned(seed: int) -> tuple[Simulator, NodeId]:
    sim = Simulator(fleet=FLEET, seed=seed)
    sim.start()
    assert sim.run_until(lambda: sim.agreed("merge") is not None, 20)
    sim.run(2.0)
    return sim, sim.agreed("merge") or ""


def slow(sim: Simulator, save_s: float, *names: NodeId) -> None:
    for name in names or sim.machines:
        sim.machines[name].disk_s = (0.9 * save_s, 1.1 * save_s)


def problems(sim: Simulator, name: NodeId) -> str:
    batch = sim.node(name).handle(ev.StatusAsked(request=1), sim.now)
    (answer,) = [one for one in batch if isinstance(one, do.AnswerStatus)]
    return "\n".join(answer.snapshot.problems)


@pytest.mark.parametrize("slowed", [(), ROBOTS[1:]], ids=["all", "all electors but one"])
@pytest.mark.parametrize(("save_s", "within_s"), [(0.4, 3.0), (2.0, 10.0)])
def test_a_killed_owner_has_a_successor_soon_however_slow_the_disks(
    save_s: float, within_s: float, slowed: tuple[NodeId, ...]
) -> None:
    for seed in range(6):
        sim, owner = owned(seed)
        slow(sim, save_s, *slowed)
        sim.crash(owner)
        alive = [name for name in sim.machines if name != owner]
        is_over = sim.run_until(lambda: sim.agreed("merge", *alive) not in {owner, None}, within_s)  # noqa: B023
        assert is_over, (seed, *sim.stories[-30:])


def test_every_status_names_the_machine_whose_disk_is_slow() -> None:
    sim, owner = owned(1)
    slow(sim, 0.4, "robot2")
    sim.crash(owner)
    sim.run(5.0)
    for name in ROBOTS:
        assert "the disk of robot2 is slow: a save takes 0.4" in problems(sim, name)
        assert "robot1 is slow" not in problems(sim, name)
