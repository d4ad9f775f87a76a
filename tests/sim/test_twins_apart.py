"""Two machines with one name and no link between them, in whole fleets: the others say so, the later one leaves."""

from __future__ import annotations

from functools import partial

from support.fleets import fleet_of, task_of
from zsched.core.node.status import build_snapshot
from zsched.core.values.fleet import WorkerSpec
from zsched_lab.sim.parts import Machine
from zsched_lab.sim.simulator import Simulator

ROBOTS, EDGES = ("robot1", "robot2", "robot3"), ("edge1", "edge2")
FLEET = fleet_of(
    task_of(candidates=EDGES, worker=WorkerSpec(command=("true",))),
    of=sorted(EDGES + ROBOTS),
    electors=ROBOTS,
)


def with_twin(seed: int) -> tuple[Simulator, str]:
    """The owner's twin starts, and the two do not hear each other."""
    sim = Simulator(fleet=FLEET, seed=seed)
    sim.start()
    assert sim.run_until(lambda: sim.agreed("merge") is not None, 20)
    sim.run(5)
    owner = sim.agreed("merge")
    assert owner is not None
    key = f"{owner}~"
    sim.machines[key] = Machine(key=key, name=owner, fleet=FLEET)
    sim.cuts |= {(owner, key), (key, owner)}
    sim.start(key)
    return sim, owner


def has_ended(machine: Machine) -> bool:
    return machine.node is None


def test_the_twin_that_came_later_leaves_and_everybody_says_why() -> None:
    for seed in range(5):
        sim, owner = with_twin(seed)
        life = sim.machines[owner].life
        twin = sim.machines[f"{owner}~"]
        assert sim.run_until(partial(has_ended, twin), 8), seed
        assert any(f"{owner}~ stands down: another daemon calls itself '{owner}'" in one for one in sim.stories)
        assert sim.machines[owner].life == life, "the one that was there stays"
        assert sim.agreed("merge") == owner
        for name in sim.running():
            if name != owner:
                problems = build_snapshot(sim.node(name), sim.now).problems
                assert any(f"2 daemons call themselves '{owner}'" in one for one in problems), (name, problems)
