"""A turn of the daemon's loop: behind a deadline all that waits is taken in first, in its order, and time judged then.

The node and the inbox are real; the clock and what carries instructions out are the tests'.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from random import Random
from typing import Any

import pytest

from support.allocations import allocation_of
from support.ballots import ballot_of
from support.beats import beat_of
from support.fleets import EDGES, ROBOTS, fleet_of, task_of
from support.profiles import SAMPLE, load_of, profile_of
from support.states import state_of
from zsched import daemon
from zsched.config.timing import WIRED
from zsched.core.node.node import Node
from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.fleet import Fleet, lease_terms
from zsched.core.values.messages import Learnt, MoveTask, Prepare, Promise, Refused
from zsched.core.values.model import Acceptance, Asked, RegisterState
from zsched.core.values.struct import replace
from zsched.host.clock import SleepWatch
from zsched.runtime.inbox import Inbox

STALL_S = 1.6


def exclusive() -> Fleet:
    """Three nodes: who is suspect and says nothing is gone at once."""
    return fleet_of(task_of(exclusive=True), of=("robot1", *EDGES), timing=WIRED)


def beat(name: str, number: int) -> ev.BeatReceived:
    """Of a node that has the same fleet file, and the task's value."""
    told = beat_of(name, number, learnt=(("merge", 4, 4),), lease_terms=lease_terms(exclusive()))
    return ev.BeatReceived(beat=told)


class Loop:
    """A daemon with nothing but its inbox and its loop, and the node of ``robot1``."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, fleet: Fleet) -> None:
        self.now = 100.0
        monkeypatch.setattr(daemon, "monotonic_s", lambda: self.now)
        self.daemon = object.__new__(daemon.Daemon)
        self.inbox = self.daemon._inbox = Inbox()
        self.daemon._sleeps, self.daemon._is_ready, self.daemon._alert_until = SleepWatch(), True, -math.inf
        learnt = RegisterState(task="merge", learnt=allocation_of(4, "edge1", leased=fleet.tasks[0].exclusive))
        self.node = Node(
            fleet=fleet,
            me="robot1",
            durable=state_of("robot1", learnt),
            incarnation=7,
            electorate="e",
            rng=Random(1),
            now=self.now,
        )
        self.done: list[do.Instruction] = []
        self.batches: list[tuple[do.Instruction, ...]] = []
        self.carry_out(self.node.start(self.now))
        for name in (node.name for node in fleet.nodes if node.name != "robot1"):
            self.handle(ev.LearntReceived(learnt=Learnt(node=name, values=()), is_answer=True))
            self.handle(beat(name, 1))
            self.handle(ev.ProfileReceived(profile=profile_of(name, workers=(load_of(),))))
        self.handle(ev.ProfileSampled(device=SAMPLE))
        while self.node.next_deadline() <= self.now:
            self.handle(ev.DeadlineReached())

    def carry_out(self, batch: Iterable[do.Instruction]) -> None:
        """Stands in for the shell's."""
        self.batches.append(tuple(batch))
        self.done.extend(self.batches[-1])

    def waiting_frames(self) -> Iterator[ev.Event]:
        """No beat waits in a ring: a task is exclusive."""
        return iter(())

    def handle(self, event: ev.Event) -> None:
        """Without a turn of the loop."""
        self.carry_out(self.node.handle(event, self.now))

    def turn(self) -> list[ev.Event]:
        """One turn; what it took."""
        shell: Any = self
        taken, _ = self.daemon._turn(self.node, shell, self.inbox.take(0.0) or ev.DeadlineReached())
        return taken

    def told(self) -> list[str]:
        """What became of its peers since the last call."""
        found = [one.text for one in self.done if isinstance(one, do.RecordStory) and one.stage == "membership"]
        self.done.clear()
        return found


def waiting_beats() -> list[ev.Event]:
    """As the control session posts them where a task is exclusive, with something else between them."""
    return [
        beat("edge2", 2),
        ev.RoleEnded(task="merge", epoch=4),
        beat("edge2", 3),
        beat("edge1", 2),
    ]


def test_after_a_stall_nobody_is_accused_whose_beat_waits_in_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    loop = Loop(monkeypatch, exclusive())
    waiting = waiting_beats()
    for event in waiting:
        loop.inbox.post(event)
    loop.now += STALL_S
    loop.told()
    assert loop.turn() == waiting
    assert not any(isinstance(one, do.PublishProposal) for one in loop.done), "nor is its task moved"
    assert loop.told() == []

    hasty = Loop(monkeypatch, exclusive())
    hasty.now += STALL_S
    hasty.handle(waiting[0])
    assert any(isinstance(one, do.PublishProposal) and one.proposal.is_escape for one in hasty.done)
    assert any("edge1 suspect -> gone" in text for text in hasty.told()), "what it is good for"


def test_a_turn_in_time_takes_one_event(monkeypatch: pytest.MonkeyPatch) -> None:
    loop = Loop(monkeypatch, exclusive())
    first, *_ = waiting = waiting_beats()
    for event in waiting:
        loop.inbox.post(event)
    assert loop.turn() == [first]


def test_a_disk_that_refuses_late_accuses_nobody_whose_beat_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    """The write took the time, and its failure is handled before anything else."""
    loop = Loop(monkeypatch, exclusive())
    loop.told()

    def refuses(batch: Iterable[do.Instruction]) -> None:
        loop.done.extend(batch)
        if loop.now < 100.0 + STALL_S:
            loop.now = 100.0 + STALL_S
            for event in waiting_beats():
                loop.inbox.post(event)
            loop.inbox.put_first(ev.PersistFailed(reason="no space left on device"))

    monkeypatch.setattr(loop, "carry_out", refuses)
    taken = loop.turn()
    assert [type(one) for one in taken[:3]] == [ev.DeadlineReached, ev.PersistFailed, ev.BeatReceived]
    assert loop.told() == []


def test_a_flood_does_not_put_deadlines_off_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(daemon, "INBOX_LIMIT", 3)
    loop = Loop(monkeypatch, exclusive())
    loop.now += STALL_S
    for number in range(2, 7):
        loop.inbox.post(beat("edge2", number))
    loop.told()
    assert len(loop.turn()) == 3
    assert any("edge1 alive -> suspect" in text for text in loop.told())


def test_time_is_read_before_the_look_that_finds_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """A loop that stops just then has not heard what comes meanwhile: it judges by the time of before."""
    loop = Loop(monkeypatch, exclusive())
    loop.inbox.post(waiting_beats()[0])
    loop.now = loop.node.next_deadline()
    loop.told()
    take, stalls = loop.inbox.take, iter([0.0, 60.0])

    def slow_take(timeout_s: float) -> ev.Event | None:
        event = take(timeout_s)
        loop.now += next(stalls, 0.0)
        return event

    monkeypatch.setattr(loop.inbox, "take", slow_take)
    loop.turn()
    assert loop.now > 160.0
    assert loop.told() == []


def ballot(monkeypatch: pytest.MonkeyPatch) -> tuple[Loop, list[ev.Event], Prepare]:
    """A loop that stood still in its own promise's write, for longer than a ballot; two promises; the question."""
    fleet = fleet_of(task_of(), of=(*EDGES, *ROBOTS))
    held = Acceptance(ballot=ballot_of(1, "edge1"), value=allocation_of(4, "edge1"))
    loop = Loop(monkeypatch, fleet)
    order = MoveTask(task="merge", node="edge2", asked=Asked(by="op@robot1"))
    loop.handle(ev.MoveCommanded(request=1, command=order))
    (prepare,) = (one.prepare for one in loop.done if isinstance(one, do.SendPrepare))
    loop.handle(ev.PrepareAsked(request=2, asker="robot1", prepare=prepare))
    assert any(isinstance(one, do.PersistState) for one in loop.done)
    promises: list[ev.Event] = []
    for name in ROBOTS[1:]:
        promise = Promise(elector=name, task="merge", ballot=prepare.ballot, accepted=held)
        promises.append(ev.ElectorAnswered(answer=promise))
    loop.now += fleet.timing.ballot_s + 0.1
    loop.done.clear()
    loop.batches.clear()
    return loop, promises, prepare


def test_a_ballot_goes_on_whose_answers_wait_behind_a_slow_write(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two others have promised, and that is enough, whether the deadline is judged before their answers or after."""
    for is_hasty in (False, True):
        loop, promises, _ = ballot(monkeypatch)
        for event in promises:
            if is_hasty:
                loop.handle(event)
            else:
                loop.inbox.post(event)
        loop.turn()
        assert any(isinstance(one, do.SendAccept) for one in loop.done)


def test_what_a_node_asks_does_not_wait_for_what_it_writes_for_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """A rival's question lies before the answers: in one batch with its write the accept would leave too late."""
    loop, promises, prepare = ballot(monkeypatch)
    rival = ballot_of(prepare.ballot.counter + 1, "robot2")
    asked = ev.PrepareAsked(request=3, asker="robot2", prepare=replace(prepare, ballot=rival))
    for event in (promises[0], asked, promises[1], beat("edge1", 2)):
        loop.inbox.post(event)
    loop.turn()
    asks, writes = loop.batches
    assert any(isinstance(one, do.SendAccept) for one in asks)
    assert not any(isinstance(one, do.PersistState) for one in asks)
    (answer,) = (one.answer for one in writes if isinstance(one, do.AnswerElection))
    assert (type(writes[0]), type(answer)) == (do.PersistState, Promise)


def test_a_refused_write_is_known_before_anything_is_promised(monkeypatch: pytest.MonkeyPatch) -> None:
    loop, promises, prepare = ballot(monkeypatch)
    rival = ballot_of(prepare.ballot.counter + 1, "robot2")
    for event in (*promises, ev.PrepareAsked(request=3, asker="robot2", prepare=replace(prepare, ballot=rival))):
        loop.inbox.post(event)
    carry_out, failures = loop.carry_out, iter([ev.PersistFailed(reason="no space left on device")])

    def refuses(batch: Iterable[do.Instruction]) -> None:
        carry_out(batch)
        if (failed := next(failures, None)) is not None:
            loop.inbox.put_first(failed)

    monkeypatch.setattr(loop, "carry_out", refuses)
    assert isinstance(loop.turn()[-1], ev.PersistFailed)
    assert not any(isinstance(one, do.PersistState) for one in loop.done)
    (answer,) = (one.answer for one in loop.done if isinstance(one, do.AnswerElection))
    assert isinstance(answer, Refused)
