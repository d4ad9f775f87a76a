"""The answers of one slot in order, over real sessions: what waits, what is asked for, what is skipped."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest
import zenoh

from support.sessions import hub_and_neighbour, matches
from support.waiting import until
from zsched.core.values import codec as wire
from zsched.core.values.plan import Direction, HandoverRule, Route, StreamClass, StreamSettings
from zsched.core.values.relay_protocol import SKIP_ENCODING, EndMarker, StreamAck, StreamAcks
from zsched.link.keyspace import AGAIN_CHUNK, END_CHUNK, Keyspace
from zsched.link.pipe.frames import encode_end
from zsched.relay.streams import answers, slots
from zsched.relay.streams.acks import Acks
from zsched.relay.streams.outputs import OutputStream

KEY = "edge1/t/1/out"


class Bench:
    """A relay's output stream, and a worker whose numbers the test chooses."""

    def __init__(self, relay: zenoh.Session, worker: zenoh.Session) -> None:
        self.relay, self.worker = relay, worker
        self.said: list[StreamAck] = []
        self.passed: list[str] = []
        received = Keyspace("t").received("robot1", str(relay.zid()), str(worker.zid()))
        self._heard = worker.declare_subscriber(received, self._hear)
        self._app = worker.declare_subscriber("robot1/out", lambda s: self.passed.append(s.payload.to_string()))
        self.acks = Acks(relay, Keyspace("t"), "robot1", lambda *_: True).of("edge1", "t")

    def open(self, stream_class: StreamClass = StreamClass.RELIABLE, *, is_from_start: bool = True) -> OutputStream:
        settings = StreamSettings(stream_class=stream_class, depth=500, handover=HandoverRule.ALL)
        route = Route(
            stream="t/out/0", direction=Direction.OUTPUT, from_expr=KEY, to_expr="robot1/out", settings=settings
        )
        self.stream = OutputStream(self.relay, route, frozenset(), lambda: None)
        self.stream.open(1, route, self.acks, is_from_start=is_from_start)
        self.stream.flip(1, drops_held=False)
        self.publisher = self.worker.declare_publisher(KEY, congestion_control=zenoh.CongestionControl.BLOCK)
        self.again = self.worker.declare_publisher(
            f"{KEY}/{AGAIN_CHUNK}/{self.relay.zid()}", congestion_control=zenoh.CongestionControl.BLOCK
        )
        until(lambda: matches(self.publisher) and matches(self.again), "the relay subscribes to both")
        return self.stream

    def put(self, *numbers: int) -> None:
        for number in numbers:
            self.publisher.put(str(number), source_info=zenoh.SourceInfo(self.publisher.id, number))

    def put_again(self, *numbers: int) -> None:
        for number in numbers:
            self.again.put(str(number), source_info=zenoh.SourceInfo(self.publisher.id, number))

    def wait_all_put(self) -> None:
        """What `put` has put has come: one without a number goes on at once, and zenoh orders a publisher's samples."""
        self.publisher.put("behind")
        until(lambda: "behind" in self.passed, f"what came behind all others: {self.passed}")
        self.passed.remove("behind")

    def _hear(self, sample: zenoh.Sample) -> None:
        self.said += wire.decode(sample.payload.to_bytes(), StreamAcks).acks

    def wait_ack(self, **fields: Any) -> None:
        until(lambda: any(all(getattr(a, k) == v for k, v in fields.items()) for a in self.said), f"{fields}")

    def is_through(self, *numbers: int) -> bool:
        until(lambda: len(self.passed) >= len(numbers), f"{numbers}: {self.passed}")
        return self.passed == [str(number) for number in numbers]


@pytest.fixture
def bench() -> Iterator[Bench]:
    with hub_and_neighbour() as (relay, worker):
        made = Bench(relay, worker)
        yield made
        made.stream.close()


def test_answers_are_acknowledged_to_the_worker_that_gave_them(bench: Bench) -> None:
    bench.open()
    bench.put(0, 1, 2)
    assert bench.is_through(0, 1, 2)
    bench.wait_ack(eid=bench.publisher.id.eid, arrived=3, processed=3, has_gap=False)


@pytest.mark.parametrize("stream_class", [StreamClass.RELIABLE, StreamClass.LATEST])
def test_two_outputs_of_one_key_get_every_answer_each(bench: Bench, stream_class: StreamClass) -> None:
    """They shared one count: what one had taken was a double for the other, and dropped."""
    first, heard = bench.open(stream_class), list[str]()
    app = bench.worker.declare_subscriber("robot1/also", lambda sample: heard.append(sample.payload.to_string()))
    route = replace(first.route, stream="t/out/1", to_expr="robot1/also")
    other = OutputStream(bench.relay, route, frozenset(), lambda: None)
    other.open(1, route, bench.acks, is_from_start=True)
    other.flip(1, drops_held=False)
    until(lambda: other._outlet.is_matching, "the application hears it")
    for number in range(20):
        bench.put(number)
        until(lambda number=number: heard[-1:] == bench.passed[-1:] == [str(number)], f"{number}")  # type: ignore[misc]
    assert heard == bench.passed == [str(number) for number in range(20)]
    for stream in (first, other):
        count = stream.count()
        assert (count.messages, count.lost, count.doubled) == (20, 0, 0)
    other.close()
    app.undeclare()


def test_what_is_missing_is_asked_for_and_what_came_early_waits(bench: Bench) -> None:
    stream = bench.open()
    bench.put(0, 3, 4)
    bench.wait_ack(arrived=1, has_gap=True, until=3)
    assert bench.is_through(0)
    bench.put_again(1, 2)
    assert bench.is_through(0, 1, 2, 3, 4)
    bench.wait_ack(arrived=5, has_gap=False)
    bench.put_again(2, 3)  # once more: nobody hears of it
    bench.put(5)
    assert bench.is_through(0, 1, 2, 3, 4, 5)
    count = stream.count()
    assert (count.lost, count.doubled, count.reordered) == (0, 0, 0)


def test_the_first_answers_are_wanted_where_the_slot_was_open_before_them(bench: Bench) -> None:
    bench.open()
    bench.put(2)
    bench.wait_ack(arrived=0, has_gap=True, until=2)
    bench.put_again(0, 1)
    assert bench.is_through(0, 1, 2)


def test_a_relay_that_came_later_begins_where_the_stream_is(bench: Bench) -> None:
    bench.open(is_from_start=False)
    bench.put(7, 8)
    assert bench.is_through(7, 8)


def test_what_the_worker_has_no_more_is_skipped_and_counted(bench: Bench) -> None:
    stream = bench.open()
    bench.put(0, 5)
    bench.wait_ack(arrived=1, has_gap=True)
    marker = encode_end(EndMarker(epoch=0, count=4))
    bench.again.put(marker, encoding=SKIP_ENCODING, source_info=zenoh.SourceInfo(bench.publisher.id, 4))
    bench.put_again(4)
    assert bench.is_through(0, 4, 5)
    assert stream.count().lost == 3


def test_first_answers_that_the_worker_has_no_more_are_counted_too(bench: Bench) -> None:
    """Nothing came before them, so that the gate cannot tell by its last number."""
    stream = bench.open()
    bench.put(5)
    bench.wait_ack(arrived=0, has_gap=True, until=5)
    marker = encode_end(EndMarker(epoch=0, count=3))
    bench.again.put(marker, encoding=SKIP_ENCODING, source_info=zenoh.SourceInfo(bench.publisher.id, 3))
    bench.put_again(3, 4)
    assert bench.is_through(3, 4, 5)
    assert stream.count().lost == 3


@pytest.mark.parametrize(
    ("had", "age_s", "lost"), [(60, 900.0, 0), (50, 900.0, 10), (70, 0.0, 0), (None, 900.0, 0), (None, 0.0, 60)]
)
def test_what_an_earlier_life_of_this_relay_has_had_or_was_before_it_is_not_lost(
    bench: Bench, had: int | None, age_s: float, lost: int
) -> None:
    stream = bench.open()
    bench.put(60)
    bench.wait_ack(arrived=0, has_gap=True, until=60)
    marker = encode_end(EndMarker(epoch=0, count=60, had=had, age_s=age_s))
    bench.again.put(marker, encoding=SKIP_ENCODING, source_info=zenoh.SourceInfo(bench.publisher.id, 60))
    assert bench.is_through(60)
    bench.put(61, 62)
    assert bench.is_through(60, 61, 62)
    assert stream.count().lost == lost


def test_a_relay_that_came_later_counts_nothing_of_what_was_before(bench: Bench) -> None:
    stream = bench.open(is_from_start=False)
    bench.put(7, 8)
    assert bench.is_through(7, 8)
    assert stream.count().lost == 0


@pytest.mark.parametrize(("had", "lost"), [((0,), 2), ((), 3)])
def test_a_tail_that_is_asked_for_in_vain_is_counted_when_the_slot_closes(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, had: tuple[int, ...], lost: int
) -> None:
    monkeypatch.setattr(answers, "GIVE_UP_S", 0.1)
    stream = bench.open()
    bench.put(*had)
    assert bench.is_through(*had)
    end = encode_end(EndMarker(epoch=1, count=3))
    bench.worker.put(f"{KEY}/{END_CHUNK}", end, source_info=zenoh.SourceInfo(bench.publisher.id, 3))
    until(lambda: stream.has_ended(1), "it is given up")
    stream.close_slot(1)
    assert stream.count().lost == lost


def test_what_waits_for_a_missing_one_is_counted_with_it_when_the_slot_closes(bench: Bench) -> None:
    """Its owner died before it could send that again, and left no end marker: five of six were in no counter."""
    stream = bench.open()
    bench.put(0, 2, 3, 4, 5)
    bench.wait_all_put()
    bench.wait_ack(arrived=1, has_gap=True, until=2)
    assert bench.is_through(0)
    stream.close_slot(1)
    assert stream.count().lost == 5


def test_what_never_comes_is_given_up_also_when_nothing_else_comes(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(answers, "GIVE_UP_S", 0.1)
    stream = bench.open()
    bench.put(0, 2)
    end = time.monotonic() + 60
    while len(bench.passed) < 2 and time.monotonic() < end:
        stream.look_after()
        time.sleep(0.01)
    assert bench.is_through(0, 2)
    assert stream.count().lost == 1


def test_what_waits_is_bounded_and_comes_again(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(answers, "MAX_WAITING", 2)
    bench.open()
    bench.put(1, 2, 3, 4)
    bench.wait_all_put()  # else 3 comes when 0 is there, and goes on
    bench.wait_ack(arrived=0, has_gap=True, until=1)
    bench.put_again(0)
    assert bench.is_through(0, 1, 2)
    bench.wait_ack(arrived=3, has_gap=False)
    bench.put_again(3, 4)
    assert bench.is_through(0, 1, 2, 3, 4)


def test_an_end_marker_asks_for_the_tail_that_was_lost(bench: Bench) -> None:
    stream = bench.open()
    bench.put(0)
    end = encode_end(EndMarker(epoch=1, count=3))
    bench.worker.put(f"{KEY}/{END_CHUNK}", end, source_info=zenoh.SourceInfo(bench.publisher.id, 3))
    until(lambda: stream.has_ended(1) or any(ack.until == 3 for ack in bench.said), "the tail is asked for")
    assert not stream.has_ended(1)
    bench.wait_ack(is_ended=True)
    bench.put_again(1, 2)
    assert bench.is_through(0, 1, 2)
    until(lambda: stream.has_ended(1), "the slot has ended")


def test_a_stream_of_newest_values_takes_what_is_newer_and_drops_what_is_older(bench: Bench) -> None:
    bench.open(StreamClass.LATEST)
    bench.put(3)
    assert bench.is_through(3)
    bench.put_again(1, 5)
    bench.put(4, 6)
    until(lambda: bench.passed[-1] == "6", "the newest")
    assert bench.passed in (["3", "5", "6"], ["3", "4", "5", "6"], ["3", "4", "6"])
    bench.wait_ack(arrived=7, has_gap=False)


def test_an_owner_that_is_left_and_comes_back_in_its_epoch_doubles_nothing(bench: Bench) -> None:
    """A robot that was cut off worked alone meanwhile; the owner sends what the cut kept us from acknowledging."""
    stream = bench.open()
    bench.put(0, 1, 2)
    assert bench.is_through(0, 1, 2)
    stream.close_slot(1)
    stream.open(1, stream.route, bench.acks, is_from_start=True)
    stream.flip(1, drops_held=False)
    until(lambda: matches(bench.again), "the relay subscribes again")
    bench.put_again(1, 2, 3)  # 3: made of what reached the owner before the cut
    bench.put(4)
    assert bench.is_through(0, 1, 2, 3, 4)
    assert stream.count().lost == 0


def test_a_slot_that_closes_says_that_nothing_more_is_wanted(bench: Bench) -> None:
    """What comes behind it is cut: no input may wait until it is here."""
    stream = bench.open()
    bench.put(0, 1)
    assert bench.is_through(0, 1)
    stream.close_slot(1)
    bench.wait_ack(eid=bench.publisher.id.eid, arrived=2, has_left=True)
    bench.said.clear()
    stream.open(1, stream.route, bench.acks, is_from_start=True)  # it comes back to the same owner in the same epoch
    bench.wait_ack(eid=bench.publisher.id.eid, arrived=2, has_left=False)


def test_an_answer_in_hand_while_its_slot_closes_starts_no_count_of_its_own(bench: Bench) -> None:
    """The receiver's thread waited for the lock; its sample was counted from 0 on, and all before it came again."""
    stream = bench.open()
    taken: list[zenoh.Sample] = []
    tap = bench.relay.declare_subscriber(KEY, taken.append)
    bench.put(0, 1, 2)
    assert bench.is_through(0, 1, 2)
    until(lambda: len(taken) == 3, "the samples themselves")
    feed = stream._slots[1].feed
    assert feed is not None
    stream.close_slot(1)
    stream._carry(feed, taken[2])
    stream.open(1, stream.route, bench.acks, is_from_start=True)
    stream.flip(1, drops_held=False)
    until(lambda: matches(bench.again), "the relay subscribes again")
    bench.put_again(0, 1, 2, 3)
    assert bench.is_through(0, 1, 2, 3)
    assert dict(stream.count().drops)["stale_epoch"] == 1
    tap.undeclare()


def test_an_end_marker_that_says_less_than_has_come_or_will_come_ends_nothing(bench: Bench) -> None:
    """One forged long before a move: at the move what the old owner still had in work was lost."""
    stream = bench.open()

    def end(count: int) -> None:
        source = zenoh.SourceInfo(bench.publisher.id, count)
        bench.worker.put(f"{KEY}/{END_CHUNK}", encode_end(EndMarker(epoch=1, count=count)), source_info=source)

    bench.put(0, 1, 2)
    until(lambda: len(bench.passed) == 3, "the answers")
    end(1)
    for count in (0, 1):
        marker = encode_end(EndMarker(epoch=1, count=count))
        bench.worker.put(f"{KEY}/{END_CHUNK}", marker)
        stranger = bench.worker.declare_publisher("somewhere/else")
        source = zenoh.SourceInfo(stranger.id, count)
        bench.worker.put(f"{KEY}/{END_CHUNK}", marker, source_info=source)
    end(4)
    bench.wait_ack(is_ended=True)
    assert not stream.has_ended(1)
    bench.put(3)
    until(lambda: stream.has_ended(1), "so far it could be true")
    bench.put(4)
    until(lambda: not stream.has_ended(1), "something came from behind it")
    bench.wait_ack(is_ended=False, arrived=5)
    end(5)
    until(lambda: stream.has_ended(1), "the real one")
    bench.wait_ack(is_ended=True)
    assert bench.passed == ["0", "1", "2", "3", "4"]


def cared(stream: OutputStream) -> bool:
    stream.look_after()
    return True


def test_keys_are_forgotten_and_nothing_of_them_is_lost(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """Over the weeks they may be any number, and what is known of each takes a kilobyte."""
    monkeypatch.setattr(slots, "MAX_KEYS", 2)
    settings = StreamSettings(stream_class=StreamClass.RELIABLE, depth=500, handover=HandoverRule.ALL)
    route = Route(
        stream="t/out/0", direction=Direction.OUTPUT, from_expr="edge1/t/1/*", to_expr="robot1/*", settings=settings
    )
    stream = bench.stream = OutputStream(bench.relay, route, frozenset(), lambda: None)
    stream.open(1, route, bench.acks, is_from_start=True)
    stream.flip(1, drops_held=False)
    publishers = {
        name: bench.worker.declare_publisher(f"edge1/t/1/{name}", congestion_control=zenoh.CongestionControl.BLOCK)
        for name in "abcde"
    }
    passed: list[str] = []
    app = bench.worker.declare_subscriber("robot1/*", lambda s: passed.append(f"{s.key_expr} {s.payload.to_string()}"))
    until(lambda: matches(publishers["a"]), "the relay subscribes")
    until(lambda: stream._outlet.is_matching, "the application hears it")

    def put(name: str, number: int) -> None:
        publisher = publishers[name]
        publisher.put(str(number), source_info=zenoh.SourceInfo(publisher.id, number))
        until(lambda: cared(stream) and f"robot1/{name} {number}" in passed, f"{name} {number}")

    for name in "abcde":
        put(name, 0)
        put(name, 1)
    slot = stream._slots[1]
    assert list(slot.keys) == ["edge1/t/1/d", "edge1/t/1/e"]
    put("a", 2)
    put("a", 3)
    assert (stream.count().lost, stream.count().doubled) == (0, 0)
    put("b", 3)
    assert stream.count().lost == 1, "what is missing since then is"
    for name, count in {"a": 4, "b": 4, "c": 2, "d": 2, "e": 2}.items():
        source = zenoh.SourceInfo(publishers[name].id, count)
        marker = encode_end(EndMarker(epoch=1, count=count))
        bench.worker.put(f"edge1/t/1/{name}/{END_CHUNK}", marker, source_info=source)
    until(lambda: len(slot.keys) == 5 and stream.has_ended(1), "the end of all")
    stream.close_slot(1)
    assert (stream.count().lost, stream.count().doubled, len(passed)) == (1, 0, 13)
    app.undeclare()
