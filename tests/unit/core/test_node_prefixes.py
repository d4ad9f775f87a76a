"""Every batch of `Node.handle` is safe when cut after any prefix: the node crashes there and restarts from its disk.

Fleets of real nodes in the simulator. A watcher sees every batch before it is carried out, checks its order and that
nothing leaves which is not on disk, and says where it is cut. The simulator checks agreement after every event.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from random import Random

import pytest

from support.allocations import allocation_of
from support.ballots import ballot_of
from support.fleets import fleet_of, task_of, tuning_of
from support.slices import slices
from support.states import state_of
from zsched.core.executor.handover import Phase
from zsched.core.node.node import Node
from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.durable import DurableState
from zsched.core.values.fleet import Fleet, WorkerSpec, electorate_hash
from zsched.core.values.lease import hold_s
from zsched.core.values.messages import Accept, Accepted, Learnt, Promise
from zsched.core.values.model import NO_BALLOT, Acceptance, NodeId, RegisterState, TaskId
from zsched.core.values.plan import WorkerRole
from zsched_lab.sim.simulator import Simulator

TASK = "merge"
ROBOTS, EDGES = ("robot1", "robot2", "robot3"), ("edge1", "edge2")
APPLIED = (do.ApplyRoutes, do.SetRole, do.StartWorker, do.StopWorker, do.RecordStory)


def fleet(*, exclusive: bool = False) -> Fleet:
    tuning = tuning_of()
    task = task_of(
        TASK,
        EDGES,
        tuning=tuning,
        price_s=0.05,
        worker=WorkerSpec(command=("true",)),
        drain_s=0.2,
        exclusive=exclusive,
        max_moves_per_minute=1000,
    )
    return fleet_of(task, of=sorted((*ROBOTS, *EDGES)))


FLEET, EXCLUSIVE = fleet(), fleet(exclusive=True)


def register(state: DurableState | None, task: TaskId) -> RegisterState:
    blank = RegisterState(task=task, promised=NO_BALLOT)
    return blank if state is None else next((one for one in state.registers if one.task == task), blank)


def told_values(instruction: do.Instruction) -> list[tuple[TaskId, int]]:
    """(task, revision) of every value that an instruction tells others as learnt."""
    if isinstance(instruction, do.PublishBeat):
        return [(task, revision) for task, revision, _ in instruction.beat.learnt if revision > 0]
    if isinstance(instruction, do.PublishLearnt | do.AnswerLearnt):
        return [(value.task, value.revision) for value in instruction.learnt.values]
    return []


def carried_out(instruction: do.Instruction) -> tuple[TaskId, int] | None:
    """(task, epoch) of a route or role."""
    if isinstance(instruction, do.ApplyRoutes) and instruction.plan.current is not None:
        return instruction.plan.task, instruction.plan.current.epoch
    if isinstance(instruction, do.SetRole) and instruction.role.role is WorkerRole.ACTIVE:
        return instruction.role.task, instruction.role.epoch
    return None


def check_backed(instruction: do.Instruction, state: DurableState | None) -> None:
    """What leaves the node stands on its disk."""
    if isinstance(instruction, do.AnswerElection) and isinstance(instruction.answer, Promise | Accepted):
        answer = instruction.answer
        held = register(state, answer.task)
        assert held.promised >= answer.ballot, f"answered without its promise on disk: {answer}"
        if isinstance(answer, Accepted):
            assert held.accepted is not None, f"answered without its acceptance on disk: {answer}"
            assert held.accepted.ballot >= answer.ballot
    if isinstance(instruction, do.PublishBeat):
        for grant in instruction.beat.echoes:
            held = register(state, grant.task)
            known = [value for value in (held.learnt, held.accepted and held.accepted.value) if value]
            assert known, f"granted by what is not on disk: {instruction}"
            newest = max(known, key=lambda value: value.revision)
            assert (newest.owner, newest.epoch) == (grant.owner, grant.epoch), "granted to another one"
    for task, revision in told_values(instruction):
        learnt = register(state, task).learnt
        assert learnt is not None, f"told what is not on disk: {instruction}"
        assert learnt.revision >= revision, f"told what is not on disk: {instruction}"
    applied = carried_out(instruction)
    if applied is not None:
        learnt = register(state, applied[0]).learnt
        assert learnt is not None, f"applied what is not on disk: {instruction}"
        assert learnt.epoch >= applied[1], f"applied what is not on disk: {instruction}"


def check_order(batch: tuple[do.Instruction, ...]) -> None:
    """Persist, then send, then apply."""
    ranks = [0 if isinstance(one, do.PersistState) else 2 if isinstance(one, APPLIED) else 1 for one in batch]
    assert ranks == sorted(ranks), batch
    assert ranks.count(0) <= 1, batch


@dataclass
class Watch:
    """Sees every batch; cuts the one with number ``at`` of the dirty ones after ``keep``, or by chance."""

    sim: Simulator
    at: int = -1
    keep: int = 0
    rng: Random | None = None
    dirty: list[int] = field(default_factory=list)
    """Lengths of the dirty batches seen so far."""
    cuts: int = 0
    revisions: Counter[NodeId] = field(default_factory=Counter)

    def __call__(self, name: NodeId, batch: tuple[do.Instruction, ...]) -> int | None:
        check_order(batch)
        is_dirty = bool(batch) and isinstance(batch[0], do.PersistState)
        self.check(name, batch)
        if is_dirty:
            self.dirty.append(len(batch))
        if self.rng is not None:
            return self.by_chance(batch, is_dirty=is_dirty)
        if not is_dirty or len(self.dirty) - 1 != self.at:
            return None
        self.cuts += 1
        return self.keep

    def by_chance(self, batch: tuple[do.Instruction, ...], *, is_dirty: bool) -> int | None:
        assert self.rng is not None
        if not batch or self.cuts >= 6 or self.rng.random() > (0.12 if is_dirty else 0.002):
            return None
        self.cuts += 1
        return self.rng.randint(0, len(batch))

    def check(self, name: NodeId, batch: tuple[do.Instruction, ...]) -> None:
        state = self.sim.disk(name)
        learnt = register(state, TASK).learnt
        revision = 0 if learnt is None else learnt.revision
        assert revision >= self.revisions[name], f"{name} has unlearnt a revision"
        self.revisions[name] = revision
        for instruction in batch:
            if isinstance(instruction, do.PersistState):
                state = instruction.state
            check_backed(instruction, state)


def is_settled(sim: Simulator) -> bool:
    """Everybody is up and knows one owner, every robot's streams have arrived there."""
    if len(sim.running()) < len(FLEET.nodes):
        return False
    owner = sim.agreed(TASK)
    executors = [sim.node(robot).executors[TASK] for robot in ROBOTS]
    return owner is not None and all(one.phase is Phase.SETTLED and one.owner == owner for one in executors)


def run(watch: Watch) -> None:
    """A first owner, its crash, a move, its return; then all must be well."""
    sim = watch.sim
    sim.cut_batch = watch
    sim.start()
    sim.run_until(lambda: is_settled(sim), 4)
    owner = next((sim.node(name).registers[TASK].value.owner for name in sim.running()), None) or EDGES[0]
    sim.crash(owner)
    sim.run(0.5)
    if owner not in sim.running():
        sim.start(owner)
    assert sim.run_until(lambda: is_settled(sim), 12), "\n".join(sim.stories[-30:])


def base_run() -> list[int]:
    watch = Watch(Simulator(fleet=FLEET, seed=1))
    run(watch)
    return watch.dirty


def test_an_uncut_schedule_persists_promises_acceptances_and_learnt_values() -> None:
    """The sweep below is worth something: there are many dirty batches, and long ones."""
    dirty = base_run()
    assert len(dirty) >= 20
    assert max(dirty) >= 4
    assert base_run() == dirty, "not deterministic: the sweep would cut other batches than it counts"


@pytest.mark.parametrize("part", slices(4))
def test_every_prefix_of_every_dirty_batch_of_a_move_is_safe(part: int) -> None:
    """Exhaustive: one schedule per (dirty batch, prefix); the node crashes there and comes back from its disk."""
    points = [(at, keep) for at, length in enumerate(base_run()) for keep in range(length + 1)]
    for at, keep in points[part::4]:
        watch = Watch(Simulator(fleet=FLEET, seed=1), at=at, keep=keep)
        run(watch)
        assert watch.cuts == 1, (at, keep)


@pytest.mark.parametrize("part", slices(2))
def test_crashes_in_the_middle_of_any_batch_never_let_two_owners_work(part: int) -> None:
    """An exclusive task: its leases live in memory, and a restart must not forget that it granted one."""
    for seed in range(part * 10, part * 10 + 10):
        rng = Random(seed)
        sim = Simulator(fleet=EXCLUSIVE, seed=seed, loss=rng.choice([0.0, 0.05]))
        run(Watch(sim, rng=rng))


@pytest.mark.parametrize("part", slices(4))
def test_crashes_in_the_middle_of_any_batch_never_break_agreement(part: int) -> None:
    """By seed: up to six nodes crash within a batch, at once or one after the other, with and without loss."""
    for seed in range(part * 10, part * 10 + 10):
        rng = Random(seed)
        sim = Simulator(fleet=FLEET, seed=seed, loss=rng.choice([0.0, 0.05]))
        run(Watch(sim, rng=rng))


@pytest.mark.parametrize("name", [*ROBOTS, *EDGES])
def test_a_disk_that_refuses_costs_the_electorate_one_and_nobody_the_task(name: NodeId) -> None:
    """From the first refused write on the node answers no ballot, routes and works on, and says why."""
    sim = Simulator(fleet=FLEET, seed=3)
    sim.start()
    assert sim.run_until(lambda: is_settled(sim), 6)
    sim.broken_disks.add(name)

    def gives_no_vote(node: NodeId, batch: tuple[do.Instruction, ...]) -> None:
        if node == name and not sim.node(name).agreement.is_elector:
            given = [one.answer for one in batch if isinstance(one, do.AnswerElection)]
            assert not any(isinstance(answer, Promise | Accepted) for answer in given), given

    sim.cut_batch = gives_no_vote
    owner = sim.agreed(TASK) or ""
    before = sim.disk(name)
    sim.crash(owner)
    rest = [other for other in sim.running() if other != owner]
    assert sim.run_until(lambda: sim.agreed(TASK, *rest) not in (None, owner), 5), "\n".join(sim.stories[-30:])
    if name != owner:
        sim.run(2)
        node = sim.node(name)
        assert not node.agreement.is_elector
        assert "no elector" in node.agreement.problems["state", ""]
        assert sim.disk(name) == before
        assert name not in ROBOTS or node.executors[TASK].phase is Phase.SETTLED


@pytest.mark.parametrize(("owner", "is_free_at_once"), [("edge1", True), ("edge2", False)])
def test_elector_that_has_just_started_grants_nobody_new_before_its_old_grant_has_run_out(
    owner: NodeId, is_free_at_once: bool
) -> None:
    """Grants live in memory: a crash forgets when the last one was, so the whole lease is waited for."""
    old = allocation_of(task=TASK, tuning=EXCLUSIVE.tasks[0].tuning)
    accepted = Acceptance(ballot=ballot_of(5, "robot2"), value=old)
    held = RegisterState(task=TASK, promised=accepted.ballot, accepted=accepted, learnt=old)
    electorate = electorate_hash(EXCLUSIVE)

    def is_accepted(after_s: float) -> bool:
        state = state_of("robot1", held, incarnation=2, electorate=electorate)
        node = Node(
            fleet=EXCLUSIVE,
            me="robot1",
            durable=state,
            incarnation=2,
            electorate=electorate,
            rng=Random(1),
            now=100.0,
        )
        node.start(100.0)
        for name in {one.name for one in EXCLUSIVE.nodes} - {"robot1"}:  # who starts asks all what they remember of it
            node.handle(ev.LearntReceived(learnt=Learnt(node=name, values=()), is_answer=True), 100.0)
        ballot = ballot_of(6, "robot2")
        value = replace(old, revision=2, epoch=2 if owner != "edge1" else 1, owner=owner)
        asked = Accept(task=TASK, acceptance=Acceptance(ballot=ballot, value=value), electorate=electorate)
        batch = node.handle(ev.AcceptAsked(request=1, asker="robot2", accept=asked), 100.0 + after_s)
        return any(isinstance(one, do.AnswerElection) and isinstance(one.answer, Accepted) for one in batch)

    hold = hold_s(EXCLUSIVE.timing.lease_s)
    assert is_accepted(0.01) is is_free_at_once
    assert is_accepted(hold - 0.01) is is_free_at_once
    assert is_accepted(hold + 0.01)
