"""VOTE, between the registers and the node: one register per task, the durable state they share, the messages.

Knows: which messages a register's step becomes, what is learnt of whom, what goes to disk. Does not know: the rules of
a round (`zsched.core.register.register`), what a proposer is answered (`zsched.core.vote.acceptor`), the effect of a
learnt allocation (the node applies it).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from random import Random
from types import MappingProxyType

from zsched.core.electorate.changes import FleetChange
from zsched.core.electorate.helm import Helm, voters
from zsched.core.electorate.numbers import Numbers
from zsched.core.electorate.orders import Orders
from zsched.core.electorate.strangers import SHOWN_S, Strangers
from zsched.core.register.task_register import TaskRegister
from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.beat import Beat
from zsched.core.values.change import Change, Ended, MoveOwner, RoundOutcome
from zsched.core.values.document import Flag
from zsched.core.values.durable import DurableState
from zsched.core.values.electorate import TOLD_DIGITS, Creation, Elector, FleetValue, terms_of
from zsched.core.values.fleet import Fleet, TaskSpec
from zsched.core.values.in_force import InForce
from zsched.core.values.lease import hold_s
from zsched.core.values.messages import Accepted, FleetQuestion, Learnt, Promise, Refused, votes_of
from zsched.core.values.model import NO_BALLOT, Allocation, NodeId, RegisterState, TaskId
from zsched.core.values.problems import Problem, ProblemKey
from zsched.core.values.struct import replace
from zsched.core.values.todo import ToDo
from zsched.core.values.words import CREATION_STEP, shown
from zsched.core.vote.acceptor import Acceptor
from zsched.core.vote.belief import GENERATION_STEP, MAX_GENERATION, is_fleet_fit, is_proven
from zsched.core.vote.commands import answer_end, refuse_gone
from zsched.core.vote.generations import lost_text, moved_text
from zsched.core.vote.lease import Leases
from zsched.core.vote.questions import ASK_AT_ONCE_S, ASK_LEARNT_EVERY_S, Questions
from zsched.core.vote.witness import Witness, as_seen, as_tuple

SETTLE = "`zsched fleet recover --settle`, with its daemon stopped"
SETTLE_AFTER_START_S = 0.3
"""A starting elector learns first what was accepted before (an identity round), once its peers are connected."""


class Agreement:
    """All registers of one node.

    Args:
        in_force: the fleet that the node goes by.
        me: this node's name.
        durable: what the state file holds; ``None``: this node is no elector.
        incarnation: this start's number, part of every ballot.
        electorate: hash of the electorate in force.
        rng: for back-off.
        now: monotonic seconds.
        stored: {hash: what it says} of the documents on this node's disk that its state names.
        flags: {hash: its flags} of those of them that have any.
    """

    def __init__(
        self,
        *,
        in_force: InForce,
        me: NodeId,
        durable: DurableState | None,
        incarnation: int,
        electorate: str,
        rng: Random,
        now: float,
        stored: Mapping[str, Fleet] = MappingProxyType({}),
        flags: Mapping[str, tuple[Flag, ...]] = MappingProxyType({}),
    ) -> None:
        self._in_force, self._me = in_force, me
        fleet = in_force.fleet
        self._durable = durable
        self.generation = None if durable is None else durable.generation
        """``None``: this node has no state, and has not been told yet which one the fleet is of."""
        self.newest_generation = self.generation or 0
        """The highest generation of any beat; the operator's next one must exceed it."""
        self.apart: set[NodeId] = set()
        """Electors of another generation, or with other electors in their file, by their newest beat.

        That file may leave them out: then they call themselves no electors.
        """
        self._has_state, self._electorate = durable is not None, electorate
        self._disputed = "" if durable is None else durable.disputed
        self._lost = "" if durable is None else durable.lost
        self.witness = Witness(
            me=me,
            electors=fleet.electors,
            in_force=in_force,
            incarnation=incarnation,
            votes=0 if durable is None else durable.votes,
            started_at=now,
            seen={} if durable is None else as_seen(durable.seen),
        )
        self.voted = set() if durable is None else set(durable.voted)
        is_elector = durable is not None and me in fleet.electors and not self._disputed and not self._lost
        self._problems: dict[ProblemKey, str] = {}
        self.behind: dict[NodeId, tuple[int, float, float]] = {}
        """{node of another generation: (that one, since when it says so, when it last did)}; each has its problem."""
        if durable is not None and self._lost:
            value = None if durable.fleet_register is None else durable.fleet_register.learnt
            self._complain_of_loss(is_agreed=value is not None and bool(value.document))
        if self._disputed:
            self._problems[Problem.STATE, ""] = f"{self._disputed}; no elector until {SETTLE}"
        self.counters: Counter[str] = Counter()
        # A state of today's names no creations: its registers are those of its generation.
        held = () if durable is None else durable.registers
        creation = self.generation or 0
        states = {state.task: replace(state, creation=state.creation or creation) for state in held}
        agreed = None if durable is None or durable.fleet_register is None else durable.fleet_register.learnt
        self._incarnation, self._rng = incarnation, rng
        self.registers = {
            task.name: self._register(task, states.get(task.name) or self._blank(task.name, agreed), is_elector)
            for task in fleet.tasks
        }
        # A task that left the fleet file may come back: its promises must not be forgotten.
        self._foreign = tuple(states[name] for name in sorted(states) if name not in self.registers)
        self._numbers = Numbers(
            here=in_force,
            me=me,
            durable=durable,
            incarnation=incarnation,
            registers=self.registers,
            recall=self._recall,
            rng=rng,
            stored=stored,
            flags=flags,
        )
        self.orders = Orders(self._numbers)
        self.strangers = Strangers(in_force=in_force)
        self.helm = Helm(self._numbers, me, clocks=self._in_force.clocks, now=now)
        self.at_start = ToDo()
        """What the first batch must do: fetch a document that is missing."""
        if self.generation is not None:
            may_elect = durable is not None and not self._disputed and not self._lost
            self._numbers.begin(self.generation, self._by_file, self.at_start, now, may_elect=may_elect)
        self._settle_at = now + SETTLE_AFTER_START_S if is_elector else math.inf
        """When what was learnt is written at the latest."""
        self._questions = Questions()
        self.leases = Leases(
            in_force=in_force,
            me=me,
            incarnation=incarnation,
            standing=self.standing() if is_elector else {},
            now=now,
            granted_s=0.0 if durable is None else max(durable.lease_s, self._guard_lease_s),
        )
        if durable is not None and self._numbers.is_waiting:
            self.leases.terms = terms_of(durable.joins, 0)  # beats tell what this node is to join
        self.acceptor = Acceptor(
            in_force=in_force,
            registers=self.registers,
            numbers=self._numbers,
            witness=self.witness,
            leases=self.leases,
            counters=self.counters,
            is_elector=is_elector,
        )
        first = self._numbers.value
        self._seats = {} if first is None else {seat.name: seat for seat in first.electors}
        """{name: the seat to which what is remembered of an elector belongs}."""
        self._count_anew(self.at_start)
        self._seen: list[RegisterState] = []
        """The registers' states from which `values` and `accepted` were made."""
        self._values: dict[TaskId, Allocation] = {}
        self._accepted: dict[TaskId, tuple[NodeId, int]] = {}

    def _register(self, task: TaskSpec, state: RegisterState, is_elector: bool) -> TaskRegister:
        """A task's register. Blank electors have agreed on the first value of its creation, or of a generation."""
        return TaskRegister(
            me=self._me,
            incarnation=self._incarnation,
            electors=self._fleet.electors,
            electorate=self._by_file,
            is_elector=is_elector,
            initial=task.first_value(state.creation * CREATION_STEP),
            state=state,
            disk="" if self._durable is None else self._durable.disk,
            clocks=self._in_force.clocks,
            rng=self._rng,
        )

    def _blank(self, task: TaskId, value: FleetValue | None) -> RegisterState:
        creation = None if value is None else value.creation(task)
        return RegisterState(task=task, creation=(self.generation or 0) if creation is None else creation.number)

    def _recall(self, creation: Creation) -> RegisterState | None:
        """What is remembered of a task that the fleet file lacks, and that the document lists."""
        held = (one for one in self._foreign if (one.task, one.creation) == (creation.task, creation.number))
        return next(held, None)

    def on_fleet(self, todo: ToDo, now: float) -> None:
        """Another fleet is in force: registers of its tasks begin, changes of tasks that go end.

        The roll has the registers of an agreed document already. By a file, the state of a register whose task goes is
        kept, for the task may come back.
        """
        for node in [node for node in self.behind if node not in self._in_force.nodes]:
            self._show_no_more(node)
        kept = dict(self.registers)
        self.registers.clear()  # the roll goes by the same table
        away = {state.task: state for state in self._foreign}
        for task in self._in_force.fleet.tasks:
            register, remembered = kept.pop(task.name, None), away.pop(task.name, None)
            if register is None:
                state = remembered or self._blank(task.name, self._numbers.changed)
                register = self._register(task, state, self.is_elector)
                self._numbers.count_in(register, now)
                self._settle_at = now + SETTLE_AFTER_START_S if self.is_elector else math.inf
            register.begin_with(task.first_value(register.state.creation * CREATION_STEP))
            self.registers[task.name] = register
        for register in kept.values():
            register.close(todo)
            if register.state != RegisterState(task=register.state.task, creation=register.state.creation):
                away[register.state.task] = register.state
        self._foreign = tuple(away[name] for name in sorted(away))
        self.acceptor.refuse_gone(todo)
        self._seen = []
        self.leases.on_tasks(self.standing() if self.is_elector else {}, now)
        todo.must_persist |= self.must_persist

    @property
    def _fleet(self) -> Fleet:
        return self._in_force.fleet

    @property
    def _by_file(self) -> str:
        """Hash of the file's electors, and the generation: by it nodes refuse each other's ballots."""
        return f"{self._electorate}/{self.generation}" if self.generation else self._electorate

    @property
    def electorate(self) -> str:
        """What a beat shows of the electors in force; once a change is learnt, that is their generation."""
        value = self._numbers.changed
        return self._by_file if value is None else f"fleet/{value.generation_id}"

    # --- queries -----------------------------------------------------------------------------------------------------

    @property
    def is_elector(self) -> bool:
        """Whether this node's state and the electors in force let it vote."""
        return self.acceptor.is_elector

    @property
    def problems(self) -> dict[ProblemKey, str]:
        """{(kind, subject): why agreement does not work here as it should}."""
        stuck = {("register", name): register.problem for name, register in self.registers.items() if register.problem}
        strangers = self.strangers.problems(self._numbers.value).items()
        apart: dict[ProblemKey, str] = {(Problem.GENERATION, node): text for node, text in strangers}
        return {**self._problems, **self._numbers.problems, **apart, **stuck}

    def values(self) -> Mapping[TaskId, Allocation]:
        """{task: the newest learnt value}; a new mapping whenever one changes."""
        self._look()
        return self._values

    def _look(self) -> None:
        """See whether a register has changed: thirty beats a second ask, and it seldom has."""
        states = [register.state for register in self.registers.values()]
        if states == self._seen:
            return
        self._seen = states
        self._values = {name: register.value for name, register in self.registers.items()}
        newest = {name: register.newest for name, register in self.registers.items()}
        self._accepted = {
            name: (value.owner, value.epoch)
            for name, value in newest.items()
            if value is not None and value.owner is not None and value.leased
        }

    def learnt(self) -> Learnt:
        """This node's learnt values for others, never accepted ones."""
        values = tuple(value for value in self.values().values() if value.revision > 0)
        return Learnt(
            node=self._me,
            values=values,
            generation=self.generation or 0,
            has_voted=self.has_voted,
            fleet=self._numbers.changed,
        )

    @property
    def votes_kept(self) -> int:
        """How often this life has voted, as its disk knows: what the disk refused was never voted."""
        return 0 if self._durable is None else self.witness.votes

    def answer(self) -> Learnt:
        """This node's answer to a peer: its learnt values, and its memory of electors and of itself."""
        return replace(
            self.learnt(),
            incarnation=0 if self._durable is None else self.witness.incarnation,
            votes=self.votes_kept,
            seen=as_tuple(self.witness.seen),
            lease_terms=self.leases.terms,
        )

    def next_deadline(self) -> float:
        """When `tick` may have something to do."""
        due = min(self._settle_at, self._numbers.next_deadline())
        for register in self.registers.values():
            if (at := register.next_deadline()) < due:
                due = at
        return min(due, self.acceptor.next_deadline())

    def accepted(self) -> Mapping[TaskId, tuple[NodeId, int]]:
        """{leased task: (owner, epoch)} that this elector echoes: from the newest value that it has accepted or learnt.

        Learnt values count too. Otherwise this elector would never echo a value that was committed without it, and with
        another elector away no majority could. An accepted value that is newer than the learnt one comes first, so an
        owner that a newer acceptance replaces is no longer echoed.
        """
        self._look()
        return self._accepted

    def standing(self) -> dict[TaskId, Allocation | None]:
        """{task: the newest value here}: an elector that does not know when it granted accepts only this owner."""
        return {name: register.newest for name, register in self.registers.items()}

    def to_persist(self, now: float) -> DurableState | None:
        """The state to write now, or ``None`` when this node keeps none."""
        if self._durable is None:
            return None
        states = tuple(self.registers[name].state for name in sorted(self.registers))
        self._durable = replace(
            self._durable,
            registers=states if self._is_agreed else (*states, *self._foreign),
            voted=tuple(sorted(self.voted)),
            disputed=self._disputed,
            lease_s=self.leases.to_remember_s(now),
            votes=self.witness.votes,
            seen=as_tuple(self.witness.seen),
            fleet_register=self._numbers.state,
            lost=self._lost,
        )
        return self._durable

    @property
    def _is_agreed(self) -> bool:
        """Whether a document says which tasks have a register: of any other task nothing is remembered.

        While it is not stored here, the tasks that the fleet file lacks have no register, and are remembered.
        """
        return self.document is not None

    @property
    def must_persist(self) -> bool:
        """Whether the state file must say something before this node's first answer."""
        return self._durable is not None and self.leases.is_news(self._durable.lease_s)

    @property
    def has_voted(self) -> bool:
        """Whether this elector has ever promised anything (in any life that its state remembers)."""
        return any(register.state.promised != NO_BALLOT for register in self.registers.values())

    # --- electors ----------------------------------------------------------------------------------------------------

    def on_ballots(self, event: ev.BallotsAsked, todo: ToDo, now: float) -> None:
        """A proposer asks several questions at once: each by its own rules, all answers together, after one write.

        They count as one question at the rate, for they cost one fsync. No accept waits here for an owner to leave: it
        is refused, and comes again alone.
        """
        ballots, request, asker = event.ballots, event.request, event.asker
        sent, todo.send = todo.send, []
        if ballots.fleet is not None:
            self._hear_fleet(ballots.fleet, asker, todo, now)
        may_ask = not (ballots.prepares or ballots.ahead) or self.acceptor.may_ask(asker, now)
        for prepare in ballots.prepares:
            promise = ev.PrepareAsked(request=request, asker=asker, prepare=prepare)
            self.acceptor.on_prepare(promise, todo, now, may_ask=may_ask)
        for accept in ballots.accepts:
            yes = ev.AcceptAsked(request=request, asker=asker, accept=accept)
            self.acceptor.on_accept(yes, todo, now, park_s=0)
        if ballots.ahead is not None:
            ahead_of = ev.FleetAsked(request=request, asker=asker, question=FleetQuestion(prepare=ballots.ahead))
            self.acceptor.on_fleet_asked(ahead_of, todo, now, may_ask)
        answers = [one for one in todo.send if isinstance(one, do.AnswerElection) and one.request == request]
        ahead = [one for one in todo.send if isinstance(one, do.AnswerFleet) and one.request == request]
        todo.send = [*sent, *(one for one in todo.send if one not in answers and one not in ahead)]
        if answers or ahead:
            votes = votes_of((one.answer for one in answers), ahead[0].answer if ahead else None)
            todo.add(do.AnswerBallots(request=request, votes=votes))

    def _hear_fleet(self, value: FleetValue, teller: NodeId, todo: ToDo, now: float) -> None:
        """A peer says unasked that it has learnt a fleet value.

        An elector that has itself accepted this very value takes its word; everybody else asks.
        """
        if teller == self._me or teller not in self._in_force.nodes:
            return
        if self._numbers.has_accepted(value):
            if self._numbers.learn(value, teller, todo, now):
                self._count_anew(todo)
        elif self._numbers.is_news(value) and self._questions.is_unasked(value.revision, self.fleet_revision, now):
            self._ask(teller, [], ASK_AT_ONCE_S, todo, now, is_news=True, of_fleet=value.revision)

    def on_fleet_answer(self, event: ev.FleetAnswered, todo: ToDo, now: float) -> None:
        """An elector answered our question to its fleet register."""
        answer = event.answer.content
        if answer.elector not in self._in_force.nodes:
            self.counters["answer_foreign"] += 1
        elif not self._numbers.is_possible(answer) or self._tells_unfit(answer):
            self.counters["answer_unfit"] += 1
        elif self._numbers.on_answer(answer, todo, now):
            self._count_anew(todo)

    def _tells_unfit(self, answer: Promise[FleetValue] | Promise | Accepted | Refused) -> bool:
        """Whether a refusal brings a fleet value that could not be true."""
        told = answer.fleet if isinstance(answer, Refused) else None
        return told is not None and not is_fleet_fit(self._numbers.value, told)

    def on_stored(self, event: ev.DocumentStored, todo: ToDo, now: float) -> None:
        """A document is on disk: the value that waits for it is learnt, or an operator's command goes on."""
        if obstacle := self._numbers.obstacle(event.fleet):
            self.on_refused(ev.DocumentRefused(document=event.document, reason=obstacle, request=event.request), todo)
            return
        if self._numbers.on_stored(event.document, event.fleet, todo, now, flags=event.flags):
            self._count_anew(todo)
        self.orders.on_stored(event, todo, now)

    def on_refused(self, event: ev.DocumentRefused, todo: ToDo) -> None:
        """A document cannot be used here."""
        self.counters["document_refused"] += 1
        if event.request is None:
            self._numbers.documents.on_refused(event)
        self.orders.on_refused(event, todo)

    def retry_documents(self) -> None:
        """Documents that were not valid here may be now; they are asked for at the next word of them."""
        self._numbers.documents.refused.clear()

    def change_fleet(self, change: FleetChange, todo: ToDo, now: float) -> str:
        """Try to commit a change of the fleet; why it cannot be made, or nothing."""
        return self._numbers.propose(change, todo, now)

    def on_answer(self, event: ev.ElectorAnswered, todo: ToDo, now: float) -> None:
        """An elector answered our prepare or accept."""
        answer = event.answer
        if self._tells_unfit(answer):
            self.counters["answer_unfit"] += 1
            return
        is_named = answer.elector in self._in_force.nodes
        if isinstance(answer, Refused) and is_named and self._numbers.hear(answer, todo, now):
            self._count_anew(todo)
        register = self.registers.get(answer.task)
        if register is None or answer.elector not in self.electors:
            self.counters["answer_foreign"] += 1
        elif not register.is_possible(answer):
            self.counters["answer_unfit"] += 1
        else:
            known = register.state.learnt
            register.on_answer(answer, todo, now)
            if register.state.learnt is not known:  # our own answer waits for a write, and may come behind this
                self.leases.on_newer_value(register.value)

    @property
    def electors(self) -> tuple[NodeId, ...]:
        """With whom this node counts: the file's, until a change of the fleet is learnt."""
        return self._numbers.electors

    @property
    def document(self) -> Fleet | None:
        """What the agreed document says; ``None``: none is agreed, or it is not stored here."""
        value = self._numbers.changed
        return None if value is None else self._numbers.documents.fleet(value.document)

    @property
    def flags(self) -> tuple[Flag, ...]:
        """What operators have said of nodes, by the agreed document."""
        return self._numbers.flags

    @property
    def document_hash(self) -> str:
        """Hash of the agreed document by which this node goes; empty: by its file."""
        value = self._numbers.changed
        return "" if value is None or self.document is None else value.document

    @property
    def fleet_value(self) -> FleetValue | None:
        """The learnt fleet value; ``None`` while the generation is not known."""
        return self._numbers.value

    @property
    def unsettled(self) -> FleetValue | None:
        """The learnt fleet value while its electors are not settled."""
        value = self._numbers.changed
        return None if value is None or value.settled else value

    @property
    def voters(self) -> tuple[NodeId, ...]:
        """The robots that count in votes."""
        return voters(self._fleet, self._numbers.changed)

    @property
    def disk(self) -> str:
        """Id of the disk with which this node may elect; empty: it has no state, or one that is lost or disputed."""
        durable = self._durable
        return "" if durable is None or self._disputed or self._lost else durable.disk

    @property
    def may_return(self) -> bool:
        """Whether this node answers no more for its seat, and can be added anew once that is given up."""
        return bool(self._durable is not None and self._lost and not self._disputed and self.document_hash)

    def hear_pilot(self, beat: Beat, now: float) -> None:
        """What a peer's newest beat says of electors and robots."""
        terms = beat.lease_terms.partition(",")[0]  # behind it a clock is in doubt
        is_current = beat.number == self.number and terms == self.leases.terms.partition(",")[0]
        self.helm.hear(beat, now, is_current=is_current)

    @property
    def number(self) -> int:
        """Of the learnt fleet value; 0 until a change of the fleet is learnt."""
        return self._numbers.number

    @property
    def fleet_revision(self) -> int:
        """Likewise its revision."""
        return self._numbers.revision

    def _count_anew(self, todo: ToDo) -> None:
        """A newer fleet value is learnt, and the registers count by it already: so do leases and the witness."""
        value, roll = self._numbers.changed, self._numbers.roll
        if value is None or roll is None:
            return
        self.acceptor.refuse_gone(todo)
        self.witness.electors = self.electors
        self._forget_seats(value, todo)
        self.acceptor.is_elector = roll.is_elector
        self.leases.count_with(
            self.electors,
            terms=value.terms,
            number=value.number,
            lease_s=value.lease_s,
            standing=self.standing() if self.is_elector else {},
            guard_lease_s=value.guard_lease_s,
        )

    @property
    def _guard_lease_s(self) -> float:
        """The longest lease that may still run, by the learnt fleet value."""
        value = self._numbers.changed
        return 0.0 if value is None else value.guard_lease_s

    def _forget_seats(self, value: FleetValue, todo: ToDo) -> None:
        """What is remembered of an elector belongs to its seat; so does the loss of this node's own state."""
        names = {*self._seats, *value.electorate.names}
        seats = {name: seat for name in sorted(names) if (seat := value.electorate.seat(name)) is not None}
        for name in sorted(names):
            if self._seats.get(name) != seats.get(name):
                self.witness.seen.pop(name, None)
                self.voted.discard(name)
        self._seats = seats
        if self._lost and self._numbers.roll is not None and self._numbers.roll.seat is None:
            self._lost = ""  # as any other member it begins blank
            todo.must_persist = True
            if not self._disputed and self._durable is not None:
                self._problems.pop((Problem.STATE, ""), None)
                self._numbers.roll.may_elect_again(todo)
        elif self._lost and not self._disputed and self._durable is not None:
            self._complain_of_loss(is_agreed=bool(self.document_hash))

    def _is_of_our_seat(self, learnt: Learnt) -> bool:
        """Whether a peer that speaks of this node's votes knows it by the seat that it has."""
        ours = self._numbers.value
        told = learnt.fleet.electorate.seat(self._me) if learnt.fleet is not None else Elector(name=self._me)
        return ours is not None and (ours.electorate.seat(self._me) or Elector(name=self._me)) == told

    def note_asked(self, beat: Beat, now: float) -> None:
        """An elector (maybe this one) asks owners to leave, because another owner's accept waits."""
        if beat.node not in self.electors:
            return
        for task, _, epoch in beat.asked_to_leave:
            register = self.registers.get(task)
            if register is not None and epoch == register.value.epoch:
                register.expect_release(now, now + hold_s(self._in_force.timing.lease_s))

    # --- learners ----------------------------------------------------------------------------------------------------

    def on_learnt(self, event: ev.LearntReceived, todo: ToDo, now: float) -> None:
        """A peer sent learnt values. Unasked they only lead to a question; an answer may be believed."""
        learnt = event.learnt
        if learnt.node == self._me:
            return
        if learnt.node not in self._in_force.nodes:
            self.counters["learnt_foreign"] += 1
            return
        if event.is_answer:
            self._follow(learnt, todo, now)
        if self.strangers.on_learnt(learnt, self._numbers.value, is_named=self._numbers.is_named):
            self.counters["learnt_stranger"] += 1
            return
        if not self._is_our_generation(learnt.node, learnt.generation, now):
            return
        if not event.is_answer:
            if learnt.fleet is not None and self._numbers.has_accepted(learnt.fleet):
                self._hear_fleet(learnt.fleet, learnt.node, todo, now)
            newer = [(value.task, value.revision) for value in learnt.values]
            revision = 0 if learnt.fleet is None else learnt.fleet.revision
            is_news = self._questions.is_unasked(revision, self.fleet_revision, now)
            self._ask(learnt.node, newer, ASK_AT_ONCE_S, todo, now, is_news=is_news, of_fleet=revision)
            return
        if learnt.fleet is not None and not is_fleet_fit(self._numbers.value, learnt.fleet):
            self.counters["learnt_unfit"] += 1
        elif learnt.fleet is not None and self._numbers.learn(learnt.fleet, learnt.node, todo, now):
            self._count_anew(todo)
        why = self.witness.on_answer(learnt)
        self._lose(why if self._is_of_our_seat(learnt) else "", todo)
        if learnt.has_voted and learnt.node in self.electors and learnt.node not in self.voted:
            self.voted.add(learnt.node)
            todo.must_persist |= self._durable is not None
        for value in learnt.values:
            self._learn(learnt, value, todo, now)

    def _learn(self, learnt: Learnt, value: Allocation, todo: ToDo, now: float) -> None:
        """A peer has answered a question with the learnt ``value``."""
        register = self.registers.get(value.task)
        if register is None:
            self.counters["learnt_foreign"] += 1
        elif is_proven(self._fleet, self.electors, learnt, value, register, has_generation=self.generation is not None):
            known = register.state.learnt
            register.learn(value, todo, now)
            if register.state.learnt is not known:
                self.leases.on_newer_value(value)
        elif value.revision > register.value.revision:
            self._read(value.task, register, todo, now)

    def _read(self, task: TaskId, register: TaskRegister, todo: ToDo, now: float) -> None:
        """Ask a majority for the value in force (an identity round): one peer's word is not enough."""
        self.counters["learnt_unproven"] += 1
        if self._questions.take_read(task, now):
            register.settle(todo, now)

    def is_stranger(self, beat: Beat, todo: ToDo, now: float) -> bool:
        """Whether a beat is of another generation: nothing of it counts here, and it is shown."""
        ours = self._numbers.value
        named = "" if ours is None else ours.generation_id
        if not self.strangers.hear(beat, named, is_named=self._numbers.is_named, now=now):
            return False
        self.apart.discard(beat.node)
        if self.strangers.must_ask(beat.node, now):
            todo.add(do.AskLearnt(peer=beat.node, deadline_s=self._in_force.timing.ballot_s))
        return True

    def foreign_generation(self, beat: Beat) -> str:
        """What a beat tells of another generation than this node's; empty: it tells of none.

        Nothing is remembered, so it serves for nodes that the document does not name, too.
        """
        ours = self._numbers.value
        named = "" if ours is None else ours.generation_id
        told = self.strangers.told(beat, named, is_named=self._numbers.is_named)
        return "" if told is None or told == named[:TOLD_DIGITS] else told

    def _hear_electorate(self, beat: Beat) -> None:
        """Note whether an elector and this node refuse each other's ballots (other electors, or another generation)."""
        is_apart = beat.electorate not in ("", self.electorate) or self._is_no_elector_there(beat)
        is_apart &= beat.number == self.number  # one of two is behind, and will learn
        is_apart |= beat.generation != self.generation
        if is_apart and not self._is_guest_of(beat.generation) and beat.node in self.electors:
            self.apart.add(beat.node)
        elif self.apart:
            self.apart.discard(beat.node)

    def _is_no_elector_there(self, beat: Beat) -> bool:
        """Whether a node that is an elector by this file counts with other electors and is none by its own file.

        Such a node names no electorate and no lost state (a node with a lost state is an elector by its own file). The
        terms tell it from a node that is too old to name its electorate.
        """
        terms = beat.lease_terms.partition(",")[0]  # behind it a clock is in doubt
        return not beat.electorate and not beat.has_lost_state and terms not in ("", self.leases.terms)

    def _is_our_generation(self, node: NodeId, generation: int, now: float) -> bool:
        """Whether a node's learnt values mean anything here; the difference is shown."""
        is_ours = generation == self.generation or self._is_guest_of(generation)
        if is_ours and not self._problems:
            return True  # thirty beats a second come by here
        if is_ours:
            self._show_no_more(node)
            return True
        told, since, _ = self.behind.get(node, (generation, now, now))
        self.behind[node] = generation, since if told == generation else now, now
        text = f"{node} is of generation {generation}, this node of {self.generation or 0}"
        self._problems[Problem.GENERATION, node] = text
        return False

    def _show_no_more(self, node: NodeId) -> None:
        """A node is not of another generation, or nothing is heard or known of it any more."""
        if self.behind.pop(node, None) is not None:
            self._problems.pop((Problem.GENERATION, node), None)

    def forget(self, now: float) -> None:
        """Nodes of other generations that are not heard any more are not shown."""
        self.strangers.forget(now)
        for node in [node for node, (_, _, at) in self.behind.items() if now - at >= SHOWN_S]:
            self._show_no_more(node)

    def _is_guest_of(self, generation: int) -> bool:
        """Whether this node, without a state, follows a newer generation."""
        return not self._has_state and (self.generation is None or generation > self.generation)

    def _follow(self, learnt: Learnt, todo: ToDo, now: float) -> None:
        """An elector with a state has answered: a node without one joins the newest generation that it hears of."""
        is_elector = learnt.node in self.electors and (learnt.incarnation > 0 or learnt.has_voted)
        if not is_elector or learnt.generation > MAX_GENERATION or not self._is_guest_of(learnt.generation):
            return
        self.generation = learnt.generation
        self.witness.seen.clear()  # of another generation's states
        self.voted.clear()
        for task in self._fleet.tasks:
            initial = task.first_value(learnt.generation * GENERATION_STEP)
            self.registers[task.name].follow(self._by_file, initial, learnt.generation)
        self._numbers.begin(learnt.generation, self._by_file, todo, now, may_elect=False)

    def dispute(self, reason: str, todo: ToDo) -> None:
        """Another daemon uses our name, too: no elector any more, on disk, until the operator settles the dispute."""
        if self._disputed:
            return
        self._disputed = reason
        self._problems[Problem.STATE, ""] = f"{reason}; no elector until {SETTLE}"
        self._stop_electing()
        todo.must_persist |= self._durable is not None

    def _lose(self, why: str, todo: ToDo) -> None:
        """Peers have seen more of our state than it holds: no elector any more, on disk."""
        if not why or self._lost or not self.is_elector:
            return
        self._lost = why
        self._complain_of_loss(is_agreed=bool(self.document_hash))
        self._stop_electing()
        todo.must_persist = True

    def _complain_of_loss(self, *, is_agreed: bool) -> None:
        """Say that this node is no elector, and until when: by an agreed document another disk is another member."""
        lost = lost_text(self._lost, is_agreed=is_agreed)
        joins = "" if self._durable is None else self._durable.joins
        self._problems[Problem.STATE, ""] = lost if not joins else moved_text(self._lost, joins)

    def compare(self, beat: Beat, todo: ToDo, now: float) -> None:
        """A peer's beat may show that it has learnt more than we have, or has voted: then ask it."""
        self.newest_generation = max(self.newest_generation, min(beat.generation, MAX_GENERATION))
        self._hear_electorate(beat)
        if not self._is_our_generation(beat.node, beat.generation, now):
            return
        is_news = beat.has_voted and beat.node not in self.voted and beat.node in self.electors
        is_news |= self.witness.must_ask(beat) and not self._may_wait(beat, now)
        is_news |= self._questions.is_unasked(beat.fleet_revision, self.fleet_revision, now)
        is_news |= self._is_guest_of(beat.generation) and beat.node in self.electors
        newer = [(task, revision) for task, revision, _ in beat.learnt]
        self._ask(beat.node, newer, ASK_LEARNT_EVERY_S, todo, now, is_news=is_news, of_fleet=beat.fleet_revision)

    def _may_wait(self, beat: Beat, now: float) -> bool:
        """Whether a peer is asked later how often it has voted: the electors change just now.

        Each of them votes several times in such a change. Whom this elector has not asked since it started is asked at
        once.
        """
        number = max(beat.number, self.number)
        if (number == self.number and self.unsettled is None) or not self.witness.has_asked(beat.node):
            return False
        return self._questions.may_wait(number, now)

    def word(self, now: float) -> Learnt | None:
        """What this node has learnt, for everybody; ``None``: it has said so just now."""
        return self.learnt() if self._questions.take_word(self.fleet_revision, now) else None

    def _ask(
        self,
        peer: NodeId,
        told: list[tuple[TaskId, int]],
        every_s: float,
        todo: ToDo,
        now: float,
        *,
        is_news: bool = False,
        of_fleet: int = 0,
    ) -> None:
        """Ask a peer for its learnt values, because of a newer revision (or of other news).

        ``of_fleet``: revision of the fleet value that it has learnt.
        """
        is_behind = False
        for task, revision in told:
            register = self.registers.get(task)
            is_behind |= register is not None and revision > register.value.revision
        if not is_behind and not is_news:
            return
        may_ask = self._questions.take(
            peer, now, every_s=every_s, is_behind=is_behind, revision=of_fleet, learnt=self.fleet_revision
        )
        if may_ask:
            todo.add(do.AskLearnt(peer=peer, deadline_s=self._in_force.timing.ballot_s))

    # --- proposers ---------------------------------------------------------------------------------------------------

    def propose(self, task: TaskId, change: Change, todo: ToDo, now: float) -> None:
        """Try to commit a change."""
        if self.generation is None:  # nobody would answer, for every ballot names the generation
            todo.end(task, change, RoundOutcome.NO_QUORUM)
        else:
            self.registers[task].propose(change, todo, now)

    def tick(self, todo: ToDo, now: float) -> None:
        """Time has passed."""
        if now >= self._settle_at:
            self._numbers.settle(todo, now)
        if now >= self._numbers.next_deadline():
            self._numbers.tick(todo, now)
        for register in tuple(self.registers.values()):
            if now >= self._settle_at:
                register.settle(todo, now)
            if now >= register.next_deadline():
                register.tick(todo, now)
        if now >= self._settle_at:
            self._settle_at = math.inf

    def on_ended(self, ended: Ended, todo: ToDo) -> None:
        """A change of this node has ended: tell the other nodes, and the operator that waits for it."""
        task, change, outcome = ended.task, ended.change, ended.outcome
        register = self.registers.get(task)
        if register is None:
            refuse_gone(ended, todo)
            return
        value = register.value
        if outcome is RoundOutcome.COMMITTED:
            todo.add(do.PublishLearnt(learnt=self.learnt()))
        if isinstance(change, MoveOwner):
            text = f"move to {change.owner} on revision {shown(change.base_revision)}: {outcome}"
            todo.add(do.RecordStory(stage="vote", text=text, task=task, epoch=value.epoch))
        answer_end(ended, value, todo, len(self._fleet.electors))

    def on_persist_failed(self, reason: str) -> None:
        """The disk refused: no elector any more, and nothing is written any more."""
        self._problems[Problem.STATE, ""] = f"{reason}; this node is no elector until it is restarted"
        self._durable = None
        self._stop_electing()

    def _stop_electing(self) -> None:
        self.acceptor.is_elector = False
        self.leases.stop_granting()
        if self._numbers.roll is not None:
            self._numbers.roll.stop_electing()
