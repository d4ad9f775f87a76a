"""Machines that beat, lease and pilot themselves, in time: `zsched_lab.sim.electors` with a clock and a network.

Knows: when a beat leaves, how long a message takes, what a machine that pauses misses, who works. Does not know: which
faults there are (`zsched_lab.sim.pilot`).

A machine works on an exclusive task while its lease runs. Two that do so at once end the play, as does whatever
`zsched_lab.sim.chosen` finds.
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from dataclasses import replace as changed
from typing import Final

from zsched.core.electorate.changes import FleetChange
from zsched.core.electorate.pilot import Course, Pilot, Word
from zsched.core.register.task_register import TaskRegister
from zsched.core.values.beat import Beat
from zsched.core.values.change import MoveOwner, RoundOutcome
from zsched.core.values.electorate import Creation, FleetValue
from zsched.core.values.fleet import Fleet, TaskSpec, Timing
from zsched.core.values.in_force import InForce
from zsched.core.values.messages import Accept, Accepted, Refusal
from zsched.core.values.model import Allocation, NodeId, NodeKind, RegisterState, TaskId
from zsched.core.values.todo import ToDo
from zsched.core.vote.lease import Leases
from zsched_lab.sim.chosen import ChosenError
from zsched_lab.sim.electors import (
    FLEET,
    TUNING,
    Answer,
    Body,
    Machine,
    Machines,
    Message,
    Want,
)

BEAT_S: Final = 0.2
SILENCE_S: Final = 1.2
SUSPECT_S: Final = 0.9
AWAY_S: Final = 4.0
LEASE_S: Final = 1.0
STAGGER_S: Final = 0.3
DELAYS_S: Final = (0.001, 0.03)
STEP_S: Final = 0.02
ASK_EVERY_S: Final = 0.2


@dataclass(slots=True)
class Life:
    """What a machine has beside its registers, from one start to the next."""

    pilot: Pilot
    leases: Leases
    sequence: int = 0
    beat_at: float = 0.0
    asked_at: float = -math.inf
    values: dict[TaskId, Allocation] = field(default_factory=dict)


class Piloted(Machines):
    """Machines in time.

    Args:
        names: of machines, all there from the start; those that begin with ``r`` are robots.
        electors: how many of them elect at first.
        tasks: (task, whether it is exclusive).
        seed: of all chance.
        is_auto: whether electors are replaced by themselves.
    """

    def __init__(
        self,
        names: Iterable[NodeId],
        *,
        electors: int,
        tasks: Iterable[tuple[TaskId, bool]] = (("t1", True),),
        seed: int = 0,
        is_auto: bool = True,
    ) -> None:
        self.time = 0.0
        self.names = tuple(names)
        self.lives: dict[int, Life] = {}
        self._order = itertools.count()
        self._under_way: list[tuple[float, int, Message, Machine | None]] = []
        self.cut: Callable[[NodeId, NodeId], bool] = lambda _sender, _to: False
        """Whether what the first one sends does not reach the second."""
        self.paused: dict[int, list[Message]] = {}
        """{machine: what has come for it since it paused}."""
        self.leaving: set[NodeId] = set()
        self.counts: Counter[str] = Counter()
        tasks = tuple(tasks)
        self._exclusive = {task for task, is_exclusive in tasks if is_exclusive}
        members = tuple((name, kind_of(name)) for name in sorted(self.names))
        self._course = Course(members=members, is_auto=is_auto, silence_s=SILENCE_S, suspect_s=SUSPECT_S, away_s=AWAY_S)
        self._fleet = Fleet(
            name=FLEET,
            timing=changed(Timing(), lease_s=LEASE_S),
            nodes=(),
            tasks=tuple(
                TaskSpec(name=task, candidates=(), tuning=TUNING, exclusive=is_exclusive)
                for task, is_exclusive in sorted(tasks)
            ),
            electors=tuple(sorted(self.names[:electors])),
        )
        super().__init__(self.names, electors=electors, tasks=tasks, seed=seed, lease_s=LEASE_S)

    # --- lives -------------------------------------------------------------------------------------------------------

    def _follow(self, machine: Machine, state: RegisterState[FleetValue]) -> None:
        super()._follow(machine, state)
        machine.now = self.time
        is_elector = machine.roll is not None and machine.roll.is_elector
        leases = Leases(
            in_force=InForce(self._fleet),
            me=machine.name,
            incarnation=machine.disk.incarnation,
            standing=_standing(machine) if is_elector else {},
            now=self.time,
        )
        pilot = Pilot(me=machine.name, disk=machine.disk.id, now=self.time)
        beat_at = self.time + BEAT_S * self.rng.random()
        self.lives[id(machine)] = Life(pilot=pilot, leases=leases, beat_at=beat_at)
        self._note(machine)

    def first_value(self, creation: Creation) -> Allocation:
        """What a task's blank register holds: exclusive tasks are leased from the start."""
        return changed(super().first_value(creation), leased=creation.exclusive)

    def stop(self, machine: Machine) -> None:
        """It crashes, or dies: its worker with it."""
        super().stop(machine)
        self.lives.pop(id(machine), None)
        self.paused.pop(id(machine), None)

    def pause(self, machine: Machine) -> None:
        """It stands still, and its clock goes on."""
        self.paused.setdefault(id(machine), [])

    def wake(self, machine: Machine) -> None:
        """It goes on; what has come meanwhile is read behind its own timers, as a loop does that was frozen."""
        waiting = self.paused.pop(id(machine), [])
        if not machine.is_up:
            return
        machine.now = self.time
        self._run_machine(machine)
        for message in waiting:
            self._arrive(message, machine)

    # --- time --------------------------------------------------------------------------------------------------------

    def pass_time(self, for_s: float) -> None:
        """Time passes for all machines that do not pause."""
        ends_at = self.time + for_s
        while self.time < ends_at:
            self.time = min(self.time + STEP_S, ends_at)
            while self._under_way and self._under_way[0][0] <= self.time:
                _, _, message, only = heapq.heappop(self._under_way)
                for machine in [one for one in self.machines if one.name == message.to and only in (None, one)]:
                    self._arrive(message, machine)
            for machine in tuple(self.machines):
                if machine.is_up and id(machine) not in self.paused:
                    machine.now = self.time
                    self._run_machine(machine)
            self._check_owners()

    def _arrive(self, message: Message, machine: Machine) -> None:
        if id(machine) in self.paused:
            self.paused[id(machine)].append(message)
        elif machine.is_up:
            machine.now = self.time
            self.deliver(message, machine)

    def _run_machine(self, machine: Machine) -> None:
        if self.deadline(machine) <= self.time:
            self.tick(machine)
        life = self.lives.get(id(machine))
        if life is not None and machine.roll is not None and self.time >= life.beat_at:
            self._beat(machine, life)

    def _send(self, machine: Machine, to: NodeId, body: Body) -> None:
        if self.cut(machine.name, to) and to != machine.name:
            return
        at = self.time + self.rng.uniform(*DELAYS_S)
        message = Message(machine.name, to, body)
        only = machine if to == machine.name else None
        heapq.heappush(self._under_way, (at, next(self._order), message, only))

    # --- beats -------------------------------------------------------------------------------------------------------

    def course(self) -> Course:
        """What the document says now."""
        return changed(self._course, leaving=tuple(sorted(self.leaving)))

    def _beat(self, machine: Machine, life: Life) -> None:
        roll = machine.roll
        assert roll is not None
        value, now = roll.value, self.time
        life.beat_at = now + BEAT_S
        life.sequence += 1
        parts = life.leases.on_sent(life.sequence, now)
        course = self.course()
        gone = life.pilot.gone(value, course, now) if roll.is_elector else ()
        away = life.pilot.away(value, course, now) if roll.is_elector else ()
        beat = Beat(
            node=machine.name,
            incarnation=machine.disk.incarnation,
            sequence=life.sequence,
            loop_lag_s=0.0,
            learnt=tuple((task, one.value.revision, one.value.epoch) for task, one in machine.registers.items()),
            echoes=parts.echoes,
            released=parts.released,
            asked_to_leave=parts.asked_to_leave,
            lease_terms=life.leases.terms,
            number=value.number,
            fleet_revision=value.revision,
            disk=machine.disk.id,
            gone=gone,
            away=away,
        )
        self._hear_leases(machine, life, beat)
        for name in dict.fromkeys(one.name for one in self.machines):
            if name != machine.name:
                self._send_beat(machine, name, beat)
        change = life.pilot.tick(value, course, now, stagger_s=STAGGER_S, is_busy=roll.is_busy)
        if change is not None:
            self.propose(machine, change)

    def propose(self, machine: Machine, change: FleetChange) -> None:
        """A pilot's change goes to the register."""
        self.counts["proposed"] += 1
        self.change(machine, change)

    def _send_beat(self, machine: Machine, to: NodeId, beat: Beat) -> None:
        if not self.cut(machine.name, to):
            at = self.time + self.rng.uniform(*DELAYS_S)
            heapq.heappush(self._under_way, (at, next(self._order), _BeatMessage(machine.name, to, Want(), beat), None))

    def deliver(self, message: Message, machine: Machine) -> None:
        """One message, or beat, reaches one machine."""
        if not isinstance(message, _BeatMessage):
            super().deliver(message, machine)
            return
        life, beat = self.lives.get(id(machine)), message.beat
        if machine.roll is None or life is None:
            self._send(machine, beat.node, Want())
            return
        is_current = beat.lease_terms == life.leases.terms and beat.number == machine.roll.value.number
        word = Word(node=beat.node, disk=beat.disk, is_current=is_current, gone=beat.gone, away=beat.away)
        life.pilot.hear(word, machine.roll.value, self.course(), self.time)
        self._hear_leases(machine, life, beat)
        is_behind = beat.fleet_revision > machine.roll.value.revision
        is_behind |= any(
            task in machine.registers and revision > machine.registers[task].value.revision
            for task, revision, _ in beat.learnt
        )
        if is_behind and self.time >= life.asked_at + ASK_EVERY_S:
            life.asked_at = self.time
            self._send(machine, beat.node, Want())

    # --- leases ------------------------------------------------------------------------------------------------------

    def _hear_leases(self, machine: Machine, life: Life, beat: Beat) -> None:
        accepted = {}
        for task, value in _standing(machine).items():
            if value is not None and value.owner is not None and value.leased:
                accepted[task] = value.owner, value.epoch
        if machine.roll is None or not machine.roll.is_elector:
            accepted = {}
        life.leases.on_beat(beat, accepted, self.time)
        for task in life.leases.leaving():  # its worker stops at once
            life.leases.on_stopped(task, machine.registers[task].value.epoch, life.sequence)

    def _answer(self, machine: Machine, roll: object, question: object, asker: NodeId, todo: ToDo) -> Answer | None:
        life = self.lives.get(id(machine))
        register = None if life is None else machine.registers.get(question.task)  # type: ignore[attr-defined]
        if isinstance(question, Accept) and register is not None and life is not None:
            owner = question.acceptance.value.owner
            if register.would_accept(question) and not life.leases.may_accept(question.task, owner, self.time):
                return register.refuse(question.acceptance.ballot, Refusal.LEASE)
        known = None if register is None else _newest(register)
        answer = super()._answer(machine, roll, question, asker, todo)  # type: ignore[arg-type]
        if isinstance(answer, Accepted) and isinstance(question, Accept) and life is not None:
            value = question.acceptance.value
            if known is None or value.revision > known.revision:
                life.leases.on_newer_value(value)
        return answer

    def _do(self, machine: Machine, what: Callable[[ToDo], None]) -> None:
        super()._do(machine, what)
        self._note(machine)

    def _note(self, machine: Machine) -> None:
        """Leases follow what was learnt."""
        life, roll = self.lives.get(id(machine)), machine.roll
        if life is None or roll is None:
            return
        value = roll.value
        life.leases.count_with(
            value.electorate.names,
            terms=f"{value.generation_id}/{value.number}",
            number=value.number,
            lease_s=value.lease_s,
            standing=_standing(machine) if roll.is_elector else {},
        )
        for task, register in machine.registers.items():
            learnt = register.value
            if learnt == life.values.get(task):
                continue
            life.values[task] = learnt
            life.leases.on_newer_value(learnt)
            if learnt.leased and learnt.owner == machine.name:
                life.leases.begin(task, learnt.epoch, life.sequence + 1)
            else:
                life.leases.end(task, life.sequence)

    def move_to(self, machine: Machine, task: TaskId, owner: NodeId) -> None:
        """A machine proposes another owner."""
        register = machine.registers.get(task)
        if register is not None:
            change = MoveOwner(base_revision=register.value.revision, owner=owner, reason="play")
            self._do(machine, lambda todo: register.propose(change, todo, self.time))

    def working(self, task: TaskId) -> list[NodeId]:
        """The machines that work on an exclusive task now."""
        return [
            machine.name
            for machine in self.machines
            if machine.is_up
            and (life := self.lives.get(id(machine))) is not None
            and self.time < life.leases.until(task)
        ]

    def _check_owners(self) -> None:
        for task in self._exclusive:
            owners = set(self.working(task))  # of two machines with one name, one stands down: not played here
            if len(owners) > 1:
                raise ChosenError(f"{task} has two owners at {self.time:.2f} s: {', '.join(sorted(owners))}")

    def changes(self) -> list[FleetChange]:
        """The changes that were committed, in their order."""
        return [change for change, outcome in self.ended if outcome is RoundOutcome.COMMITTED and _is_pilots(change)]  # type: ignore[misc]

    def value(self, name: NodeId) -> FleetValue:
        """What a machine has learnt."""
        roll = self.machine(name).roll
        assert roll is not None
        return roll.value


@dataclass(frozen=True, slots=True)
class _BeatMessage(Message):
    beat: Beat


def kind_of(name: NodeId) -> NodeKind:
    """By its first letter."""
    return NodeKind.ROBOT if name.startswith("r") else NodeKind.EDGE


def _newest(register: TaskRegister) -> Allocation | None:
    accepted, learnt = register.state.accepted, register.state.learnt
    if accepted is None or (learnt is not None and learnt.revision >= accepted.value.revision):
        return learnt
    return accepted.value


def _standing(machine: Machine) -> dict[TaskId, Allocation | None]:
    return {task: _newest(register) for task, register in machine.registers.items()}


def _is_pilots(change: object) -> bool:
    return type(change).__name__ in ("AddElector", "RemoveElector", "SetAway")
