"""When a reliable outlet may send: whom it greets, what it makes of an answer, and of none."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import zenoh

from support.sessions import hub_and_neighbour
from support.waiting import until
from zsched.core.hop.books import unaccounted
from zsched.core.values import codec as wire
from zsched.core.values.plan import Direction, OnCrash, Route, StreamClass, StreamSettings
from zsched.core.values.relay_protocol import EndMarker, StreamAck, StreamAcks
from zsched.link.keyspace import END_CHUNK, Keyspace
from zsched.link.pipe.frames import decode_end
from zsched.relay.streams import greetings
from zsched.relay.streams import outlet as outlets
from zsched.relay.streams.acks import Acks
from zsched.relay.streams.inputs import InputStream
from zsched.relay.streams.lanes import Lane
from zsched.relay.streams.outlet import Outlet
from zsched.relay.streams.proofs import LeftOpen

KEYS = Keyspace("t")
RELIABLE = StreamSettings(stream_class=StreamClass.RELIABLE, depth=100)
LATEST = StreamSettings(stream_class=StreamClass.LATEST)
BEST_EFFORT = StreamSettings(stream_class=StreamClass.BEST_EFFORT)
REPLAYED = StreamSettings(stream_class=StreamClass.RELIABLE, depth=100, on_crash=OnCrash.REPLAY)


class Receiver:
    """Stands where a worker is; answers what the test wants."""

    def __init__(self, session: zenoh.Session, relay: zenoh.Session, key: str) -> None:
        self.session, self.key, self._relay = session, key, str(relay.zid())
        self.got: list[int] = []
        self.starts: list[EndMarker] = []
        self.eid = 0
        self._ends = session.declare_subscriber(f"{key}/{END_CHUNK}", self._start)
        self._data = session.declare_subscriber(key, lambda sample: self.got.append(_number(sample)))

    def _start(self, sample: zenoh.Sample) -> None:
        marker, info = decode_end(sample.payload.to_bytes()), sample.source_info
        assert marker is not None
        assert info is not None
        self.starts.append(marker)
        self.eid = info.source_id.eid

    def greeted(self, count: int = 1) -> EndMarker:
        until(lambda: len(self.starts) >= count, "a start marker")
        return self.starts[-1]

    def ack(
        self, arrived: int, *, first: int = 0, lost: int = 0, incarnation: str = "1", task: str = "t", **more: Any
    ) -> None:
        ack = StreamAck(eid=self.eid, first=first, arrived=arrived, processed=arrived, lost=lost, **more)
        self.session.put(KEYS.ack("edge1", task, incarnation, self._relay), wire.encode(StreamAcks(acks=(ack,))))

    def leave(self) -> None:
        self._data.undeclare()

    def come_back(self) -> None:
        self._data = self.session.declare_subscriber(self.key, lambda sample: self.got.append(_number(sample)))


def _number(sample: zenoh.Sample) -> int:
    info: Any = sample.source_info
    number: int = info.source_sn
    return number


class Bench:
    """An outlet, and samples for it."""

    def __init__(self, relay: zenoh.Session, other: zenoh.Session) -> None:
        self.relay, self.other = relay, other
        self.tokens: set[str] | None = None
        """Incarnations that are there; ``None``: all."""
        acks = Acks(relay, KEYS, "robot1", lambda _node, _task, life: self.tokens is None or life in self.tokens)
        self.acks = acks.of("edge1", "t")
        self.samples: list[zenoh.Sample] = []
        self._subscriber = relay.declare_subscriber("robot1/**", self.samples.append)

    def outlet(self, from_expr: str, to_expr: str, settings: StreamSettings = RELIABLE, epoch: int = 0) -> Outlet:
        return Outlet(self.relay, from_expr, to_expr, settings, self.acks, epoch=epoch)

    def sample(self, key: str = "robot1/in") -> zenoh.Sample:
        before = len(self.samples)
        self.relay.put(key, b"x")
        until(lambda: len(self.samples) > before, "a sample")
        return self.samples[-1]


@pytest.fixture
def bench() -> Iterator[Bench]:
    with hub_and_neighbour() as (relay, other):
        made = Bench(relay, other)
        yield made


def cared(outlet: Outlet | InputStream) -> bool:
    outlet.look_after()
    return True


def settled(outlet: Outlet, **fields: int) -> None:
    def holds() -> bool:
        outlet.look_after()
        said = outlet.counted()
        return all(getattr(said, name) == value for name, value in fields.items())

    until(holds, f"{fields}")


def test_nothing_goes_out_before_the_answer_and_everything_behind_it(bench: Bench) -> None:
    receiver = Receiver(bench.other, bench.relay, "edge1/in")
    outlet = bench.outlet("robot1/in", "edge1/in")
    sample = bench.sample()
    for _ in range(5):
        outlet.send(sample)
    assert receiver.greeted(2).count == 0  # it is repeated
    assert receiver.got == []
    settled(outlet, waiting=5, in_flight=0)
    receiver.ack(0)
    until(lambda: receiver.got == [0, 1, 2, 3, 4], "all of them")
    receiver.ack(5)
    settled(outlet, waiting=0, in_flight=0, acknowledged=5)
    outlet.undeclare()


def test_who_lost_its_link_is_greeted_again_and_gets_what_it_lacks(bench: Bench) -> None:
    receiver = Receiver(bench.other, bench.relay, "edge1/in")
    outlet = bench.outlet("robot1/in", "edge1/in")
    sample = bench.sample()
    outlet.send(sample)
    receiver.greeted()
    receiver.ack(0)
    until(lambda: receiver.got == [0], "the first")
    receiver.leave()  # what it got has not been acknowledged
    until(lambda: not outlet.is_matching, "nobody there")
    outlet.look_after()
    outlet.send(sample)
    before = len(receiver.starts)
    receiver.come_back()
    assert receiver.greeted(before + 1).count == 0
    receiver.ack(0)
    until(lambda: receiver.got == [0, 0, 1], "the first once more, and the second")
    outlet.undeclare()


def test_another_life_begins_behind_what_the_former_one_may_have_done(bench: Bench) -> None:
    receiver = Receiver(bench.other, bench.relay, "edge1/in")
    outlet = bench.outlet("robot1/in", "edge1/in")
    sample = bench.sample()
    for _ in range(3):
        outlet.send(sample)
    receiver.greeted()
    receiver.ack(0)
    until(lambda: receiver.got == [0, 1, 2], "three")
    before = len(receiver.starts)
    receiver.ack(0, incarnation="2")
    settled(outlet, at_most_lost=3, in_flight=0)
    outlet.send(sample)
    assert receiver.greeted(before + 1).count == 3
    receiver.ack(3, first=3, incarnation="2")
    until(lambda: receiver.got == [0, 1, 2, 3], "the fourth")
    receiver.ack(4, first=3, incarnation="2")
    settled(outlet, acknowledged=1, at_most_lost=3, lost=0, in_flight=0)
    outlet.undeclare()


def test_a_key_whose_samples_are_done_gives_way_and_its_worker_is_told(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A worker waits for the end of all that it has heard; what it has done stays counted."""
    monkeypatch.setattr(outlets, "MAX_LANES", 2)
    monkeypatch.setattr(outlets, "REST_S", 0.0)
    monkeypatch.setattr(outlets, "ROOM_EVERY_S", 0.0)
    receivers = {key: Receiver(bench.other, bench.relay, f"edge1/{key}") for key in "abc"}
    outlet = bench.outlet("robot1/*", "edge1/*", epoch=7)

    def sent(key: str) -> None:
        receiver, begun = receivers[key], len(receivers[key].starts)
        sample = bench.sample(f"robot1/{key}")
        until(lambda: outlet.send(sample) == ("", 0), "room")
        receiver.greeted(begun + 1)
        receiver.ack(0)
        until(lambda: receiver.got and receiver.got[-1] == 0, "the sample")

    sent("a")
    sent("b")
    assert outlet.send(bench.sample("robot1/c")) == ("too_many_keys", 1), "nothing of them is done"
    receivers["a"].ack(1)
    settled(outlet, acknowledged=1, in_flight=1)
    sent("c")
    until(lambda: receivers["a"].starts[-1].is_given_up, "the word that nothing comes of it")
    assert (receivers["a"].starts[-1].slot, receivers["a"].starts[-1].count) == (7, 1)
    for key in "bc":
        receivers[key].ack(1)
    settled(outlet, acknowledged=3, in_flight=0, lost=0, at_most_lost=0)
    sent("a")
    receivers["a"].ack(1)
    settled(outlet, acknowledged=4, in_flight=0, lost=0, at_most_lost=0)
    assert receivers["a"].got == [0, 0], "another publisher, which begins anew"
    outlet.undeclare()


def test_only_a_life_with_a_token_is_another_life(bench: Bench) -> None:
    """One forged acknowledgement while the worker stood still: what it had not got was not sent again."""
    receiver = Receiver(bench.other, bench.relay, "edge1/in")
    outlet = bench.outlet("robot1/in", "edge1/in")
    for _ in range(3):
        outlet.send(bench.sample())
    bench.tokens = {"1"}
    receiver.greeted()
    receiver.ack(0, incarnation="2")
    receiver.ack(0, incarnation="1")
    until(lambda: receiver.got[:3] == [0, 1, 2], "the first life is met by its own word")
    receiver.ack(0, first=0, incarnation="zz")
    receiver.ack(3, incarnation="1", task="other")
    receiver.ack(1)
    settled(outlet, acknowledged=1, in_flight=2)
    until(lambda: cared(outlet) and receiver.got.count(2) > 1, "what has not come is sent again")
    bench.tokens = {"2"}
    receiver.ack(2)  # the last word of one whose token has gone already
    receiver.ack(0, incarnation="2")
    settled(outlet, at_most_lost=1, in_flight=0)


def test_what_is_sent_again_has_all_that_it_had_the_first_time(bench: Bench) -> None:
    receiver = Receiver(bench.other, bench.relay, "edge1/in")
    got: list[zenoh.Sample] = []
    kept = bench.other.declare_subscriber("edge1/in", got.append)
    outlet = bench.outlet("robot1/*", "edge1/*")  # no way of the usual priority
    before, high = len(bench.samples), zenoh.Priority.DATA_HIGH
    stamp = bench.relay.new_timestamp()
    bench.relay.put(
        "robot1/in", b"1", encoding="image/png;7", attachment=b"2", timestamp=stamp, priority=high, express=True
    )
    bench.relay.delete("robot1/in", attachment=b"3", priority=high, express=True)
    until(lambda: len(bench.samples) == before + 2, "two samples")
    for sample in bench.samples[before:]:
        outlet.send(sample)
    receiver.greeted()
    receiver.ack(0)
    until(lambda: cared(outlet) and receiver.got == [0, 1], "both")
    receiver.ack(0, has_gap=True, until=2)
    until(lambda: cared(outlet) and receiver.got == [0, 1, 0, 1], "both once more")
    until(lambda: len(got) == 4, "for the other subscriber, too")
    said = [
        (one.kind, one.payload.to_bytes(), str(one.encoding), bytes(one.attachment or b""), str(one.timestamp))
        for one in got
    ]
    assert said[2:] == said[:2]
    assert [(one.priority, one.express) for one in got] == [(high, True)] * 4
    kept.undeclare()
    outlet.undeclare()


def test_what_a_stranger_acknowledges_in_the_worker_s_name_is_sent_again(bench: Bench) -> None:
    receiver = Receiver(bench.other, bench.relay, "edge1/in")
    outlet = bench.outlet("robot1/in", "edge1/in")
    for _ in range(4):
        outlet.send(bench.sample())
    receiver.greeted()
    receiver.ack(0)
    until(lambda: receiver.got == [0, 1, 2, 3], "four, of which two are lost on the way")
    receiver.ack(2)
    settled(outlet, acknowledged=2, in_flight=2)
    receiver.ack(4)  # a stranger's: nothing tells it from the worker's
    settled(outlet, acknowledged=4, in_flight=0)
    receiver.leave()
    until(lambda: not outlet.is_matching, "nobody there")
    outlet.look_after()
    receiver.got.clear()
    before = len(receiver.starts)
    receiver.come_back()
    until(lambda: cared(outlet) and len(receiver.starts) > before, "a greeting")
    assert receiver.starts[-1].count == 2, "it must not skip what it has not got"
    receiver.ack(2)
    until(lambda: receiver.got == [2, 3], "both once more")
    receiver.ack(4)
    settled(outlet, acknowledged=4, in_flight=0, lost=0, at_most_lost=0)
    outlet.undeclare()


@pytest.mark.parametrize("is_whole", [False, True])
def test_a_worker_that_was_told_a_wrong_class_or_replays_is_told_the_right_ones(bench: Bench, is_whole: bool) -> None:
    receiver = Receiver(bench.other, bench.relay, "edge1/in")
    stream_class = StreamClass.RELIABLE if is_whole else StreamClass.LATEST
    settings = StreamSettings(stream_class=stream_class, depth=10, keep_last=0 if is_whole else 1)
    outlet = bench.outlet("robot1/in", "edge1/in", settings)
    main = outlet._main
    assert main is not None
    receiver.eid = main.eid
    until(lambda: outlet.is_matching, "the subscriber to be seen")  # `latest` goes to nobody before
    outlet.send(bench.sample())
    if is_whole:
        receiver.greeted()
        receiver.ack(0)
    until(lambda: receiver.got == [0], "the sample")
    receiver.ack(1, is_whole=is_whole)
    settled(outlet, acknowledged=1)
    before = len(receiver.starts)
    receiver.ack(1, is_whole=not is_whole)
    until(lambda: len(receiver.starts) > before, "it is told")
    assert (receiver.starts[-1].is_whole, receiver.starts[-1].count) == (is_whole, 0), "from what may be taken back on"
    before = len(receiver.starts)
    receiver.ack(1, is_whole=is_whole, replays=7)
    until(lambda: len(receiver.starts) > before, "it is told")
    assert receiver.starts[-1].replayed == 0


def test_nothing_goes_to_a_recorder_while_the_worker_is_gone(bench: Bench) -> None:
    """Somebody matches; the worker's token is gone, and comes again."""
    receiver = Receiver(bench.other, bench.relay, "edge1/in")
    outlet = bench.outlet("robot1/in", "edge1/in")
    until(lambda: cared(outlet) and receiver.starts, "a greeting before there is anything to send")
    receiver.ack(0)
    outlet.part(is_parted=True)
    outlet.send(bench.sample())
    settled(outlet, waiting=1)
    before = len(receiver.starts)
    outlet.look_after()
    assert (receiver.got, len(receiver.starts)) == ([], before)
    outlet.part(is_parted=False)
    receiver.greeted(before + 1)
    receiver.ack(0)
    until(lambda: receiver.got == [0], "what waited")
    outlet.undeclare()


def test_a_subscriber_that_never_answers_gets_its_samples_and_they_are_counted(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(greetings, "FOREIGN_S", 0.3)
    receiver = Receiver(bench.other, bench.relay, "edge1/in")
    outlet = bench.outlet("robot1/in", "edge1/in")
    sample = bench.sample()
    outlet.send(sample)
    outlet.send(sample)
    until(lambda: receiver.got == [0, 1], "both")
    settled(outlet, uncounted=2, in_flight=0, waiting=0)
    before = len(receiver.starts)
    receiver.ack(0)  # a worker after all: it has not known where to begin
    until(lambda: cared(outlet) and len(receiver.starts) > before, "another greeting")
    assert receiver.starts[-1].count == 2
    outlet.send(sample)
    receiver.ack(2, first=2)
    until(lambda: receiver.got == [0, 1, 2], "the third")
    outlet.undeclare()


def test_a_key_that_the_worker_does_not_take_holds_up_no_other(bench: Bench) -> None:
    receiver = Receiver(bench.other, bench.relay, "edge1/a")
    outlet = bench.outlet("robot1/*", "edge1/*")
    outlet.send(bench.sample("robot1/a"))
    receiver.greeted()
    receiver.ack(0)
    until(lambda: receiver.got == [0], "the key that it takes")
    receiver.ack(1)
    outlet.send(bench.sample("robot1/b"))
    outlet.send(bench.sample("robot1/a"))
    until(lambda: receiver.got == [0, 1], "the next of that key")
    settled(outlet, uncounted=1, waiting=0)
    outlet.undeclare()


def test_a_worker_that_stands_still_between_two_keys_is_no_stranger(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It held the interpreter's lock for a second: samples that it has done went out as if to a recorder."""
    monkeypatch.setattr(greetings, "STRANGE_S", 0.2)
    monkeypatch.setattr(greetings, "FOREIGN_S", 60.0)
    known, other, recorder = (Receiver(bench.other, bench.relay, f"edge1/{key}") for key in "abc")
    outlet = bench.outlet("robot1/*", "edge1/*")
    outlet.send(bench.sample("robot1/a"))
    known.greeted()
    known.ack(0)
    until(lambda: known.got == [0], "the key that it has answered for")
    known.ack(1)
    settled(outlet, acknowledged=1)
    before = len(known.starts)
    outlet.send(bench.sample("robot1/b"))
    known.greeted(before + 2)  # it is asked again and again, and says nothing
    time.sleep(0.3)
    assert other.got == []
    other.ack(0)
    until(lambda: other.got == [0], "the other key")
    other.ack(1)
    settled(outlet, acknowledged=2, uncounted=0)
    before = len(other.starts)
    outlet.send(bench.sample("robot1/c"))
    other.greeted(before + 1)
    other.ack(1)  # it says something, and not for this key
    until(lambda: recorder.got == [0], "what nobody acknowledges")
    settled(outlet, acknowledged=2, uncounted=1)
    outlet.undeclare()


def test_a_worker_that_answers_late_is_not_forgiven_what_it_loses_afterwards(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It had some, was silent for so long that it passed for a stranger, and answers again."""
    monkeypatch.setattr(greetings, "FOREIGN_S", 0.3)
    receiver = Receiver(bench.other, bench.relay, "edge1/in")
    outlet = bench.outlet("robot1/in", "edge1/in")
    sample = bench.sample()
    until(lambda: cared(outlet) and receiver.starts, "a greeting")
    receiver.ack(0)
    for _ in range(4):
        outlet.send(sample)
    until(lambda: len(receiver.got) == 4, "four")
    receiver.ack(3)
    settled(outlet, acknowledged=3, in_flight=1)
    outlet.part(is_parted=False)
    outlet.send(sample)
    until(lambda: len(receiver.got) == 5, "the fifth, to a stranger")
    settled(outlet, acknowledged=3, at_most_lost=1, uncounted=1, in_flight=0, waiting=0)
    before = len(receiver.starts)
    receiver.ack(3)
    until(lambda: cared(outlet) and len(receiver.starts) > before, "another greeting")
    receiver.ack(5, lost=2)
    for _ in range(3):
        outlet.send(sample)
    until(lambda: len(receiver.got) == 8, "three more")
    receiver.ack(8, lost=3)
    settled(outlet, acknowledged=5, lost=1, at_most_lost=1, uncounted=1, in_flight=0)
    outlet.undeclare()


def test_a_replay_behind_newer_samples_skips_none_of_them(bench: Bench) -> None:
    """An owner that hangs is left: its successor has newer samples before it gets the old ones.

    The marker that announces those comes by another subscription, so it may be seen before the newer samples.
    """
    receiver = Receiver(bench.other, bench.relay, "edge1/in")
    outlet = bench.outlet("robot1/in", "edge1/in", REPLAYED)
    sample = bench.sample()
    for _ in range(3):
        outlet.send(sample)
    receiver.greeted()
    receiver.ack(0)
    until(lambda: receiver.got == [0, 1, 2], "newer samples")
    receiver.ack(1)
    settled(outlet, acknowledged=1, in_flight=2)
    assert outlet.replay([LeftOpen(sample, None)] * 2) == 0
    until(lambda: receiver.starts[-1].replayed, "the announcement")
    marker = receiver.starts[-1]
    assert marker.count == 0  # it has not said that it has number 1, and that it has number 0 may be taken back
    assert marker.count + marker.replayed == 5
    until(lambda: set(receiver.got) == {0, 1, 2, 3, 4}, "the old ones")
    receiver.ack(5)
    settled(outlet, acknowledged=5, lost=0, in_flight=0, waiting=0)
    outlet.undeclare()


def test_the_sample_that_the_thread_has_just_taken_goes_to_the_next_owner(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It waits no more, and its put has not begun."""
    receiver = Receiver(bench.other, bench.relay, "edge1/in")
    outlet = bench.outlet("robot1/in", "edge1/in", REPLAYED)
    until(lambda: cared(outlet) and receiver.starts, "a greeting before there is anything to send")
    receiver.ack(0)
    taken, gate, put = threading.Event(), threading.Event(), outlet._put

    def held(*given: Any) -> None:
        taken.set()
        gate.wait(60)
        put(*given)

    monkeypatch.setattr(outlet, "_put", held)
    first, second = bench.sample(), bench.sample()
    outlet.send(first)
    assert taken.wait(60)
    outlet.send(second)
    said, owed = outlet.abandon()
    gate.set()
    assert [one.sample for one in owed] == [first, second]
    assert (said.waiting, said.in_flight) == (0, 0)


@pytest.mark.parametrize(("done", "has_ended"), [(1, False), (1, True), (2, False), (2, True)])
def test_a_worker_is_told_its_epoch_and_when_it_is_left_with_work_that_this_is_given_up(
    bench: Bench, done: int, *, has_ended: bool
) -> None:
    """It waits for the end of all that it has heard, so what is left without one is given up, also with all done."""
    receiver = Receiver(bench.other, bench.relay, "edge1/in")
    outlet = bench.outlet("robot1/in", "edge1/in", epoch=7)
    outlet.send(sample := bench.sample())
    outlet.send(sample)
    assert receiver.greeted() == EndMarker(epoch=0, count=0, is_whole=True, slot=7)
    receiver.ack(0)
    until(lambda: receiver.got == [0, 1], "both")
    receiver.ack(done)
    settled(outlet, in_flight=2 - done, acknowledged=done)
    if has_ended:
        outlet.send_end(7)
        until(lambda: outlet._queue is not None and outlet._queue.is_empty, "the end marker is put")
    outlet.undeclare()
    last = bench.outlet("robot1/in", "edge1/in", epoch=8)
    until(lambda: cared(last) and receiver.starts[-1].slot == 8, "the next one's start marker")
    given_up = [start for start in receiver.starts if start.is_given_up]
    is_told = done < 2 or not has_ended
    assert given_up == [EndMarker(epoch=0, count=2, slot=7, is_given_up=True)] * is_told
    last.undeclare()


@pytest.mark.parametrize("settings", [BEST_EFFORT, LATEST], ids=["best effort", "latest"])
def test_a_stream_of_any_class_that_closes_without_its_end_is_given_up(bench: Bench, settings: StreamSettings) -> None:
    """Its worker waited for the end of it, and with it the next move's answers for the whole drain time."""
    receiver = Receiver(bench.other, bench.relay, "edge1/in")
    outlet = bench.outlet("robot1/in", "edge1/in", settings, epoch=7)
    until(lambda: outlet.is_matching, "the receiver is there")
    outlet.send(bench.sample())
    until(lambda: bool(receiver.got), "the value")
    outlet.undeclare()
    until(lambda: any(start.is_given_up for start in receiver.starts), "that it is given up", 10.0)
    assert [start.count for start in receiver.starts if start.is_given_up] == [1]


def test_a_worker_of_class_latest_is_told_its_epoch_before_any_value(bench: Bench) -> None:
    """When it has become ready, and of a key that comes later."""
    receiver = Receiver(bench.other, bench.relay, "edge1/in")
    outlet = bench.outlet("robot1/in", "edge1/in", LATEST, epoch=7)
    until(lambda: outlet.is_matching, "the receiver is there")
    outlet.name_slot()
    assert receiver.greeted() == EndMarker(epoch=0, count=0, slot=7)
    outlet.undeclare()
    late = Receiver(bench.other, bench.relay, "edge2/b")
    wild = bench.outlet("robot1/*", "edge2/*", LATEST, epoch=8)
    until(lambda: wild.is_matching, "the receiver is there")
    sample = bench.sample("robot1/b")
    wild.send(sample)
    wild.send(sample)
    until(lambda: late.got and late.starts, "a value and its marker")  # each subscriber has a thread of its own
    assert late.starts == [EndMarker(epoch=0, count=0, slot=8)]
    wild.undeclare()


@pytest.mark.parametrize("on_crash", list(OnCrash))
def test_what_ends_between_two_data_sessions_is_counted_once(bench: Bench, on_crash: OnCrash) -> None:
    """Its slot has been settled when the session before ended."""
    settings = StreamSettings(stream_class=StreamClass.RELIABLE, depth=100, on_crash=on_crash)
    route = Route(
        stream="t/in/0", direction=Direction.INPUT, from_expr="robot1/in", to_expr="edge1/in", settings=settings
    )
    receiver = Receiver(bench.other, bench.relay, "edge1/in")
    sample = bench.sample()
    stream = InputStream(bench.relay, route, frozenset())
    stream.open(1, route, bench.acks)
    stream.flip(1)
    for _ in range(5):
        stream._carry(sample)
    receiver.greeted()
    receiver.ack(0)
    until(lambda: cared(stream) and receiver.got == [0, 1, 2, 3, 4], "all of them")
    stream.hold()
    stream.leave()
    stream.close()
    count = stream.count()
    assert unaccounted(count) == 0
    assert (count.in_flight or 0) + count.at_most_lost == 5


def test_a_full_key_holds_up_the_rest_until_its_receiver_comes_further(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(outlets, "KEPT_SAMPLES", 2)
    full, other = (Receiver(bench.other, bench.relay, f"edge1/{key}") for key in "ab")
    outlet = bench.outlet("robot1/*", "edge1/*")
    first, second = bench.sample("robot1/a"), bench.sample("robot1/b")
    for sample in (first, second, first):
        outlet.send(sample)
    for receiver in (full, other):
        receiver.greeted()
        receiver.ack(0)
    until(lambda: (full.got, other.got) == ([0, 1], [0]), "what may be on its way")
    for sample in (first, second):
        outlet.send(sample)
    settled(outlet, waiting=2, in_flight=3)
    other.ack(1)
    settled(outlet, waiting=2, in_flight=2)  # the key that is full has not come further
    full.ack(2)
    until(lambda: (full.got, other.got) == ([0, 1, 2], [0, 1]), "the rest, in order")
    outlet.undeclare()


def test_what_one_key_is_told_costs_no_look_at_the_others(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """A hundred keys that acknowledge twenty times a second were two hundred thousand looks a second."""
    receivers = [Receiver(bench.other, bench.relay, f"edge1/{key}") for key in range(20)]
    outlet = bench.outlet("robot1/*", "edge1/*")
    samples = [bench.sample(f"robot1/{key}") for key in range(20)]
    for sample in samples:
        outlet.send(sample)
    for receiver in receivers:
        receiver.greeted()
        receiver.ack(0)
    until(lambda: all(receiver.got == [0] for receiver in receivers), "all of them")
    for receiver in receivers:
        receiver.ack(1)
    settled(outlet, acknowledged=20, in_flight=0)
    looks: list[Lane] = []
    for name in ("take_owed", "is_full"):
        monkeypatch.setattr(Lane, name, _noted(looks, getattr(Lane, name)))
    for number in range(1, 11):
        outlet.send(samples[0])
        until(lambda: receivers[0].got == list(range(number + 1)), "one more of the first key")  # noqa: B023
        receivers[0].ack(number + 1)
        until(lambda: outlet.counted().acknowledged == 20 + number, "its acknowledgement")  # noqa: B023
    assert {lane.key for lane in looks} == {"edge1/0"}
    outlet.undeclare()


def _noted(looks: list[Lane], method: Callable[[Lane], Any]) -> Callable[[Lane], Any]:
    def noting(lane: Lane) -> Any:
        looks.append(lane)
        return method(lane)

    return noting
