"""An owner's node and its lease: which of its beats count, and what its worker is told by them."""

from __future__ import annotations

from dataclasses import replace
from random import Random

import pytest

from support.allocations import allocation_of
from support.beats import beat_of, hear
from support.fleets import fleet_of, task_of
from support.states import state_of
from zsched.core.executor.handover import LEAVES_S
from zsched.core.node.node import Node
from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.beat import Grant
from zsched.core.values.fleet import WorkerSpec, lease_terms
from zsched.core.values.messages import Learnt
from zsched.core.values.model import Allocation, RegisterState
from zsched.core.values.plan import WorkerRole
from zsched.core.values.profile import WorkerState

ROBOTS = ("robot1", "robot2", "robot3")
WORKER = WorkerSpec(command=("true",))
FLEET = fleet_of(task_of("guard", ROBOTS, worker=WORKER, exclusive=True), of=ROBOTS, electors=ROBOTS)


def value(revision: int, owner: str = "robot1") -> Allocation:
    return allocation_of(revision, owner, task="guard", leased=True)


class Owner:
    """A node that has sent some beats and then learns that it owns the task in epoch 4."""

    def __init__(self) -> None:
        state = state_of("robot1", RegisterState(task="guard"))
        self.node = Node(
            fleet=FLEET, me="robot1", durable=state, incarnation=7, electorate="e", rng=Random(1), now=100.0
        )
        self.node.start(100.0)
        hear(self.node, *ROBOTS[1:], now=100.0)
        self.now, self.sequence = 100.0, 0
        self.sent: dict[int, float] = {}
        """{number of a beat: when it left}."""
        self.released: list[int] = []
        """What the newest beat gives back."""
        for _ in range(3):
            self.beat()
        self.last_before = max(self.sent)
        self.learn(value(4))

    def learn(self, new: Allocation) -> None:
        for name in ROBOTS[1:]:
            learnt = Learnt(node=name, values=(new,), lease_terms=lease_terms(FLEET))
            self.handle(ev.LearntReceived(learnt=learnt, is_answer=True))

    def work(self) -> None:
        """Its worker is ready, and works by a lease."""
        self.handle(ev.WorkerChanged(task="guard", state=WorkerState.READY))
        self.beat()
        assert self.echoed(max(self.sent)) is not None

    def handle(self, event: ev.Event) -> tuple[do.Instruction, ...]:
        batch = self.node.handle(event, self.now)
        self.sent |= {one.beat.sequence: self.now for one in batch if isinstance(one, do.PublishBeat)}
        return batch

    def beat(self) -> None:
        """Let the node send its next beat."""
        before = len(self.sent)
        while len(self.sent) == before:
            self.now = max(self.now, self.node.next_deadline())
            self.released = [
                grant.number
                for one in self.handle(ev.DeadlineReached())
                if isinstance(one, do.PublishBeat)
                for grant in one.beat.released
            ]

    def heard(self, name: str, *, echoes: tuple[Grant, ...] = (), is_asked: bool = False) -> tuple[do.Instruction, ...]:
        """A peer's beat comes, which may ask this owner to leave."""
        return self.handle(self.peers_beat(name, echoes=echoes, is_asked=is_asked))

    def peers_beat(self, name: str, *, echoes: tuple[Grant, ...] = (), is_asked: bool = False) -> ev.BeatReceived:
        """A peer's beat, which may ask this owner to leave."""
        self.sequence += 1
        beat = beat_of(
            name,
            self.sequence,
            learnt=(("guard", 4, 4),),
            echoes=echoes,
            asked_to_leave=(("guard", "robot1", 4),) if is_asked else (),
            lease_terms=lease_terms(FLEET),
        )
        return ev.BeatReceived(beat=beat)

    def echoed(self, number: int) -> float | None:
        """Both others echo one of our numbers; until when the worker is then told that it may work."""
        told = None
        grant = Grant(task="guard", owner="robot1", incarnation=7, epoch=4, number=number)
        for name in ROBOTS[1:]:
            for one in self.heard(name, echoes=(grant,)):
                if isinstance(one, do.SetRole) and one.role.lease_until_s:
                    told = one.role.lease_until_s
        return told


def test_the_first_beat_after_an_epoch_was_learnt_counts_and_the_last_one_before_does_not() -> None:
    owner = Owner()
    first = owner.last_before + 1
    assert owner.echoed(first - 1) is None
    if first not in owner.sent:
        owner.beat()
    assert owner.echoed(first) == pytest.approx(owner.sent[first] + FLEET.timing.lease_s)


def test_whoever_is_followed_gives_back_every_number_up_to_the_last_one_sent() -> None:
    owner = Owner()
    owner.work()
    last = max(owner.sent)
    owner.learn(value(5, "robot2"))
    owner.beat()
    assert owner.released == [last]


@pytest.mark.parametrize("has_died", [False, True])
def test_the_word_of_a_worker_whose_process_ended_meanwhile_gives_nothing_back(*, has_died: bool) -> None:
    """It may be the dead one's, and the next one at work already: then only the end of the lease counts."""
    owner = Owner()
    owner.work()
    if has_died:
        owner.handle(ev.WorkerChanged(task="guard", state=WorkerState.STOPPED))
        owner.work()
    for name in ROBOTS[1:]:
        owner.heard(name, is_asked=True)
    owner.handle(ev.RoleEnded(task="guard", epoch=4))
    owner.beat()
    assert bool(owner.released) is not has_died


def test_a_worker_s_word_that_waits_behind_the_order_to_leave_gives_nothing_back() -> None:
    """Both are taken in at once behind a stall, so the word is of a stop before: the worker may be at work again."""
    owner = Owner()
    owner.work()
    until = owner.node.executors["guard"].role.lease_until_s
    assert until is not None
    for name in ROBOTS[1:]:
        owner.node.absorb(owner.peers_beat(name, is_asked=True), owner.now)
    owner.node.absorb(ev.RoleEnded(task="guard", epoch=4), owner.now)
    batch = owner.handle(ev.DeadlineReached())
    (told,) = (one.role.role for one in batch if isinstance(one, do.SetRole))
    assert told is WorkerRole.IDLE, "it is told to stop now"
    owner.beat()
    assert owner.now < until
    assert owner.released == []
    owner.handle(ev.RoleEnded(task="guard", epoch=4))
    owner.beat()
    assert owner.released, "and that stop's word counts"


def test_the_word_of_a_worker_that_stops_for_its_clock_gives_back_what_others_wait_for() -> None:
    """It was told to stop by the doubt, before anybody asked."""
    owner = Owner()
    owner.work()
    batch = owner.handle(ev.ClockCompared(error_ratio=0.1))
    assert [one.role.role for one in batch if isinstance(one, do.SetRole)] == [WorkerRole.IDLE]
    for name in ROBOTS[1:]:
        owner.heard(name, is_asked=True)
    owner.handle(ev.RoleEnded(task="guard", epoch=4))
    owner.beat()
    assert owner.released


def test_a_worker_that_was_not_at_work_when_its_process_ended_leaves_no_word_behind() -> None:
    owner = Owner()
    owner.handle(ev.WorkerChanged(task="guard", state=WorkerState.STARTING))
    owner.handle(ev.WorkerChanged(task="guard", state=WorkerState.STOPPED))
    owner.work()
    for name in ROBOTS[1:]:
        owner.heard(name, is_asked=True)
    owner.handle(ev.RoleEnded(task="guard", epoch=4))
    owner.beat()
    assert owner.released


def test_a_stranger_s_answer_is_none_of_those_that_an_owner_waits_for() -> None:
    owner = Owner()
    owner.learn(replace(value(5), leased=False))
    owner.beat()
    for name in ("robot2", "ghost"):
        learnt = Learnt(node=name, values=(), lease_terms=lease_terms(FLEET))
        owner.handle(ev.LearntReceived(learnt=learnt, is_answer=True))
    assert "robot2" in owner.node.sealing._answers
    assert "ghost" not in owner.node.sealing._answers


@pytest.mark.parametrize("is_ready", [True, False])
def test_a_worker_that_was_not_ready_when_it_was_told_to_stop_works_without_a_lease_no_more_once_it_is(
    is_ready: bool,
) -> None:
    """It has shown no epoch, so it never says that it has left one: the fleet waited until it was started anew."""
    by_old_file = replace(FLEET, tasks=(replace(*FLEET.tasks, exclusive=False),))
    state = state_of("robot1", RegisterState(task="guard"))
    node = Node(fleet=by_old_file, me="robot1", durable=state, incarnation=7, electorate="e", rng=Random(1), now=100.0)
    node.start(100.0)
    hear(node, *ROBOTS[1:], now=100.0)
    node.handle(ev.WorkerChanged(task="guard", state=WorkerState.STARTING), 100.0)
    for new in (replace(value(4), leased=False), replace(value(5), epoch=4)):
        learnt = Learnt(node="robot2", values=(new,))
        node.handle(ev.LearntReceived(learnt=learnt, is_answer=True), 100.1)
    assert node.executors["guard"].role.role is WorkerRole.IDLE
    if is_ready:
        node.handle(ev.WorkerChanged(task="guard", state=WorkerState.READY), 101.0)
    batch = node.handle(ev.LearntAsked(request=1), 101.0 + LEAVES_S)
    (answer,) = [one.learnt for one in batch if isinstance(one, do.AnswerLearnt)]
    assert answer.unleased == (() if is_ready else ("guard",))
