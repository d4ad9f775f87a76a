"""The numbers by which one node's agreement counts: founded from its file and state, learnt, or changed by itself.

Knows: when a node founds a fleet value, what of it goes to disk and into messages, that a value's document comes before
the value. Does not know: what an elector answers beyond that (`zsched.core.vote.acceptor`), how anything travels, who
wants a change (`zsched.core.electorate.orders`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from random import Random
from types import MappingProxyType

from zsched.core.electorate.changes import AddElector, AdoptDocument, FleetChange, SetDocument
from zsched.core.electorate.documents import Documents
from zsched.core.electorate.founding import founded
from zsched.core.electorate.roll import Admission, Roll
from zsched.core.register.task_register import TaskRegister
from zsched.core.values import instructions as do
from zsched.core.values.adoption import obstacle
from zsched.core.values.change import Rewrite
from zsched.core.values.document import Flag
from zsched.core.values.durable import DurableState
from zsched.core.values.electorate import Creation, FleetValue
from zsched.core.values.fleet import Fleet
from zsched.core.values.in_force import InForce
from zsched.core.values.messages import Accept, Accepted, Prepare, Promise, Refusal, Refused
from zsched.core.values.model import NO_BALLOT, NodeId, RegisterState, TaskId
from zsched.core.values.problems import Problem, ProblemKey
from zsched.core.values.struct import replace
from zsched.core.values.todo import ToDo


class Numbers:
    """One node's roll, from the moment on at which the node knows its generation.

    Args:
        here: what this node goes by: its fleet file, or the agreed document.
        me: this node.
        durable: its state, or ``None``.
        incarnation: of this daemon.
        registers: its tasks' registers, which the roll renumbers.
        recall: what the state holds of a created task that has no register yet; ``None``: nothing.
        rng: for back-off.
        stored: {hash: what it says} of the documents on this node's disk that its state names.
        flags: {hash: its flags} of those of them that have any.
    """

    def __init__(
        self,
        *,
        here: InForce,
        me: NodeId,
        durable: DurableState | None,
        incarnation: int,
        registers: dict[TaskId, TaskRegister],
        recall: Callable[[Creation], RegisterState | None],
        rng: Random,
        stored: Mapping[str, Fleet],
        flags: Mapping[str, tuple[Flag, ...]] = MappingProxyType({}),
    ) -> None:
        self._here, self._me, self._incarnation = here, me, incarnation
        self._registers, self._recall, self._rng = registers, recall, rng
        self.disk = "" if durable is None else durable.disk
        self._stored = None if durable is None else durable.fleet_register
        self._joins = "" if durable is None else durable.joins
        self.documents = Documents(me, stored, flags)
        self.roll: Roll | None = None
        self._before = ""
        """The document that was in force before this one: it is kept, too."""
        self._held_for: FleetValue | None = None
        """The newest value that a peer has told as learnt, while its document is missing."""

    @property
    def _fleet(self) -> Fleet:
        return self._here.fleet

    def begin(self, generation: int, electorate: str, todo: ToDo, now: float, *, may_elect: bool) -> None:
        """The generation is known: count by what the state holds, or by what every node makes of its file."""
        first = founded(self._fleet.name, generation, self._fleet.electors)
        if self._joins:  # who knows nothing of that generation but its id waits for the first word of it
            first = replace(first, generation_id=self._joins)
        self.roll = Roll(
            me=self._me,
            disk=self.disk,
            incarnation=self._incarnation,
            state=self._stored or RegisterState(task=self._fleet.name, learnt=first),
            registers=self._registers,
            begin=self._created,
            holds=self._may_follow,
            electorate=electorate,
            clocks=self._here.clocks,
            rng=self._rng,
            now=now,
            may_elect=may_elect,
        )
        if not self.documents.holds(self.roll.value):
            self._want(self.roll.value, (), todo, now)

    def _may_follow(self, value: FleetValue) -> bool:
        """Whether a value's document is stored here, and its tasks are the value's: no change brings others."""
        fleet = self.documents.fleet(value.document)
        if fleet is None:
            return self.documents.holds(value)
        return {task.name for task in fleet.tasks} == {one.task for one in value.tasks}

    def _created(self, creation: Creation) -> TaskRegister | None:
        """The register of a task that the document lists, mostly a blank one; its electors are told by the roll."""
        stored = None if self._stored is None else self._stored.learnt
        value = stored if self.roll is None else self.roll.value
        fleet = self._fleet if value is None else self.documents.fleet(value.document)
        task = None if fleet is None else next((one for one in fleet.tasks if one.name == creation.task), None)
        if task is None:
            return None  # its document is missing: it is fetched
        return TaskRegister(
            me=self._me,
            incarnation=self._incarnation,
            electors=(),
            electorate="",
            is_elector=False,
            initial=task.first_value(creation.start),
            state=self._recall(creation) or RegisterState(task=creation.task, creation=creation.number),
            clocks=self._here.clocks,
            rng=self._rng,
            disk=self.disk,
        )

    def count_in(self, register: TaskRegister, now: float) -> None:
        """A register begins by the file: it counts as the others do."""
        if self.roll is not None:
            count, is_elector = self.roll.value.electorate, self.roll.is_elector
            register.count_with(count, is_elector=is_elector, is_blank=False, now=now)

    # --- queries -----------------------------------------------------------------------------------------------------

    @property
    def value(self) -> FleetValue | None:
        """The learnt fleet value; ``None`` while the generation is not known."""
        return None if self.roll is None else self.roll.value

    @property
    def is_named(self) -> bool:
        """Whether this node's generation has an id that its fleet file does not tell."""
        return bool(self._joins) or self.changed is not None

    @property
    def is_waiting(self) -> bool:
        """Whether this node is to join a generation of which it has learnt nothing yet."""
        return bool(self._joins) and self.changed is None and self._stored is None

    @property
    def changed(self) -> FleetValue | None:
        """The learnt fleet value; ``None`` while it is the one that every node makes of its file."""
        value = self.value
        return None if value is None or value.is_founding else value

    @property
    def state(self) -> RegisterState[FleetValue] | None:
        """What goes to disk."""
        state = None if self.roll is None else self.roll.state
        has_voted = state is not None and (state.promised != NO_BALLOT or state.accepted is not None)
        return state if self.changed is not None or has_voted else None

    @property
    def in_force(self) -> Fleet | None:
        """What this node goes by: the agreed document, electors and length of leases.

        ``None``: its file, or the document is not stored here.
        """
        value = self.changed
        fleet = None if value is None else self.documents.fleet(value.document)
        return None if fleet is None or value is None else in_force(fleet, value)

    @property
    def file_lease_s(self) -> float:
        """The length of leases by which this node goes; by its file, until a document is agreed."""
        return self._fleet.timing.lease_s

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

    @property
    def problems(self) -> dict[ProblemKey, str]:
        """{(kind, subject): what does not work here as it should}."""
        roll, kind, text = self.roll, Problem.DOCUMENT, ""
        for one, (kind, why) in self.documents.refused.items():  # noqa: B007 - the newest one's stays
            text = f"the agreed document {one[:8]} cannot be used here, this node goes on by its last one: {why}"
        for one, why in self.documents.unwritten.items():
            kind = Problem.DOCUMENT
            text = f"the document {one[:8]} cannot be stored here, this node tries again in some seconds: {why}"
        if not text and roll is not None and not self.documents.holds(roll.value):
            text = f"the agreed document {roll.value.document[:8]} is not on this disk: this node asks its peers"
        found: dict[ProblemKey, str] = {("fleet/register", ""): "" if roll is None else roll.problem, (kind, ""): text}
        return {key: told for key, told in found.items() if told}

    def next_deadline(self) -> float:
        """When `tick` may have something to do."""
        due = math.inf if self.roll is None else self.roll.next_deadline()
        return min(due, self.documents.next_deadline())

    # --- elector -----------------------------------------------------------------------------------------------------

    def is_foreign(self, question: Prepare | Accept) -> bool:
        """Whether a question is of another generation: it gets no answer.

        Nodes that all go by their files refuse each other instead, by the generation that operators count.
        """
        ours = self.value
        if ours is None or not question.generation_id or question.generation_id == ours.generation_id:
            return False
        return self.is_named or question.number > 1

    def turned_away(self, question: Prepare | Accept, asker: NodeId, todo: ToDo) -> Refused | None:
        """The no to a question that names another number or creation; ``None``: its register answers."""
        if self.roll is None:
            return None
        admission = self.roll.admission(question, asker, todo)
        self._carry(todo)
        return self.roll.refused(question) if admission is Admission.REFUSED else None

    def on_question(
        self,
        question: Prepare | Accept[FleetValue],
        asker: NodeId,
        todo: ToDo,
        now: float,
        refusal: Refusal | None = None,
    ) -> Promise[FleetValue] | Accepted | Refused | None:
        """A proposer asks the fleet register; ``None``: no answer. ``refusal``: why this elector says no to any."""
        if self.roll is None:
            return None
        answer = self.roll.on_question(question, asker, todo, now, refusal)
        if isinstance(answer, Refused) and answer.refusal is Refusal.DOCUMENT and not isinstance(question, Prepare):
            self._want(question.acceptance.value, (asker,), todo, now)
        if isinstance(answer, Accepted):
            self._keep(self.roll, todo)
        self._carry(todo)
        return answer

    # --- what is heard -----------------------------------------------------------------------------------------------

    def hear(self, answer: Refused, todo: ToDo, now: float) -> bool:
        """An elector has refused; whether this node counts by another fleet value from now on."""
        before = self.value
        if self.roll is not None:
            self.roll.hear(self._readable(answer, todo, now), todo, now)
            self._after(before, todo)
        return self.value is not before

    def is_possible(self, answer: Promise[FleetValue] | Accepted | Refused) -> bool:
        """Whether an elector of the fleet register can have accepted what it tells."""
        return self.roll is None or self.roll.is_possible(answer)

    def on_answer(self, answer: Promise[FleetValue] | Accepted | Refused, todo: ToDo, now: float) -> bool:
        """An elector answered our question to its fleet register; whether this node counts by another value now."""
        before = self.value
        if self.roll is not None:
            if isinstance(answer, Refused):
                answer = self._readable(answer, todo, now)
            self.roll.on_answer(answer, todo, now)
            if self.roll.lacking is not None:
                self._want(self.roll.lacking, self.electors, todo, now)
            if not self.documents.holds(self.roll.value):  # it went while the round that has chosen the value ran
                self._want(self.roll.value, self.electors, todo, now)
            self._after(before, todo)
        return self.value is not before

    def has_accepted(self, value: FleetValue) -> bool:
        """Whether this elector has itself accepted this very value, and not learnt it yet."""
        return self.roll is not None and self.roll.has_accepted(value)

    def learn(self, value: FleetValue, teller: NodeId, todo: ToDo, now: float) -> bool:
        """A peer has answered what it has learnt; whether this node counts by it from now on."""
        before = self.value
        if self.roll is not None:
            if self.is_news(value) and not self.documents.holds(value):
                self._hold(value, teller, todo, now)
            self.roll.learn(value, todo, now)
            self._after(before, todo)
        return self.value is not before

    def is_news(self, value: FleetValue) -> bool:
        """Whether a fleet value is of this generation, and newer than the learnt one."""
        ours = self.value
        if ours is None or (value.fleet, value.generation_id) != (ours.fleet, ours.generation_id):
            return False
        return value.revision > ours.revision

    def _readable(self, answer: Refused, todo: ToDo, now: float) -> Refused:
        """A refusal without its fleet value if that one's document is still to be fetched."""
        value = answer.fleet
        if value is None or not self.is_news(value) or self.documents.holds(value):
            return answer
        self._hold(value, answer.elector, todo, now)
        return replace(answer, fleet=None)

    def _hold(self, value: FleetValue, teller: NodeId, todo: ToDo, now: float) -> None:
        """Keep a learnt value until its document is here."""
        if self._held_for is None or value.revision >= self._held_for.revision:
            self._held_for = value
        self._want(value, (teller,), todo, now)

    def _want(self, value: FleetValue, first: tuple[NodeId, ...], todo: ToDo, now: float) -> None:
        """Fetch a document: from who told of it, from an elector, or from any node."""
        others = [*value.electorate.names, *(node.name for node in self._fleet.nodes)]
        peers = tuple(dict.fromkeys((*first, *others)))
        self.documents.want(value, peers, todo, now)

    @property
    def flags(self) -> tuple[Flag, ...]:
        """What operators have said of nodes, by the document in force; nothing while it is not stored here."""
        value = self.value
        return () if value is None else self.documents.flags(value.document)

    def on_stored(self, document: str, fleet: Fleet, todo: ToDo, now: float, *, flags: tuple[Flag, ...] = ()) -> bool:
        """A document is on disk, and valid; whether this node goes by another fleet from now on."""
        was_missing = self.roll is not None and not self.documents.holds(self.roll.value)
        self.documents.on_stored(document, fleet, todo, flags)
        if self.roll is None:
            return False
        before = self.value
        if was_missing and self.documents.holds(self.roll.value):
            self.roll.list_again(todo, now)
            self._adopt(todo)
        held = self._held_for
        if held is not None and self.documents.holds(held):
            self._held_for = None
            self.roll.learn(held, todo, now)
            self._after(before, todo)
        return self.value is not before or was_missing

    def _after(self, before: FleetValue | None, todo: ToDo) -> None:
        """A fleet value may have been learnt: keep its document, and let the stages go by it."""
        roll = self.roll
        if roll is not None and before is not None and (value := roll.value) is not before:
            if value.document != before.document:
                self._before = before.document
            if self._held_for is not None and self._held_for.revision <= value.revision:
                self._held_for = None
            if self.documents.holds(value):
                self.documents.refused.clear()
            self._keep(roll, todo)
            self._adopt(todo)
        self._carry(todo)

    def _adopt(self, todo: ToDo) -> None:
        fleet = self.in_force
        if fleet is not None:
            todo.in_force = fleet

    def _keep(self, roll: Roll, todo: ToDo) -> None:
        """The state's documents, the one before, and those of our own changes: others may go."""
        accepted = roll.state.accepted
        state = (roll.value.document, self._before, "" if accepted is None else accepted.value.document)
        named = (*state, *roll.proposed)
        self.documents.keep(tuple(dict.fromkeys(filter(None, named))), todo)

    # --- proposer ----------------------------------------------------------------------------------------------------

    def fault(self, change: Rewrite[FleetValue]) -> str:
        """Why a change cannot be made now; empty: it can."""
        value = self.value
        if value is None:
            return "this node does not know the fleet's generation yet"
        if isinstance(change, AddElector):
            is_known = any(node.name == change.name for node in self._fleet.nodes)
            return change.fault(value) or ("" if is_known else f"{change.name} is no node of the fleet")
        if isinstance(change, AdoptDocument | SetDocument):
            return change.fault(value) or self._fault_of_document(change.document)
        return change.fault(value) if isinstance(change, FleetChange) else ""

    def _fault_of_document(self, document: str) -> str:
        fleet = self.documents.fleet(document)
        if fleet is None:
            return f"the document {document[:8]} is not stored here"
        if why := self.obstacle(fleet):
            return why
        names = {node.name for node in fleet.nodes}
        gone = [name for name in self.electors if name not in names]
        return f"{', '.join(gone)}: an elector, and not in the document; remove it as an elector first" if gone else ""

    def obstacle(self, fleet: Fleet) -> str:
        """Why this daemon cannot take a document over while it runs; empty: it can."""
        return obstacle(self._fleet, fleet, self._me)

    def propose(self, change: FleetChange, todo: ToDo, now: float) -> str:
        """Try to commit a change; why it cannot be made, or nothing. Its end is one of `ToDo.fleet_ended`."""
        fault = self.fault(change)
        if not fault and self.roll is not None:
            self.roll.propose(change, todo, now)
            self._keep(self.roll, todo)
            self._carry(todo)
        return fault

    def settle(self, todo: ToDo, now: float) -> None:
        """After a start: an elector that has accepted a value, and has not learnt it, looks what became of it."""
        if self.roll is not None and self.roll.is_elector and self.roll.is_unlearnt:
            self.roll.settle(todo, now)
            self._carry(todo)

    def tick(self, todo: ToDo, now: float) -> None:
        """Time has passed."""
        if self.roll is not None and now >= self.roll.next_deadline():
            self.roll.tick(todo, now)
            self._carry(todo)
        if now >= self.documents.next_deadline():
            self.documents.tick(todo, now)

    def _carry(self, todo: ToDo) -> None:
        """Ask for, or tell, what was learnt: fleet values travel with the tasks' values."""
        for order in todo.fleet:
            if isinstance(order, do.AskFleet):
                ask = do.AskLearnt(peer=order.peer, deadline_s=self._here.timing.ballot_s)
                if ask not in todo.send:  # a frame may hold many questions under a number that is not known here
                    todo.add(ask)
            elif isinstance(order, do.TellFleet):
                todo.must_tell = True  # who hears it asks
            else:
                todo.add(order)
        todo.fleet.clear()


def in_force(fleet: Fleet, value: FleetValue) -> Fleet:
    """What a node goes by: a document, with the electors and the length of leases that are agreed."""
    return replace(fleet, electors=value.electorate.names, timing=replace(fleet.timing, lease_s=value.lease_s))


def known_at_start(fleet: Fleet, durable: DurableState | None, stored: Mapping[str, Fleet]) -> Fleet:
    """What a node goes by at its start: ``fleet``, or less, while the document that its state names is not on its disk.

    Of its fleet file it has the tasks then whose registers are the agreed ones. Of any other task it knows nothing yet.
    """
    register = None if durable is None else durable.fleet_register
    value = None if register is None else register.learnt
    if durable is None or value is None or not value.document or value.document in stored:
        return fleet
    agreed = {(one.task, one.number) for one in value.tasks}
    held = {one.task for one in durable.registers if (one.task, one.creation) in agreed}
    return replace(fleet, tasks=tuple(task for task in fleet.tasks if task.name in held))
