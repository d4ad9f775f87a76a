"""The numbers by which one node's agreement counts: founded from its file and state, or learnt.

Knows: when a node founds a fleet value, what of it goes to disk and into messages. Does not know: what an elector
answers beyond that (`zsched.core.vote.agreement`), how anything travels. Nodes follow a changed fleet value; they do
not change it themselves yet.
"""

from __future__ import annotations

from random import Random

from zsched.core import instructions as do
from zsched.core.electorate.founding import founded
from zsched.core.electorate.roll import Admission, Roll
from zsched.core.todo import ToDo
from zsched.core.values.durable import DurableState
from zsched.core.values.electorate import Creation, FleetValue
from zsched.core.values.fleet import Fleet
from zsched.core.values.messages import Accept, Prepare, Refused
from zsched.core.values.model import NodeId, RegisterState, TaskId
from zsched.core.vote.task_register import TaskRegister


class Numbers:
    """One node's roll, from the moment on at which the node knows its generation.

    Args:
        fleet: the fleet file.
        me: this node.
        durable: its state, or ``None``.
        incarnation: of this daemon.
        registers: its tasks' registers, which the roll renumbers.
        rng: for back-off.
    """

    def __init__(
        self,
        *,
        fleet: Fleet,
        me: NodeId,
        durable: DurableState | None,
        incarnation: int,
        registers: dict[TaskId, TaskRegister],
        rng: Random,
    ) -> None:
        self._fleet, self._me, self._incarnation = fleet, me, incarnation
        self._registers, self._rng = registers, rng
        self._disk = "" if durable is None else durable.disk
        self._stored = None if durable is None else durable.fleet_register
        self.roll: Roll | None = None

    def begin(self, generation: int, now: float, *, may_elect: bool) -> None:
        """The generation is known: count by what the state holds, or by what every node makes of its file."""
        first = founded(self._fleet.name, generation, self._fleet.electors)
        self.roll = Roll(
            me=self._me,
            disk=self._disk,
            incarnation=self._incarnation,
            state=self._stored or RegisterState(task=self._fleet.name, learnt=first),
            registers=self._registers,
            begin=self._created,
            ballot_s=self._fleet.timing.ballot_s,
            stagger_s=self._fleet.timing.stagger_s,
            rng=self._rng,
            now=now,
            may_elect=may_elect,
        )

    def _created(self, creation: Creation) -> TaskRegister:
        """The blank register of a task that the document lists; its electors are told by the roll."""
        return TaskRegister(
            me=self._me,
            incarnation=self._incarnation,
            electors=(),
            electorate="",
            is_elector=False,
            initial=self._fleet.task(creation.task).first_value(creation.start),
            state=RegisterState(task=creation.task, creation=creation.number),
            ballot_s=self._fleet.timing.ballot_s,
            stagger_s=self._fleet.timing.stagger_s,
            rng=self._rng,
            disk=self._disk,
        )

    # --- queries -----------------------------------------------------------------------------------------------------

    @property
    def changed(self) -> FleetValue | None:
        """The learnt fleet value; ``None`` while it is the one that every node makes of its file."""
        value = None if self.roll is None else self.roll.value
        return None if value is None or value.electorate.is_founding else value

    @property
    def state(self) -> RegisterState[FleetValue] | None:
        """What goes to disk."""
        return None if self.roll is None or self.changed is None else self.roll.state

    @property
    def electors(self) -> tuple[NodeId, ...]:
        """With whom this node counts."""
        return self._fleet.electors if self.roll is None else self.roll.value.electorate.names

    @property
    def revision(self) -> int:
        """Of the learnt fleet value; 0 while no change has touched it."""
        return 0 if self.changed is None else self.changed.revision

    @property
    def number(self) -> int:
        """Likewise."""
        return 0 if self.changed is None else self.changed.number

    # --- what is heard -----------------------------------------------------------------------------------------------

    def turned_away(self, question: Prepare | Accept, asker: NodeId, todo: ToDo) -> Refused | None:
        """The no to a question that names another number or creation; ``None``: its register answers."""
        if self.roll is None:
            return None
        admission = self.roll.admission(question, asker, todo)
        self._carry(todo)
        return self.roll.refused(question) if admission is Admission.REFUSED else None

    def hear(self, answer: Refused, todo: ToDo, now: float) -> bool:
        """An elector has refused; whether this node counts by another fleet value from now on."""
        before = self.roll and self.roll.value
        if self.roll is not None:
            self.roll.hear(answer, todo, now)
            self._carry(todo)
        return self.roll is not None and self.roll.value is not before

    def learn(self, value: FleetValue, todo: ToDo, now: float) -> bool:
        """A peer has answered what it has learnt; whether this node counts by it from now on."""
        before = self.roll and self.roll.value
        if self.roll is not None:
            self.roll.learn(value, todo, now)
        return self.roll is not None and self.roll.value is not before

    def _carry(self, todo: ToDo) -> None:
        """Ask for, or tell, what was learnt: fleet values travel with the tasks' values."""
        for order in todo.fleet:
            if isinstance(order, do.AskFleet):
                todo.add(do.AskLearnt(peer=order.peer, deadline_s=self._fleet.timing.ballot_s))
            elif isinstance(order, do.TellFleet):
                todo.must_beat = True  # the beat shows the revision, and peers ask
        todo.fleet.clear()
