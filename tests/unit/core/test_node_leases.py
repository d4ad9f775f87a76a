"""An owner's node and its lease: which of its beats count, and what its worker is told by them."""

from __future__ import annotations

from random import Random

import pytest

from zsched.core import events as ev
from zsched.core import instructions as do
from zsched.core.fleet import Fleet, NodeSpec, TaskSpec, Timing, WorkerSpec, lease_terms
from zsched.core.messages import Learnt
from zsched.core.model import Allocation, Beat, DurableState, Grant, NodeKind, RegisterState, Tuning, Weights
from zsched.core.node import Node

ROBOTS = ("robot1", "robot2", "robot3")
TUNING = Tuning(weights=Weights(cpu=0.5, memory=0.5, network=0.0))
WORKER = WorkerSpec(command=("true",))
FLEET = Fleet(
    name="owners",
    timing=Timing(),
    nodes=tuple(NodeSpec(name=name, kind=NodeKind.ROBOT) for name in ROBOTS),
    tasks=(TaskSpec(name="guard", candidates=ROBOTS, tuning=TUNING, worker=WORKER, exclusive=True),),
    electors=ROBOTS,
)


def value(revision: int) -> Allocation:
    return Allocation(task="guard", revision=revision, epoch=revision, owner="robot1", tuning=TUNING, leased=True)


class Owner:
    """A node that has sent some beats and then learns that it owns the task in epoch 4."""

    def __init__(self) -> None:
        state = DurableState(
            fleet="owners",
            node="robot1",
            incarnation=7,
            generation=0,
            hardware="h",
            electorate="e",
            registers=(RegisterState(task="guard"),),
        )
        self.node = Node(
            fleet=FLEET, me="robot1", durable=state, incarnation=7, electorate="e", rng=Random(1), now=100.0
        )
        self.node.start(100.0)
        self.now, self.sequence = 100.0, 0
        self.sent: dict[int, float] = {}
        """{number of a beat: when it left}."""
        for _ in range(3):
            self.beat()
        self.last_before = max(self.sent)
        for name in ROBOTS[1:]:
            learnt = Learnt(node=name, values=(value(4),), lease_terms=lease_terms(FLEET))
            self.handle(ev.LearntReceived(learnt=learnt, is_answer=True))

    def handle(self, event: ev.Event) -> tuple[do.Instruction, ...]:
        batch = self.node.handle(event, self.now)
        self.sent |= {one.beat.sequence: self.now for one in batch if isinstance(one, do.PublishBeat)}
        return batch

    def beat(self) -> None:
        """Let the node send its next beat."""
        before = len(self.sent)
        while len(self.sent) == before:
            self.now = max(self.now, self.node.next_deadline())
            self.handle(ev.DeadlineReached())

    def echoed(self, number: int) -> float | None:
        """Both others echo one of our numbers; until when the worker is then told that it may work."""
        told = None
        self.sequence += 1
        grant = Grant(task="guard", owner="robot1", incarnation=7, epoch=4, number=number)
        for name in ROBOTS[1:]:
            beat = Beat(
                node=name,
                incarnation=1,
                sequence=self.sequence,
                loop_lag_s=0.0,
                learnt=(("guard", 4, 4),),
                echoes=(grant,),
                lease_terms=lease_terms(FLEET),
            )
            for one in self.handle(ev.BeatReceived(beat=beat)):
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
