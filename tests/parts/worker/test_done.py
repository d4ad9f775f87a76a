"""When a worker acknowledges an input, over real sessions: its answers first, and nobody waits for a frozen robot."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import zenoh

from support.hand_relay import KEYS, Relay, environment
from support.waiting import until, within
from zsched.core.hop.shared import STALLED_S
from zsched.core.values import codec as wire
from zsched.core.values.plan import WorkerRole
from zsched.core.values.relay_protocol import StreamAck, StreamAcks
from zsched.host.clock import monotonic_s
from zsched.link.keyspace import AGAIN_CHUNK
from zsched.worker import Output, Received, Worker

OUT = "edge1/t/1/shared/out"


class Scene:
    """A worker in this process whose answers several robots get; what they acknowledge is the test's choice."""

    def __init__(self, relay: Relay, worker: Worker) -> None:
        self.relay, self.worker = relay, worker
        self.own = str(relay.session.zid())
        self.answer: Callable[[Received], object] = lambda received: self.out.put(received.payload)
        self.heard: list[tuple[int, int]] = []
        self.out: Output = worker.publisher("{prefix}/{epoch}/shared/out", reliable=True)
        worker.subscribe("{prefix}/*/in", self._take)
        worker.ready()
        until(lambda: KEYS.worker("edge1", "t", 3) in relay.tokens, "the ready token")
        relay.tell(WorkerRole.ACTIVE, 1)
        until(lambda: worker.role.epoch == 1, "the role")
        self._subscribers = [relay.session.declare_subscriber(OUT, self._hear)]
        relay.greet(is_whole=True)

    def _take(self, received: Received) -> None:
        self.answer(received)

    def _hear(self, sample: zenoh.Sample) -> None:
        source = sample.source_info
        assert source is not None
        self.heard.append((source.source_id.eid, source.source_sn))

    def subscribe_again(self) -> None:
        """As a relay does that keeps up with the worker's numbers."""
        self._subscribers.append(self.relay.session.declare_subscriber(f"{OUT}/{AGAIN_CHUNK}/{self.own}", self._hear))

    def ack(self, node: str, relay: str, arrived: int) -> None:
        word = StreamAck(eid=self.heard[0][0], first=0, arrived=arrived, processed=arrived)
        key = KEYS.received(node, relay, str(self.worker.session.zid()))
        self.relay.session.put(key, wire.encode(StreamAcks(acks=(word,))))

    def put(self) -> None:
        before = len(self.heard)
        self.relay.put(b"x")
        until(lambda: len(self.heard) > before, "the answer")

    @property
    def processed(self) -> int:
        return self.relay.acks[-1].processed


@pytest.fixture
def scene(relay: Relay, tmp_path: Path) -> Iterator[Scene]:
    with Worker.from_env(environment(relay, tmp_path), handles_signals=False) as worker:
        yield Scene(relay, worker)


def test_an_input_is_acknowledged_when_its_answer_has_come(scene: Scene) -> None:
    scene.subscribe_again()
    scene.put()
    scene.ack("robot1", scene.own, 1)
    until(lambda: scene.processed == 1, "it is done")
    scene.put()
    until(lambda: len(scene.heard) == 3, "the answer is sent again: time has passed")
    assert [number for _, number in scene.heard] == [0, 1, 1]
    assert scene.processed == 1
    scene.ack("robot1", scene.own, 2)
    until(lambda: scene.processed == 2, "it is done, too")


def test_a_robot_that_gets_no_answers_does_not_wait_for_any(scene: Scene) -> None:
    """Its inputs lead to answers for others, of whom none keeps up with our numbers: plain subscribers."""
    scene.put()
    began = monotonic_s()
    until(lambda: scene.processed == 1, "it is done")
    scene.put()
    until(lambda: scene.processed == 2, "the next one, too")
    within(monotonic_s() - began, 1.5)


def test_an_input_without_an_answer_is_acknowledged_at_once_and_one_that_another_thread_answers_too(
    scene: Scene,
) -> None:
    scene.subscribe_again()
    scene.answer = lambda _: None
    scene.relay.put(b"x")
    until(lambda: scene.processed == 1, "it is done")

    def answer_beside(received: Received) -> None:
        thread = threading.Thread(target=lambda: scene.out.put(received.payload))
        thread.start()
        thread.join()

    scene.answer = answer_beside
    scene.put()
    until(lambda: scene.processed == 2, "it is done, too")


def test_a_frozen_robot_does_not_stall_the_inputs_of_another(scene: Scene) -> None:
    scene.subscribe_again()
    scene.put()
    scene.ack("robot2", "bb2", 1)
    scene.ack("robot1", scene.own, 1)
    until(lambda: scene.processed == 1, "both have the first answer")
    took: list[float] = []  # from here on the other one says nothing more
    for number in range(2, 22):
        began = monotonic_s()
        scene.put()
        scene.ack("robot1", scene.own, number)
        until(lambda number=number: scene.processed == number, f"input {number}")  # type: ignore[misc]
        took.append(monotonic_s() - began)
    assert took[0] > 0.8 * STALLED_S
    within(took[0], STALLED_S + 1.0)
    within(sorted(took)[-2], 0.5 * STALLED_S, "for one that comes later")


def test_an_input_whose_answer_was_withheld_is_not_done_before_it_is_answered(relay: Relay, tmp_path: Path) -> None:
    """A worker may take it before it hears that it is the owner; should it die, nobody would answer it."""
    with Worker.from_env(environment(relay, tmp_path), handles_signals=False) as worker:
        out = worker.publisher("{prefix}/{epoch}/robot1/out", reliable=True)

        def echo(received: Received) -> None:
            out.put(received.payload)

        worker.subscribe("{prefix}/*/in", echo)
        worker.subscribe("{prefix}/*/beside", lambda _: None, keep_last=None)
        worker.ready()
        until(lambda: KEYS.worker("edge1", "t", 3) in relay.tokens, "the ready token")
        relay.greet(is_whole=True)
        relay.put(b"x")
        until(lambda: out.withheld == 1, "it is withheld")
        beside = relay.session.declare_publisher("edge1/t/robot1/beside")
        beside.put(b"x", source_info=zenoh.SourceInfo(beside.id, 0))
        until(lambda: any(ack.eid == beside.id.eid and ack.processed for ack in relay.acks), "one that came later")
        assert [ack.processed for ack in relay.acks if ack.eid == relay.publisher.id.eid][-1] == 0
        relay.tell(WorkerRole.ACTIVE, 1)
        until(lambda: relay.outputs == [("edge1/t/1/robot1/out", b"x")], "the answer")
        until(lambda: relay.acks[-1].processed == 1 and relay.acks[-1].eid == relay.publisher.id.eid, "it is done")
