"""A whole simulated fleet that runs by its file, and what operators tell it."""

from __future__ import annotations

from support.fleets import fleet_of, tuning_of
from zsched.core.values import events as ev
from zsched.core.values.document import Document, Flag
from zsched.core.values.fleet import Fleet, TaskSpec, WorkerSpec
from zsched.core.values.messages import ChangeFleet, CommandOutcome, CommandResult
from zsched.core.values.model import NodeId
from zsched_lab.sim.simulator import Simulator

TASK = "merge"
ROBOTS, EDGES = ("robot1", "robot2", "robot3"), ("edge1", "edge2")
FLEET = fleet_of(
    TaskSpec(
        name=TASK,
        candidates=EDGES,
        tuning=tuning_of(cpu=1.0, memory=0.0),
        worker=WorkerSpec(command=("true",)),
        exclusive=True,
    ),
    of=sorted(EDGES + ROBOTS),
    electors=ROBOTS,
)


class Play:
    """A fleet that runs by its file, and what operators tell it."""

    def __init__(self, seed: int = 1, fleet: Fleet = FLEET, generation: int = 0) -> None:
        self.fleet = fleet
        self.sim = Simulator(fleet=fleet, seed=seed, generation=generation)
        self.sim.documents.judge_from(fleet, generation)
        self.sim.start()
        assert self.sim.run_until(lambda: not self.sim.unsettled(), 20), self.sim.unsettled()
        self._number = 0

    def tell(self, node: NodeId, command: ChangeFleet) -> int:
        """Give a command; its number."""
        self._number += 1
        event = ev.FleetCommanded(request=self._number, command=command)
        self.sim.deliver(self.sim.machines[node], event)
        return self._number

    def told(self, node: NodeId, command: ChangeFleet, seconds: float = 10) -> CommandResult:
        """Give a command and wait for its answer."""
        number = self.tell(node, command)
        assert self.sim.run_until(lambda: self.answer(number) is not None, seconds)
        answer = self.answer(number)
        assert answer is not None
        return answer

    def answer(self, number: int) -> CommandResult | None:
        return next((one.result for one in self.sim.answers if one.request == number), None)

    def document(self, fleet: Fleet, flags: tuple[Flag, ...] = ()) -> Document:
        return self.sim.documents.write(fleet, flags)

    def disk(self, node: NodeId) -> str:
        state = self.sim.disk(node)
        assert state is not None
        return state.disk

    def electors(self, node: NodeId) -> tuple[NodeId, ...]:
        return self.sim.node(node).agreement.electors

    def settle(self, seconds: float = 10) -> None:
        """Wait until every running node has learnt one settled value, and the task has its owner."""
        assert self.sim.run_until(self.is_settled, seconds), self.values()

    def is_settled(self) -> bool:
        values = [self.sim.node(name).agreement.fleet_value for name in self.sim.running()]
        is_one = all(value is not None and value.settled and value == values[0] for value in values)
        return is_one and not self.sim.unsettled()

    def values(self) -> dict[NodeId, object]:
        return {name: self.sim.node(name).agreement.fleet_value for name in self.sim.running()}

    def adopt(self) -> None:
        self.set_flags()

    def set_flags(self, *flags: Flag) -> None:
        """Agree a document with these flags, and wait until every node has it."""
        self.agree(flags)
        self.settle()

    def agree(self, flags: tuple[Flag, ...] = ()) -> None:
        """Agree a document of the present fleet, and wait for nothing else."""
        content = self.document(self.fleet, flags)
        assert self.told("robot1", ChangeFleet(document=content)).outcome is CommandOutcome.OK
