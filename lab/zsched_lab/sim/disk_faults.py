"""Faults of disks: slow, full, worn out, new, brought back from a backup, or lying about what they have synced.

Knows: what each does to a machine's disk, and what its operator does then. Does not know: what a node makes of it.
"""

from __future__ import annotations

from dataclasses import dataclass

from zsched.core.values.model import NodeId
from zsched_lab.sim.parts import Machine
from zsched_lab.sim.scene import Carry, Scene
from zsched_lab.sim.swarm import Fault


@dataclass(slots=True)
class DiskFaults:
    """Carries out what goes wrong with disks."""

    scene: Scene

    def table(self) -> dict[str, Carry]:
        """{kind of fault: who carries it out}."""
        return {
            **dict.fromkeys(("damage", "wipe"), self._lose_state),
            "slow_disk": self._slow,
            "full_disk": self._full,
            "rollback": self._rollback,
            "lie": self._lie,
            "amnesia": self._amnesia,
        }

    def _slow(self, fault: Fault) -> None:
        machine = self.scene.machine(fault)
        machine.disk_s = (0.001, fault.size)
        self.scene.then(fault.seconds, lambda: setattr(machine, "disk_s", (0.0, 0.0)))

    def _full(self, fault: Fault) -> None:
        """It refuses writes; afterwards the operator makes room and restarts the daemon."""
        name = fault.nodes[0]
        self.scene.sim.broken_disks.add(name)
        self.scene.then(fault.seconds, lambda: self._make_room(name))

    def _make_room(self, name: NodeId) -> None:
        sim = self.scene.sim
        sim.broken_disks.discard(name)
        sim.crash(name)
        sim.start(name)

    def _lose_state(self, fault: Fault) -> None:
        """The state is damaged or gone. `zsched init` is refused to an elector that may have voted."""
        machine = self.scene.machine(fault)
        self.scene.sim.crash(machine.key, is_power_lost=True)
        machine.is_durable = False
        if fault.kind == "damage":
            machine.disk.damage(self.scene.rng)
        else:
            self._wipe(machine, is_replaced=fault.size < 0.5)
        self.scene.start_later(fault)

    def _wipe(self, machine: Machine, *, is_replaced: bool) -> None:
        sim, state = self.scene.sim, machine.disk.state
        generation = self.scene.generation if state is None else state.generation
        machine.disk.wipe()
        machine.is_durable = False
        if is_replaced and machine.name not in machine.fleet.electors:
            sim.initialise(machine, incarnation=sim.wall_count, generation=generation)

    def _amnesia(self, fault: Fault) -> None:
        """All robots lose their state at once, and nobody initialises them; they come back one by one."""
        sim = self.scene.sim
        for name in sim.fleet.voters:
            machine = sim.machines[name]
            sim.crash(name, is_power_lost=True)
            self._wipe(machine, is_replaced=False)
            self.scene.then(self.scene.rng.uniform(0.0, fault.seconds), lambda name=name: sim.start(name))  # type: ignore[misc]

    def _rollback(self, fault: Fault) -> None:
        """The operator restores the state folder from a backup."""
        machine = self.scene.machine(fault)
        self.scene.sim.crash(machine.key)
        if machine.disk.restore(self.scene.rng):
            machine.is_durable, self.scene.is_memory_false = False, True
        self.scene.start_later(fault)

    def _lie(self, fault: Fault) -> None:
        """For a while a disk says that it has synced what only its cache holds; then the power goes."""
        machine = self.scene.machine(fault)
        machine.disk.begin_to_lie()
        self.scene.then(fault.size, lambda: self._lose_power(fault))

    def _lose_power(self, fault: Fault) -> None:
        sim, machine = self.scene.sim, self.scene.machine(fault)
        sim.crash(machine.key, is_power_lost=True)
        if machine.disk.forget(self.scene.rng):
            machine.is_durable, self.scene.is_memory_false = False, True
        self.scene.start_later(fault)
