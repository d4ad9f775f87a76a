"""The register under random schedules: loss, duplication, reordering, crashes between persisting and sending.

A tiny deterministic network around production registers. What a node has not persisted it forgets when it crashes;
every schedule is one seed, and a failure prints it. The last tests plant bugs and expect this harness to find them.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable
from dataclasses import dataclass, replace
from random import Random

import pytest

from support.ballots import ballot_of
from support.registers import BALLOT_S, INITIAL, TUNING, Step, accepted, did, promised
from zsched.core.register.task_register import TaskRegister
from zsched.core.values.change import Change, MoveOwner, Retune, RoundOutcome
from zsched.core.values.fleet import Timing
from zsched.core.values.messages import Accept, Accepted, Prepare, Promise, Refused
from zsched.core.values.model import Acceptance, Allocation, RegisterState
from zsched.core.values.quorum import majority
from zsched.core.values.todo import ToDo

FAULTS_END_S = 3.0
Message = Prepare | Accept | Promise | Accepted | Refused | Allocation


class ViolationError(AssertionError):
    """An invariant of the register does not hold."""


@dataclass
class Host:
    """One machine: what it has on disk, and the register that a crash takes away."""

    name: str
    incarnation: int
    disk: RegisterState
    register: TaskRegister | None = None


class World:
    """A fleet of registers, its network and its clock; raises `ViolationError` when an invariant breaks."""

    def __init__(self, seed: int, register_class: type[TaskRegister] = TaskRegister) -> None:
        self.rng = Random(seed)
        self.electors = tuple(f"r{i}" for i in range(self.rng.choice((1, 2, 3, 3, 3, 4, 5))))
        names = (*self.electors, "edge")  # the edge proposes and learns, but has no say
        self.hosts = {name: Host(name, 0, RegisterState(task="merge")) for name in names}
        self.register_class = register_class
        self.loss, self.double = self.rng.choice((0.0, 0.05, 0.25)), self.rng.choice((0.0, 0.1))
        self.crash_rate = self.rng.choice((0.0, 0.01, 0.08))
        self.promise_risk = self.rng.choice((self.crash_rate, 0.3))  # between promise and acceptance it is tightest
        self.slowest = self.rng.choice((0.02, 0.25, 0.5))
        self.now, self.sent, self.changes = 0.0, 0, 0
        self.ticked_at, self.spins = -1.0, 0
        self.calls: list[tuple[float, int, Callable[[], None]]] = []
        self.persisted: dict[Acceptance, set[str]] = {}
        self.chosen: dict[int, Allocation] = {0: INITIAL}
        self.ended: list[tuple[Change, RoundOutcome]] = []
        for name in names:
            self.start(name)

    # --- machines ----------------------------------------------------------------------------------------------

    def start(self, name: str) -> None:
        host = self.hosts[name]
        host.incarnation += 1
        host.register = self.register_class(
            me=name,
            incarnation=host.incarnation,
            electors=self.electors,
            electorate="e1",
            is_elector=name in self.electors,
            initial=INITIAL,
            state=host.disk,
            clocks=lambda: Timing(ballot_s=BALLOT_S, stagger_s=0.03),
            rng=Random(self.rng.random()),
        )
        self.take(host, did(host.register.settle, self.now))

    def crash(self, host: Host) -> None:
        host.register = None
        self.after(10 ** self.rng.uniform(-3.0, 0.0), lambda: self.start(host.name))

    def take(self, host: Host, step: Step, answer: tuple[str, Message] | None = None) -> None:
        """Persist, then send, then apply; a crash may cut between any two of them."""
        assert host.register is not None
        if step.problem:
            raise ViolationError(step.problem)
        if step.is_dirty:
            self.persist(host, host.register.state)
        if self.faulty() and self.rng.random() < self.crash_rate:
            return self.crash(host)
        if answer is not None:
            self.check_on_disk(host, answer[1])
            self.send(answer[0], answer[1], host.name)
        for message in (step.prepare, step.accept):
            for elector in self.electors if message is not None else ():
                assert message is not None
                self.send(elector, message, host.name)
        risk = self.promise_risk if answer is not None and isinstance(answer[1], Promise) else self.crash_rate
        if self.faulty() and self.rng.random() < risk:
            return self.crash(host)
        if step.learnt is not None:
            self.check_learnt(step.learnt)
        for end in step.ends:
            self.on_end(host, *end)
        if step.learnt is not None:
            for other in self.hosts:
                self.send(other, step.learnt, host.name)
        return None

    def persist(self, host: Host, state: RegisterState) -> None:
        if state.promised < host.disk.promised:
            raise ViolationError(f"{host.name} promised {state.promised} after {host.disk.promised}")
        host.disk = state
        if state.accepted is not None and host.name in self.electors:
            self.persisted.setdefault(state.accepted, set()).add(host.name)
        if state.learnt is not None:
            self.check_learnt(state.learnt)

    # --- invariants --------------------------------------------------------------------------------------------

    def check_on_disk(self, host: Host, answer: Message) -> None:
        """A promise is on disk before it leaves; two values hardly ever come of one that a crash forgets."""
        if isinstance(answer, Promise) and host.disk.promised < answer.ballot:
            raise ViolationError(f"{host.name} promises {answer.ballot} with {host.disk.promised} on its disk")

    def check_learnt(self, value: Allocation) -> None:
        if self.chosen.setdefault(value.revision, value) != value:
            raise ViolationError(f"revision {value.revision}: {self.chosen[value.revision].owner} and {value.owner}")
        behind = [who for acceptance, who in self.persisted.items() if acceptance.value == value]
        if not any(len(who) >= majority(len(self.electors)) for who in behind):
            raise ViolationError(f"revision {value.revision} was learnt without a majority of acceptances on disk")

    def on_end(self, host: Host, change: Change, outcome: RoundOutcome) -> None:
        self.ended.append((change, outcome))
        if outcome is not RoundOutcome.COMMITTED:
            return
        learnt = None if host.register is None else host.register.state.learnt
        if learnt is None or learnt.revision < change.base_revision + 1:
            raise ViolationError(f"{change} committed, but not learnt")
        if not is_made_by(self.chosen[change.base_revision + 1], change):
            raise ViolationError(f"{change} said committed, but revision {change.base_revision + 1} is another's")

    def check_end(self) -> None:
        """No change was applied twice, and one that was said not to be applied was not applied at all."""
        for change, outcome in self.ended:
            made = [revision for revision, value in self.chosen.items() if is_made_by(value, change)]
            starts = [r for r in made if r - 1 not in made]  # a Retune's successor inherits the owner, and so on
            if len(starts) > 1:
                raise ViolationError(f"{change} was applied twice: {starts}")
            if made and outcome in (RoundOutcome.CONFLICT, RoundOutcome.NO_QUORUM):
                raise ViolationError(f"{change} ended as {outcome}, but stands in revision {made[0]}")

    # --- network and clock -------------------------------------------------------------------------------------

    def faulty(self) -> bool:
        return self.now < FAULTS_END_S

    def after(self, delay: float, call: Callable[[], None]) -> None:
        self.sent += 1
        heapq.heappush(self.calls, (self.now + delay, self.sent, call))

    def send(self, to: str, message: Message, by: str) -> None:
        copies = 1
        if self.faulty():
            copies = 0 if self.rng.random() < self.loss else 2 if self.rng.random() < self.double else 1
        for _ in range(copies):
            delay = self.rng.uniform(0.001, self.slowest if self.faulty() else 0.01)
            self.after(delay, lambda: self.deliver(to, message, by))

    def deliver(self, to: str, message: Message, by: str) -> None:
        host = self.hosts[to]
        register = host.register
        if register is None:
            return
        if isinstance(message, Prepare):
            step, promise = promised(register, message)
            self.take(host, step, (by, promise))
        elif isinstance(message, Accept):
            step, answer = accepted(register, message, self.now)
            self.take(host, step, (by, answer))
        elif isinstance(message, Allocation):
            self.take(host, did(register.learn, message, self.now))
        else:
            self.take(host, did(register.on_answer, message, self.now))

    def propose(self, name: str, *, stale: bool = False) -> Change | None:
        register = self.hosts[name].register
        if register is None:
            return None
        self.changes += 1
        base = max(register.value.revision - stale, 0)
        change: Change = MoveOwner(base_revision=base, owner=f"c{self.changes}", reason="test")
        if self.rng.random() < 0.3:
            change = Retune(base_revision=base, tuning=replace(TUNING, bonus=self.changes / 1000))
        self.take(self.hosts[name], did(register.propose, change, self.now))
        return change

    def run(self, until: float) -> None:
        while True:
            due = [(h.register.next_deadline(), h.name) for h in self.hosts.values() if h.register is not None]
            deadline, name = min(due, default=(until, ""))
            call_at = self.calls[0][0] if self.calls else until
            if min(deadline, call_at) >= until:
                self.now = until
                return
            if call_at <= deadline:
                self.now, _, call = heapq.heappop(self.calls)
                call()
                continue
            self.now = max(self.now, deadline)
            host = self.hosts[name]
            assert host.register is not None
            self.spins = self.spins + 1 if self.now == self.ticked_at else 0
            self.ticked_at = self.now
            if self.spins > 20:
                raise ViolationError(f"{name}: a deadline in the past spins the loop")
            self.take(host, did(host.register.tick, self.now))

    def fault_phase(self) -> None:
        window = self.rng.choice((0.2, FAULTS_END_S))  # duels, or one after another
        for _ in range(self.rng.randrange(2, 9)):
            self.after(self.rng.uniform(0.0, window), self.propose_somewhere)
        self.run(FAULTS_END_S + 1.1)  # by then whoever crashed has started again

    def propose_somewhere(self) -> None:
        self.propose(self.rng.choice(tuple(self.hosts)), stale=self.rng.random() < 0.1)

    def agree(self) -> Change:
        """Beats' work (everybody hears the newest learnt value), then one change that nothing disturbs."""
        self.run(self.now + 12.0)
        newest = self.chosen[max(self.chosen)]
        for host in self.hosts.values():
            assert host.register is not None
            if newest.revision:
                self.take(host, did(host.register.learn, newest, self.now))
        change = self.propose(self.rng.choice(tuple(self.hosts)))
        assert change is not None
        self.run(self.now + 3.0)
        return change


def is_made_by(value: Allocation, change: Change) -> bool:
    """Whether ``value`` holds what ``change`` (each has a name of its own) sets."""
    if isinstance(change, MoveOwner):
        return value.owner == change.owner
    assert isinstance(change, Retune)
    return value.tuning == change.tuning


def play(seed: int, register_class: type[TaskRegister] = TaskRegister) -> World:
    world = World(seed, register_class)
    try:
        world.fault_phase()
        change = world.agree()
        world.check_end()
    except ViolationError as violation:
        raise ViolationError(f"seed {seed}: {violation}") from violation
    if (change, RoundOutcome.COMMITTED) not in world.ended:
        raise ViolationError(f"seed {seed}: faults ended, but the next change did not commit: {world.ended[-3:]}")
    return world


def play_all(seeds: range, register_class: type[TaskRegister]) -> None:
    for seed in seeds:
        play(seed, register_class)


@pytest.mark.parametrize("block", range(4))
def test_register_random_schedules_keep_one_value_per_revision_and_commit_once_faults_end(block: int) -> None:
    outcomes: set[RoundOutcome] = set()
    newest = 0
    for seed in range(block * 400, (block + 1) * 400):
        world = play(seed)
        outcomes |= {outcome for _, outcome in world.ended}
        newest = max(newest, *world.chosen)
        last = [host.register and host.register.state.learnt for host in world.hosts.values()]
        assert last.count(last[0]) == len(last), f"seed {seed}: nodes ended with different values"
    assert outcomes >= {RoundOutcome.COMMITTED, RoundOutcome.CONFLICT}
    assert newest >= 4  # the schedules do get somewhere


def test_register_unlearnt_majority_after_power_loss_is_learnt_without_a_new_proposal() -> None:
    """Everybody accepted, the proposer died before it could tell, all lost power: identity rounds find the value."""
    world = World(7)
    world.electors = ("r0", "r1", "r2")
    world.crash_rate = world.loss = 0.0
    world.calls.clear()
    ballot = ballot_of(node="edge")
    acceptance = Acceptance(ballot=ballot, value=replace(INITIAL, revision=1, epoch=1, owner="e1"))
    disk = RegisterState(task="merge", promised=ballot, accepted=acceptance)
    world.hosts = {name: Host(name, 1, disk) for name in world.electors}
    world.persisted[acceptance] = set(world.electors)
    world.start("r0")
    world.run(world.now + 4.0)  # alone: its first identity rounds find no majority
    world.start("r1")
    world.run(world.now + 12.0)
    owners = [host.disk.learnt.owner if host.disk.learnt else None for host in world.hosts.values()]
    assert owners[:2] == ["e1", "e1"]


# --- test the test: planted bugs must be found ------------------------------------------------------------------


class ForgetsPromises(TaskRegister):
    """Answers before the promise is on disk."""

    def on_prepare(self, prepare: Prepare, _todo: ToDo) -> Promise | Refused:
        return super().on_prepare(prepare, ToDo())


class ForgetsAcceptances(TaskRegister):
    """Answers before the acceptance is on disk."""

    def on_accept(self, accept: Accept, _todo: ToDo, now: float) -> Accepted | Refused:
        return super().on_accept(accept, ToDo(), now)


class PromisesBackwards(TaskRegister):
    """Promises a lower ballot after a higher one."""

    def on_prepare(self, prepare: Prepare, todo: ToDo) -> Promise | Refused:
        self.state = replace(self.state, promised=replace(self.state.promised, counter=0))
        return super().on_prepare(prepare, todo)


class IgnoresWhatItReads(TaskRegister):
    """Puts its own change through, whatever the promises brought."""

    def on_answer(self, answer: Promise | Accepted | Refused, todo: ToDo, now: float) -> None:
        if isinstance(answer, Promise):
            answer = replace(answer, accepted=None)
        super().on_answer(answer, todo, now)


class TellsNobody(TaskRegister):
    """An elector that never asks what became of what it accepted, and never retries."""

    def next_deadline(self) -> float:
        return float("inf")


MUTANTS = (ForgetsPromises, ForgetsAcceptances, PromisesBackwards, IgnoresWhatItReads, TellsNobody)


@pytest.mark.parametrize("mutant", MUTANTS)
def test_harness_finds_a_planted_bug(mutant: type[TaskRegister]) -> None:
    with pytest.raises(ViolationError):
        play_all(range(50), mutant)
