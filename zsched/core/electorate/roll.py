"""The roll: which fleet value a node has learnt, and what follows for whom it answers and with whom it counts.

Knows: the fleet register, numbers, seats, creations. Does not know: what an allocation means, how anything travels or
is stored, how a document is fetched.

* Every question names generation and number. An elector answers only under the very number that it has learnt, and only
  for a seat that names its disk. Asked under a lower number it hands its fleet value over; under a higher one it asks
  for that. Another generation gets no answer.
* The learnt fleet value is on disk before the first answer under it: it is written with the registers (`ToDo`).
* Only a learnt value is followed and handed on, never an accepted one.
* A node follows the newest value of its own generation, from any peer.
* A seat is (name, disk, joining). A node that gets another seat, or none, drops what it had accepted for the old one.
* A register that the document does not list is removed, and questions to it are refused.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from random import Random

from zsched.core.electorate.changes import AdoptDocument, FleetChange, SetDocument
from zsched.core.electorate.settling import Settling
from zsched.core.register.fleet_register import FleetRegister
from zsched.core.register.task_register import TaskRegister
from zsched.core.values.electorate import Creation, Elector, FleetValue
from zsched.core.values.fleet import Timing
from zsched.core.values.instructions import AskFleet, TellFleet
from zsched.core.values.messages import Accept, Accepted, Prepare, Promise, Refusal, Refused
from zsched.core.values.model import NO_BALLOT, Ballot, NodeId, RegisterState, TaskId
from zsched.core.values.todo import ToDo


class Admission(StrEnum):
    """What becomes of a question before its register sees it."""

    PASSED = "passed"
    REFUSED = "refused"
    SILENT = "silent"  # another generation's, or this node follows none


class Roll:
    """One node's fleet register, and the numbers by which its tasks' registers count.

    Args:
        me: this node's name.
        disk: its disk's id.
        incarnation: this start's number.
        state: of the fleet register, as stored or founded; its learnt value is the one to follow.
        registers: the tasks' registers; the roll adds, removes and renumbers them.
        begin: makes the blank register of a task that was created; ``None``: nothing is known of the task yet.
        clocks: those in force: of them a phase's deadline and the base of the back-off.
        rng: for back-off.
        now: monotonic seconds.
        holds: whether the document of a fleet value is stored here; without it no value is accepted or learnt.
        electorate: hash of the fleet file's electors, which nodes compare until a change has touched them.
        may_elect: whether this node may be an elector at all: it has its state, and nobody disputes its name.
    """

    def __init__(
        self,
        *,
        me: NodeId,
        disk: str,
        incarnation: int,
        state: RegisterState[FleetValue],
        registers: dict[TaskId, TaskRegister],
        begin: Callable[[Creation], TaskRegister | None],
        clocks: Callable[[], Timing],
        rng: Random,
        now: float,
        holds: Callable[[FleetValue], bool] = lambda _value: True,
        electorate: str = "",
        may_elect: bool = True,
    ) -> None:
        if state.learnt is None:
            raise ValueError("a roll follows a fleet value: none is learnt")
        self._me, self._disk = me, disk
        self._registers, self._begin = registers, begin
        self._clocks, self._rng = clocks, rng
        self._may_elect = may_elect
        self.value = state.learnt
        self._seated = self.value, self._seat_in(self.value)
        self._register = FleetRegister(
            me=me,
            incarnation=incarnation,
            electors=self.value.electorate.names,
            electorate=electorate,
            is_elector=self.is_elector,
            initial=self.value,
            state=state,
            clocks=clocks,
            rng=rng,
            disk=disk,
        )
        self._holds = self._register.holds = holds
        self._settling = Settling(clocks)
        self._list(ToDo(), now)
        self._count(is_blank=False, is_new=False, now=now)
        if not self.value.settled:
            self._settling.begin(self.value, now + self._jitter(), self._rank())

    # --- queries -----------------------------------------------------------------------------------------------------

    @property
    def state(self) -> RegisterState[FleetValue]:
        """What goes to disk, with the registers' states."""
        return self._register.state

    @property
    def seat(self) -> Elector | None:
        """The seat for which this node answers."""
        if self._seated[0] is not self.value:  # it is asked for at every deadline
            self._seated = self.value, self._seat_in(self.value)
        return self._seated[1]

    @property
    def is_elector(self) -> bool:
        """Whether this node answers questions."""
        return self.seat is not None and self._may_elect

    @property
    def problem(self) -> str:
        """Why agreement about the fleet stands still; empty: it does not."""
        return self._register.problem

    @property
    def is_busy(self) -> bool:
        """Whether a change of this node's is under way."""
        return self._register.is_busy

    @property
    def is_unlearnt(self) -> bool:
        """Whether this node has accepted a fleet value that it has not learnt."""
        return self._register.is_unlearnt

    @property
    def lacking(self) -> FleetValue | None:
        """A value that a round has read, and whose document is not stored here; the round waits for it."""
        return self._register.lacking

    @property
    def proposed(self) -> tuple[str, ...]:
        """The documents of the changes that are under way here or wait."""
        return tuple(one.document for one in self._register.wanted if isinstance(one, AdoptDocument | SetDocument))

    def next_deadline(self) -> float:
        """When `tick` may have something to do."""
        due = self._register.next_deadline()
        return min(due, self._settling.due(self.value, self._registers.values())) if self.is_elector else due

    def _seat_in(self, value: FleetValue) -> Elector | None:
        seat = value.electorate.seat(self._me)
        return seat if seat is not None and seat.is_held_by(self._me, self._disk) else None

    def _rank(self) -> int:
        """How many electors settle before this one, if all of them have learnt the value."""
        names = self.value.electorate.names
        return names.index(self._me) if self._me in names else len(names)

    def _jitter(self) -> float:
        return self._clocks().stagger_s * (0.5 + self._rng.random())

    # --- elector -----------------------------------------------------------------------------------------------------

    def stop_electing(self) -> None:
        """This node lost its right to be an elector (disk, duplicate name) and answers no more."""
        self._may_elect = False
        self._register.stop_electing()
        for register in self._registers.values():
            register.stop_electing()

    def may_elect_again(self, todo: ToDo) -> None:
        """This node may be added as an elector again: it has no seat, and what it lost belonged to an old one."""
        self._may_elect = True
        todo.must_persist = True

    def admission(self, question: Prepare | Accept | Accept[FleetValue], asker: NodeId, todo: ToDo) -> Admission:
        """Whether a question to a task's register, or to the fleet register, may be put to it.

        A refusal's reason is told by `refused`; what the two sides must tell each other is in ``todo``.
        """
        value = self.value
        if value.electorate.is_founding and not question.generation_id:
            return Admission.PASSED  # of a node that knows no fleet values: its electorate tells all
        if question.generation_id != value.generation_id:
            return Admission.SILENT
        if question.number > value.number:
            todo.fleet.append(AskFleet(peer=asker))
        if question.number != value.number:
            return Admission.REFUSED
        return Admission.PASSED if self._is_listed(question) else Admission.REFUSED

    def _is_listed(self, question: Prepare | Accept | Accept[FleetValue]) -> bool:
        """Whether the register that is asked is the fleet's, or one of a task that the document lists."""
        if not self.value.document or question.task == self.value.task:
            return True
        creation = self.value.creation(question.task)
        return creation is not None and creation.number == question.creation

    def refused(self, question: Prepare | Accept | Accept[FleetValue]) -> Refused:
        """The no to a question that `admission` has refused; a proposer with a lower number learns by it."""
        register = self._registers.get(question.task)
        is_behind = question.number < self.value.number
        return Refused(
            elector=self._me,
            task=question.task,
            ballot=_ballot_of(question),
            refusal=Refusal.NUMBER,
            promised=NO_BALLOT if register is None else register.state.promised,
            number=self.value.number,
            fleet=self.value if is_behind else None,
        )

    def on_question(
        self,
        question: Prepare | Accept[FleetValue],
        asker: NodeId,
        todo: ToDo,
        now: float,
        refusal: Refusal | None = None,
    ) -> Promise[FleetValue] | Accepted | Refused | None:
        """A proposer asks the fleet register; ``None``: no answer.

        ``refusal``: a reason outside the register, for which a question that is admitted gets a no.
        """
        if question.task != self.value.task:
            return None  # what it brings is no value of this register, and nothing could follow it
        admission = self.admission(question, asker, todo)
        if admission is Admission.SILENT:
            return None
        if admission is Admission.REFUSED:
            return self.refused(question)
        if refusal is not None:
            return self._register.refuse(_ballot_of(question), refusal)
        if isinstance(question, Prepare):
            return self._register.on_prepare(question, todo)
        if question.acceptance.value.generation_id != self.value.generation_id:
            return None
        if not self._holds(question.acceptance.value) and self._register.would_accept(question):
            return self._register.refuse(_ballot_of(question), Refusal.DOCUMENT)
        return self._register.on_accept(question, todo, now)

    # --- learner -----------------------------------------------------------------------------------------------------

    def has_accepted(self, value: FleetValue) -> bool:
        """Whether this elector has itself accepted this very value, and not learnt it yet."""
        accepted = self.state.accepted
        return self.is_elector and self.is_unlearnt and accepted is not None and accepted.value == value

    def learn(self, value: FleetValue, todo: ToDo, now: float) -> None:
        """A peer tells the fleet value that it has learnt."""
        if (value.fleet, value.generation_id) != (self.value.fleet, self.value.generation_id):
            return
        if self._holds(value):
            self._register.learn(value, todo, now)
            self._follow(todo, now)

    def hear(self, answer: Refused, todo: ToDo, now: float) -> None:
        """An elector has refused because of its number: one of the two learns."""
        if answer.fleet is not None:
            self.learn(answer.fleet, todo, now)
        elif answer.refusal is Refusal.NUMBER and answer.number < self.value.number:
            todo.fleet.append(TellFleet(to=(answer.elector,), value=self.value))

    def _follow(self, todo: ToDo, now: float, *, is_ours: bool = False) -> None:
        """Count by the newest learnt value, before anything is answered or asked under another one.

        ``is_ours``: a round of this node has found it chosen, so it settles before all others.
        """
        value = self._register.value
        if value.revision == self.value.revision:
            return
        seat, number = self.seat, self.value.number
        self.value = value
        todo.must_persist = todo.must_beat = True
        if self._holds(value):  # else it went while its round ran: stages go by the tasks of before until it is back
            self._list(todo, now)
        if value.number != number:
            self._count(is_blank=seat != self.seat, is_new=True, now=now)
        if is_ours:  # nobody else knows that this is chosen yet
            self._settling.begin(value, now, 0)
        else:
            self._settling.begin(value, now + self._jitter(), 1 + self._rank())

    def _list(self, todo: ToDo, now: float) -> None:
        """Remove the registers that the document does not list, and begin those that are new."""
        if not self.value.document:
            return  # each node goes by its own file
        for task in tuple(self._registers):
            creation = self.value.creation(task)
            if creation is None or creation.number != self._registers[task].state.creation:
                self._registers.pop(task).close(todo)
        for creation in self.value.tasks:
            register = None if creation.task in self._registers else self._begin(creation)
            if register is not None:
                self._registers[creation.task] = register
                register.count_with(self.value.electorate, is_elector=self.is_elector, is_blank=False, now=now)

    def list_again(self, todo: ToDo, now: float) -> None:
        """The document of the value in force was not stored here at the start, and is now."""
        self._list(todo, now)

    def _count(self, *, is_blank: bool, is_new: bool, now: float) -> None:
        """Tell every register with whom it counts; the fleet register is blank under a new number."""
        count, is_elector = self.value.electorate, self.is_elector
        for register in self._registers.values():
            register.count_with(count, is_elector=is_elector, is_blank=is_blank, now=now)
        self._register.count_with(count, is_elector=is_elector, is_blank=is_new, now=now)

    # --- proposer ----------------------------------------------------------------------------------------------------

    def propose(self, change: FleetChange, todo: ToDo, now: float) -> str:
        """Try to commit a change; why it cannot be made, or nothing. Its end is one of `ToDo.fleet_ended`."""
        fault = change.fault(self.value)
        if not fault:
            self._register.propose(change, todo, now)
        return fault

    def settle(self, todo: ToDo, now: float) -> None:
        """Run an identity round: learn whatever was accepted before."""
        self._register.settle(todo, now)

    def is_possible(self, answer: Promise[FleetValue] | Accepted | Refused) -> bool:
        """Whether an elector can have accepted what its promise tells."""
        return self._register.is_possible(answer)

    def on_answer(self, answer: Promise[FleetValue] | Accepted | Refused, todo: ToDo, now: float) -> None:
        """An elector answered a question of the fleet register."""
        before = self.value
        if isinstance(answer, Refused):
            self.hear(answer, todo, now)
        self._register.on_answer(answer, todo, now)
        self._follow(todo, now, is_ours=True)
        if self.value is not before and not (isinstance(answer, Refused) and answer.fleet is self.value):
            names = {*before.electorate.names, *self.value.electorate.names} - {self._me}
            todo.fleet.append(TellFleet(to=tuple(sorted(names)), value=self.value))

    def tick(self, todo: ToDo, now: float) -> None:
        """Time has passed."""
        if now >= self._register.next_deadline():
            self._register.tick(todo, now)
        if not self.is_elector or now < self._settling.due(self.value, self._registers.values()):
            return
        change = self._settling.tick(self.value, self._registers.values(), todo, now)
        if change is None and not self.value.is_exclusive:
            self._register.prepare_ahead(todo, now)  # a round trip less once the tasks' registers are written
        elif change is not None and not self._register.is_busy:
            self._register.propose_prepared(change, todo, now)


def _ballot_of(question: Prepare | Accept | Accept[FleetValue]) -> Ballot:
    return question.ballot if isinstance(question, Prepare) else question.acceptance.ballot
