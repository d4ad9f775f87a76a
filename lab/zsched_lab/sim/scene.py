"""What every group of faults needs: the simulator, the plan, chance, and whether the faults are over.

Knows: the stage's shared things. Does not know: any fault.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from random import Random

from zsched.core.values.fleet import Fleet
from zsched.core.values.model import NodeId
from zsched_lab.sim.parts import Machine
from zsched_lab.sim.simulator import Simulator
from zsched_lab.sim.swarm import Fault, Plan

Carry = Callable[[Fault], None]


@dataclass(slots=True)
class Scene:
    """One schedule's simulator, and what its faults share."""

    plan: Plan
    sim: Simulator
    rng: Random
    fleet: Fleet
    """The fleet file that is right: that of the newest rollout."""
    generation: int
    """The newest generation that the operator has begun."""
    done: Counter[str] = field(default_factory=Counter)
    initialised: set[NodeId] = field(default_factory=set)
    """The nodes that were brought into the newest generation."""
    is_over: bool = False
    is_memory_false: bool = False
    """Whether a disk has come back with less than it had said that it holds."""

    def then(self, seconds: float, action: Callable[[], None]) -> None:
        """Do something later, unless the faults are over by then."""
        self.sim.later(seconds, lambda: None if self.is_over else action())

    def machine(self, fault: Fault) -> Machine:
        """The machine that a fault is about."""
        return self.sim.machines[fault.nodes[0]]

    def start_later(self, fault: Fault) -> None:
        """A node that went down comes back when the fault is over."""
        self.then(fault.seconds, lambda: self.sim.start(*fault.nodes))

    def restart(self, machine: Machine, fleet: Fleet) -> None:
        """A node is restarted with a fleet file; one that is down finds it when it comes back."""
        is_up = machine.node is not None
        self.sim.crash(machine.key)
        machine.fleet = fleet
        if is_up:
            self.sim.start(machine.key)

    def reload(self, machine: Machine, fleet: Fleet) -> None:
        """A running node takes another fleet file over; one that is down finds it when it comes back."""
        machine.fleet = fleet
        if machine.node is not None:
            self.sim.reload(machine)

    # --- generations -------------------------------------------------------------------------------------------------

    def begin_generation(self) -> None:
        """The operator begins a new generation; nobody is in it yet."""
        self.generation += 1
        self.initialised.clear()

    def bring(self, machine: Machine, generation: int) -> None:
        """Stop a node, `fleet recover --generation`, start it again if it ran; too late when a newer one has begun."""
        if generation < self.generation:
            return
        is_up = machine.node is not None
        self.sim.crash(machine.key)
        machine.fleet, machine.is_durable = self.fleet, False
        self.sim.initialise(machine, incarnation=self.sim.wall_count, generation=generation)
        self.initialised.add(machine.name)
        if is_up:
            self.sim.start(machine.key)
