"""Faults of operators: fleet files that differ, brought to a fleet node by node, and generations that are half done.

Knows: how an operator rolls out a file or a generation. Does not know: what may differ (`zsched_lab.sim.files`), what
nodes make of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from random import Random

from zsched.core.values.fleet import Fleet
from zsched.core.values.lease import RHO
from zsched.core.values.model import NodeId
from zsched_lab.sim.files import CHANGES, RELOADED, other_electors
from zsched_lab.sim.parts import Machine
from zsched_lab.sim.scene import Carry, Scene
from zsched_lab.sim.swarm import Fault

TWINS = ("twin", "apart")
"""Faults that put a second machine beside a node, under the node's name."""


@dataclass(slots=True)
class Rollouts:
    """Carries out what operators do to fleet files and generations."""

    scene: Scene

    def table(self) -> dict[str, Carry]:
        """{kind of fault: who carries it out}."""
        return {
            "electorate": self._electorate,
            "rollout": self._rollout,
            "reload": self._reload,
            "generation": self._generation,
        }

    def _electorate(self, fault: Fault) -> None:
        """A node is restarted with a fleet file that names other electors, and later with the right one."""
        scene, machine = self.scene, self.scene.machine(fault)
        others = other_electors(scene.rng, scene.fleet)
        scene.restart(machine, others)
        if machine.node is None:
            scene.sim.start(machine.key)
        scene.then(fault.seconds, lambda: scene.restart(machine, scene.fleet))

    def _rollout(self, fault: Fault) -> None:
        """A new fleet file goes from node to node; the fault's size says what differs first, maybe more does."""
        scene = self.scene
        rng = Random(f"rollout {scene.plan.seed} {fault.at!r}")
        names = list(CHANGES)
        chosen = [names[int(fault.size)], *rng.sample(names, rng.choice((0, 0, 1)))]
        for name in chosen:
            if not self._may_roll_out(name):
                continue
            scene.fleet = CHANGES[name](rng, scene.fleet)
            scene.done[f"rollout of {name}"] += 1
        scene.sim.invariants.allow(scene.fleet)
        for name, after_s in _one_by_one(rng, scene.fleet, fault):
            scene.then(after_s, lambda name=name, file=scene.fleet: scene.restart(scene.sim.machines[name], file))  # type: ignore[misc]

    def _reload(self, fault: Fault) -> None:
        """As a rollout, but most nodes take the file over while they run, each at its own time."""
        scene = self.scene
        rng = Random(f"reload {scene.plan.seed} {fault.at!r}")
        name = list(RELOADED)[int(fault.size)]
        if not self._may_roll_out(name):
            return
        scene.fleet = RELOADED[name](rng, scene.fleet)
        scene.done[f"rollout of {name}"] += 1
        scene.done["reload"] += 1
        scene.sim.invariants.allow(scene.fleet)
        for node, after_s in _one_by_one(rng, scene.fleet, fault):
            take = scene.reload if rng.random() < 0.8 else scene.restart
            scene.then(after_s, partial(take, scene.sim.machines[node], scene.fleet))

    def _may_roll_out(self, name: str) -> bool:
        """Whether leases are promised all the same (docs/decisions/0026).

        They are not promised to clocks beyond the bound, nor with other candidates at the same time, nor where a robot
        may still work alone by the old file, nor where two machines have one name: the owner that makes the task
        exclusive asks by names, and the answer of one machine counts for the other one, which the owner may not hear.
        """
        if name == "exclusive":
            is_promised = not any(_is_wild(fault) or fault.kind in TWINS for fault in self.scene.plan.faults)
            return is_promised and not any(self.scene.done[f"rollout of {one}"] for one in ("candidates", "isolation"))
        return name != "candidates" or not self.scene.done["rollout of exclusive"]

    def _generation(self, fault: Fault) -> None:
        """The operator starts a new generation node by node, without stopping the others first."""
        scene = self.scene
        rng = Random(f"generation {scene.plan.seed} {fault.at!r}")
        scene.begin_generation()
        number = scene.generation
        for name, after_s in _one_by_one(rng, scene.fleet, fault):
            scene.then(after_s, lambda name=name: scene.bring(scene.sim.machines[name], number))  # type: ignore[misc]

    def complete(self, machine: Machine) -> None:
        """The operator ends what is half done."""
        scene = self.scene
        if scene.generation > scene.plan.generation and machine.name not in scene.initialised:
            scene.bring(machine, scene.generation)


def _one_by_one(rng: Random, fleet: Fleet, fault: Fault) -> list[tuple[NodeId, float]]:
    """(node, after how many seconds): every node once, in any order; the last ones may come too late."""
    names = [node.name for node in fleet.nodes]
    rng.shuffle(names)
    return [(name, fault.seconds * (number + rng.random()) / len(names)) for number, name in enumerate(names)]


def _is_wild(fault: Fault) -> bool:
    """Whether a clock is beyond what leases bear."""
    return fault.kind == "clock_jump" or (fault.kind == "clock_rate" and abs(fault.size - 1.0) > RHO)
