"""Machines whose electors change: rolls and registers of the core, their disks and a network, driven from outside.

Knows: what a machine keeps and forgets, which message each thing to do becomes. Does not know: what must hold
(`zsched_lab.sim.chosen`), which faults there are (`zsched_lab.sim.electorate`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from random import Random
from typing import Final

from zsched.core.electorate.changes import FleetChange
from zsched.core.electorate.founding import recovered
from zsched.core.electorate.roll import Admission, Roll
from zsched.core.register.task_register import TaskRegister
from zsched.core.values.change import MoveOwner, Rewrite, RoundOutcome
from zsched.core.values.electorate import Creation, Elector, FleetValue
from zsched.core.values.fleet import Timing
from zsched.core.values.instructions import AskElectors, AskFleet, SendAccept, SendPrepare, TellFleet
from zsched.core.values.messages import Accept, Accepted, Prepare, Promise, Refused
from zsched.core.values.model import Allocation, NodeId, RegisterState, TaskId, Tuning, Weights
from zsched.core.values.struct import replace
from zsched.core.values.todo import ToDo
from zsched.core.values.words import CREATION_STEP
from zsched_lab.sim.chosen import Chosen

CLOCKS: Final = Timing(ballot_s=0.3, stagger_s=0.03)
FLEET: Final = "swarm"
TUNING: Final = Tuning(weights=Weights(cpu=1.0, memory=0.0, network=0.0))

TaskQuestion = Prepare | Accept
Answer = Promise | Accepted | Refused
FleetQuestion = Prepare | Accept[FleetValue]
FleetAnswer = Promise[FleetValue] | Accepted | Refused


@dataclass(frozen=True, slots=True)
class Ask:
    """Questions to tasks' registers, in one frame."""

    questions: tuple[TaskQuestion, ...]


@dataclass(frozen=True, slots=True)
class Say:
    """Their answers, in one frame."""

    answers: tuple[Answer, ...]


@dataclass(frozen=True, slots=True)
class AskRoll:
    """A question to the fleet register."""

    question: FleetQuestion


@dataclass(frozen=True, slots=True)
class SayRoll:
    """Its answer."""

    answer: FleetAnswer


@dataclass(frozen=True, slots=True)
class Tell:
    """What a machine has learnt."""

    fleet: FleetValue
    values: tuple[Allocation, ...] = ()


@dataclass(frozen=True, slots=True)
class Want:
    """What have you learnt?"""


Body = Ask | Say | AskRoll | SayRoll | Tell | Want


@dataclass(frozen=True, slots=True)
class Message:
    """One frame under way."""

    sender: NodeId
    to: NodeId
    body: Body


@dataclass(slots=True)
class Disk:
    """What survives a crash: one file, written whole."""

    id: str
    incarnation: int = 0
    fleet: RegisterState[FleetValue] | None = None
    registers: tuple[RegisterState, ...] = ()


@dataclass(slots=True)
class Machine:
    """A node's name on a disk, and the life that a crash takes away."""

    name: NodeId
    disk: Disk
    generation_id: str
    """The generation that an operator has told it to join."""
    roll: Roll | None = None
    registers: dict[TaskId, TaskRegister] = field(default_factory=dict)
    now: float = 0.0
    is_up: bool = True


class Machines:
    """All machines, what is under way between them, and what has been chosen.

    Args:
        names: of machines; all are there from the start.
        electors: the first of them that elect.
        tasks: (task, whether it is exclusive).
        seed: of back-off, ids and of what a caller draws.
        lease_s: of exclusive tasks.
    """

    def __init__(
        self,
        names: Iterable[NodeId],
        *,
        electors: int,
        tasks: Iterable[tuple[TaskId, bool]] = (("t1", False),),
        seed: int = 0,
        lease_s: float = 1.0,
    ) -> None:
        self.rng = Random(seed)
        self.pool: list[Message] = []
        self.owners = 0
        self._replies: list[tuple[NodeId, Body]] = []
        self.ended: list[tuple[Rewrite[FleetValue] | MoveOwner, RoundOutcome]] = []
        self.is_cut: Callable[[], bool] = lambda: False
        """Whether a machine crashes now: asked before and after it writes."""
        names = tuple(names)
        disks = {name: self.draw_id() for name in names}
        first = tuple(Elector(name=name, disk=disks[name], joining=1) for name in sorted(names[:electors]))
        listed = sorted(tasks)
        self.first = FleetValue(
            fleet=FLEET,
            generation_id=self.draw_id(),
            revision=1,
            number=1,
            electors=first,
            settled=True,
            lease_s=lease_s,
            guard_lease_s=lease_s,
            creations=len(listed),
            tasks=tuple(Creation(task=t, number=i, exclusive=x) for i, (t, x) in enumerate(listed, start=1)),
            document="d0",
        )
        self.chosen = Chosen(self.first)
        self.machines: list[Machine] = []
        for name in names:
            disk = Disk(id=disks[name], fleet=RegisterState(task=FLEET, learnt=self.first))
            self.machines.append(Machine(name=name, disk=disk, generation_id=self.first.generation_id))
        for machine in self.machines:
            self.start(machine)

    def draw_id(self) -> str:
        """Another random id."""
        return f"{self.rng.getrandbits(64):016x}"

    def machine(self, name: NodeId) -> Machine:
        """The first machine of this name."""
        return next(machine for machine in self.machines if machine.name == name)

    # --- lives -------------------------------------------------------------------------------------------------------

    def start(self, machine: Machine) -> None:
        """A life begins with what is on the disk."""
        machine.disk.incarnation += 1
        machine.is_up, machine.roll, machine.registers = True, None, {}
        if machine.disk.fleet is not None:
            self._follow(machine, machine.disk.fleet)

    def _follow(self, machine: Machine, state: RegisterState[FleetValue]) -> None:
        value = state.learnt
        assert value is not None
        for stored in machine.disk.registers:
            creation = value.creation(stored.task)
            if creation is not None and creation.number == stored.creation:
                machine.registers[stored.task] = self._register(machine, creation, stored)
        machine.roll = Roll(
            me=machine.name,
            disk=machine.disk.id,
            incarnation=machine.disk.incarnation,
            state=state,
            registers=machine.registers,
            begin=lambda creation: self._register(machine, creation, None),
            clocks=lambda: CLOCKS,
            rng=self.rng,
            now=machine.now,
        )

    def _register(self, machine: Machine, creation: Creation, stored: RegisterState | None) -> TaskRegister:
        return TaskRegister(
            me=machine.name,
            incarnation=machine.disk.incarnation,
            electors=(),
            electorate="",
            is_elector=False,
            initial=self.first_value(creation),
            state=stored or RegisterState(task=creation.task, creation=creation.number),
            clocks=lambda: CLOCKS,
            rng=self.rng,
            disk=machine.disk.id,
        )

    def first_value(self, creation: Creation) -> Allocation:
        """What a task's blank register holds."""
        start = creation.start
        return Allocation(task=creation.task, revision=start, epoch=start, owner=None, tuning=TUNING)

    def stop(self, machine: Machine) -> None:
        """It crashes, or dies: what is not on its disk is gone."""
        machine.is_up, machine.roll, machine.registers = False, None, {}

    def restart(self, machine: Machine) -> None:
        """It crashes and is back."""
        self.stop(machine)
        self.start(machine)

    def lose_disk(self, machine: Machine) -> None:
        """It gets a blank disk; the operator names the generation that it is to join."""
        self.stop(machine)
        machine.disk = Disk(id=self.draw_id())
        self.start(machine)

    def clone(self, machine: Machine) -> Machine:
        """Another machine starts from a copy of the disk: the copy draws an id of its own."""
        self.stop(machine)
        copied = replace(machine.disk, id=self.copied_id(machine.disk.id))
        other = Machine(name=machine.name, disk=copied, generation_id=machine.generation_id, now=machine.now)
        self.machines.append(other)
        self.start(machine)
        self.start(other)
        return other

    def copied_id(self, copied: str) -> str:
        """The id under which a copied disk runs on another machine."""
        del copied
        return self.draw_id()

    def recover(self, machine: Machine, states: Iterable[RegisterState] = ()) -> FleetValue:
        """The operator makes this machine the only elector of a new generation."""
        roll = machine.roll
        assert roll is not None
        own = tuple(register.state for register in machine.registers.values())
        value, registers = recovered(
            roll.value, machine.name, disk=machine.disk.id, generation_id=self.draw_id(), states=(*own, *states)
        )
        self.chosen.begin(value, registers)
        self.stop(machine)
        machine.generation_id = value.generation_id
        self._write(machine, RegisterState(task=FLEET, learnt=value), registers)
        self.start(machine)
        return value

    # --- what they are asked to do -----------------------------------------------------------------------------------

    def move(self, machine: Machine, task: TaskId) -> str:
        """It proposes another owner, one that nobody has proposed before; the owner's name."""
        self.owners += 1
        owner = f"w{self.owners}"
        register = machine.registers.get(task)
        if register is not None:
            change = MoveOwner(base_revision=register.value.revision, owner=owner, reason="swarm")
            self._do(machine, lambda todo: register.propose(change, todo, machine.now))
        return owner

    def change(self, machine: Machine, change: FleetChange) -> str:
        """It proposes a change of the fleet; why it cannot be made, or nothing."""
        faults: list[str] = []
        roll = machine.roll
        if roll is None:
            return "it knows no fleet"
        self._do(machine, lambda todo: faults.append(roll.propose(change, todo, machine.now)))
        return faults[0] if faults else ""

    def look(self, machine: Machine) -> None:
        """It runs an identity round of the fleet register."""
        if (roll := machine.roll) is not None:
            self._do(machine, lambda todo: roll.settle(todo, machine.now))

    def tell(self, machine: Machine, to: NodeId) -> None:
        """It tells a peer what it has learnt."""
        if (told := self._told(machine)) is not None:
            self._send(machine, to, told)

    def _told(self, machine: Machine) -> Tell | None:
        if machine.roll is None:
            return None
        learnt = [register.state.learnt for register in machine.registers.values()]
        return Tell(machine.roll.value, tuple(value for value in learnt if value is not None))

    def tick(self, machine: Machine) -> None:
        """Its time has come for whatever it waits for."""
        due = self.deadline(machine)
        machine.now = max(machine.now, due if due < 1e9 else machine.now)

        def all_of_it(todo: ToDo) -> None:
            for register in tuple(machine.registers.values()):
                if machine.now >= register.next_deadline():
                    register.tick(todo, machine.now)
            if machine.roll is not None:
                machine.roll.tick(todo, machine.now)

        self._do(machine, all_of_it)

    def deadline(self, machine: Machine) -> float:
        """When its next tick is due."""
        due = [register.next_deadline() for register in machine.registers.values()]
        due += [] if machine.roll is None else [machine.roll.next_deadline()]
        return min(due, default=float("inf"))

    # --- a network without faults ------------------------------------------------------------------------------------

    def run(self, *names: NodeId, for_s: float = 3.0, still: tuple[NodeId, ...] = ()) -> None:
        """Time passes for these machines (all, when none is named); messages to and from others wait.

        Those that are ``still`` answer, and do nothing by themselves.
        """
        among = {machine.name for machine in self.machines if not names or machine.name in names}
        began_at = max(machine.now for machine in self.machines)
        for machine in self.machines:
            machine.now = began_at  # those that were left out have been there, too
        ends_at = began_at + for_s
        while True:
            self._pass_on(among)
            up = [machine for machine in self.machines if machine.name in among and machine.is_up]
            up = [machine for machine in up if machine.name not in still]
            due = min((self.deadline(machine) for machine in up), default=ends_at)
            for machine in up:
                machine.now = max(machine.now, min(due, ends_at))
            if due >= ends_at:
                return
            for machine in up:
                if self.deadline(machine) <= machine.now:
                    self.tick(machine)

    def _pass_on(self, among: set[NodeId]) -> None:
        while True:
            found = next((one for one in self.pool if one.sender in among and one.to in among), None)
            if found is None:
                return
            self.pool.remove(found)
            self.give(found)

    def give(self, message: Message) -> None:
        """Deliver a message to every machine of its receiver's name."""
        for machine in [one for one in self.machines if one.name == message.to]:
            self.deliver(message, machine)

    def share(self, *names: NodeId) -> None:
        """These machines (all, when none is named) tell each other what they have learnt."""
        up = [one for one in self.machines if one.is_up and (not names or one.name in names)]
        for machine in up:
            for other in up:
                if other.name != machine.name:
                    self.tell(machine, other.name)
        self._pass_on({machine.name for machine in up})

    def drop(self) -> None:
        """All that is under way is lost."""
        self.pool.clear()

    # --- messages ----------------------------------------------------------------------------------------------------

    def deliver(self, message: Message, machine: Machine) -> None:
        """One message reaches one machine."""
        if not machine.is_up:
            return
        if isinstance(message.body, Want):
            self.tell(machine, message.sender)
        elif machine.roll is None:
            self._meet(machine, message)
        else:
            roll = machine.roll
            self._do(machine, lambda todo: self._take(machine, roll, message, todo))

    def _meet(self, machine: Machine, message: Message) -> None:
        """A machine without a fleet value takes that of the generation that it is to join, and asks for it."""
        body = message.body
        if isinstance(body, Tell) and body.fleet.generation_id == machine.generation_id:
            state = RegisterState(task=FLEET, learnt=body.fleet)
            self._write(machine, state, ())
            self._follow(machine, state)
        elif isinstance(body, Ask | AskRoll):
            self._send(machine, message.sender, Want())

    def _take(self, machine: Machine, roll: Roll, message: Message, todo: ToDo) -> None:
        now = machine.now
        match message.body:
            case Ask(questions=questions):
                answers = [self._answer(machine, roll, one, message.sender, todo) for one in questions]
                given = tuple(answer for answer in answers if answer is not None)
                self._replies += [(message.sender, Say(given))] if given else []
            case AskRoll(question=question):
                answer = roll.on_question(question, message.sender, todo, now)
                self._replies += [] if answer is None else [(message.sender, SayRoll(answer))]
            case Say(answers=answers_given):
                for one in answers_given:
                    if isinstance(one, Refused):
                        roll.hear(one, todo, now)
                    register = machine.registers.get(one.task)
                    if register is not None:
                        register.on_answer(one, todo, now)
                roll.tick(todo, now)
            case SayRoll(answer=heard):
                roll.on_answer(heard, todo, now)
            case Tell(fleet=fleet, values=values):
                roll.learn(fleet, todo, now)
                for value in values if fleet.generation_id == roll.value.generation_id else ():
                    register = machine.registers.get(value.task)
                    if register is not None and value.revision // CREATION_STEP == register.state.creation:
                        register.learn(value, todo, now)

    def _answer(self, machine: Machine, roll: Roll, question: TaskQuestion, asker: NodeId, todo: ToDo) -> Answer | None:
        admission = roll.admission(question, asker, todo)
        if admission is Admission.SILENT:
            return None
        register = machine.registers.get(question.task)
        if admission is Admission.REFUSED or register is None:
            return roll.refused(question)
        if isinstance(question, Prepare):
            return register.on_prepare(question, todo)
        return register.on_accept(question, todo, machine.now)

    # --- what becomes of it ------------------------------------------------------------------------------------------

    def _do(self, machine: Machine, what: Callable[[ToDo], None]) -> None:
        """Persist, then send."""
        todo = ToDo()
        what(todo)
        replies, self._replies = self._replies, []
        self._check_problems(machine)
        if self.is_cut():
            self.restart(machine)
            return
        if todo.must_persist and machine.roll is not None:
            states = tuple(register.state for _, register in sorted(machine.registers.items()))
            self._write(machine, machine.roll.state, states)
        if self.is_cut():
            self.restart(machine)
            return
        if machine.roll is not None and (machine.disk.fleet is None or machine.disk.fleet.learnt != machine.roll.value):
            self.chosen.hear(machine.name, ["it goes by a fleet value that is not on its disk"])
        for to, body in replies:
            self._send(machine, to, body)
        asked: list[TaskQuestion] = []
        for instruction in todo.send:
            if isinstance(instruction, SendPrepare):
                asked.append(instruction.prepare)
            elif isinstance(instruction, SendAccept):
                asked.append(instruction.accept)
        self._ask(machine, asked)
        for order in todo.fleet:
            match order:
                case AskElectors(to=names, question=question):
                    self.chosen.note(question)
                    for name in names:
                        self._send(machine, name, AskRoll(question))
                case TellFleet(to=names, value=value):
                    for name in names:
                        self._send(machine, name, Tell(value))
                case AskFleet(peer=peer):
                    self._send(machine, peer, Want())
        for fleet_change, outcome in todo.fleet_ended:
            self.ended.append((fleet_change, outcome))
        for ended in todo.ended:
            assert isinstance(ended.change, MoveOwner)
            self.ended.append((ended.change, ended.outcome))

    def _ask(self, machine: Machine, asked: list[TaskQuestion]) -> None:
        """All questions that one step has led to, in one frame for each elector."""
        if machine.roll is None:
            return
        for question in asked:
            self.chosen.note(question)
        for name in machine.roll.value.electorate.names if asked else ():
            self._send(machine, name, Ask(tuple(asked)))

    def _send(self, machine: Machine, to: NodeId, body: Body) -> None:
        self.pool.append(Message(machine.name, to, body))

    def _write(self, machine: Machine, fleet: RegisterState[FleetValue], registers: tuple[RegisterState, ...]) -> None:
        machine.disk.fleet, machine.disk.registers = fleet, registers
        self.chosen.on_disk(machine.name, machine.disk.id, fleet, registers)

    def _check_problems(self, machine: Machine) -> None:
        told = [register.problem for register in machine.registers.values()]
        told += [] if machine.roll is None else [machine.roll.problem]
        self.chosen.hear(machine.name, [problem for problem in told if problem])
