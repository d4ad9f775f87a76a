"""One stream at a time, inputs and outputs, on real sessions: a relay's, and one for applications and workers."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from datetime import timedelta
from functools import partial
from typing import Any

import pytest
import zenoh
import zenoh.ext

from support.sessions import hub_and_neighbour, matches
from support.waiting import between, free_endpoint, until
from zsched.core.hop.books import unaccounted
from zsched.core.values.plan import Direction, HandoverRule, RosGraph, Route, StreamClass, StreamSettings
from zsched.core.values.relay_protocol import EndMarker
from zsched.link.keyspace import END_CHUNK, Keyspace
from zsched.link.pipe.frames import decode_end, encode_end
from zsched.link.sessions import send_queue
from zsched.link.sessions.config import worker_config
from zsched.relay.streams import fence as fences
from zsched.relay.streams import inputs, outlet, outputs, receive, slots
from zsched.relay.streams.acks import Acks
from zsched.relay.streams.fence import Fence
from zsched.relay.streams.inputs import InputStream
from zsched.relay.streams.lanes import Lane
from zsched.relay.streams.outputs import OutputStream


@dataclass
class Bench:
    relay: zenoh.Session
    outside: zenoh.Session
    own_ids: frozenset[str] = frozenset()
    streams: list[InputStream | OutputStream] = field(default_factory=list)
    endpoint: str = ""
    others: list[zenoh.Session] = field(default_factory=list)

    def another(self) -> zenoh.Session:
        self.others.append(zenoh.open(zenoh.Config.from_json5(worker_config(connect=(self.endpoint,)))))
        return self.others[-1]

    def input(self, route: Route) -> InputStream:
        stream = InputStream(self.relay, route, self.own_ids | {str(self.relay.zid())})
        self.streams.append(stream)
        return stream

    def flowing(self, route: Route) -> InputStream:
        """An input whose first slot has a target, and carries the stream."""
        stream = self.input(route)
        stream.open(1, route)
        until(lambda: stream.is_matching(1), "the target subscribes")
        stream.flip(1)
        return stream

    def output(self, route: Route, wake: Callable[[], None] = lambda: None) -> OutputStream:
        stream = OutputStream(self.relay, route, self.own_ids | {str(self.relay.zid())}, wake)
        self.streams.append(stream)
        return stream

    def publisher(self, key: str, **options: Any) -> zenoh.Publisher:
        publisher = self.outside.declare_publisher(key, **options)
        until(lambda: matches(publisher), f"the relay subscribes to {key}")
        return publisher


@pytest.fixture
def bench() -> Iterator[Bench]:
    endpoint = free_endpoint()
    with hub_and_neighbour(endpoint) as (relay, outside):
        made = Bench(relay=relay, outside=outside, endpoint=endpoint)
        yield made
        for stream in made.streams:
            stream.close()
        for other in made.others:
            other.close()


def way_in(
    stream_class: StreamClass,
    from_expr: str = "robot1/in",
    to_expr: str = "edge1/t/in",
    keep_last: int = 1,
    **options: Any,
) -> Route:
    settings = StreamSettings(stream_class=stream_class, keep_last=keep_last, depth=500, **options)
    return Route(stream="t/in/0", direction=Direction.INPUT, from_expr=from_expr, to_expr=to_expr, settings=settings)


def way_out(epoch: int, handover: HandoverRule, stream_class: StreamClass = StreamClass.RELIABLE) -> Route:
    settings = StreamSettings(stream_class=stream_class, depth=500, handover=handover)
    return Route(
        stream="t/out/0",
        direction=Direction.OUTPUT,
        from_expr=f"edge{epoch}/t/{epoch}/out",
        to_expr="robot1/out",
        settings=settings,
    )


def drops(stream: InputStream | OutputStream) -> dict[str, int]:
    return dict(stream.count().drops)


# --- inputs ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stream_class", list(StreamClass))
def test_everything_of_a_sample_goes_on(bench: Bench, stream_class: StreamClass) -> None:
    got: list[zenoh.Sample] = []
    kept = bench.outside.declare_subscriber("edge1/t/in", got.append)
    bench.flowing(way_in(stream_class))
    stamp = bench.outside.new_timestamp()
    publisher = bench.publisher("robot1/in", priority=zenoh.Priority.DATA_HIGH, express=True)
    publisher.put(b"\x00\xff", encoding="image/png;7", attachment=b"\x01\x02", timestamp=stamp)
    publisher.delete(attachment=b"gone")
    until(lambda: len(got) == 2, "both samples")
    first, second = got
    assert first.payload.to_bytes() == b"\x00\xff"
    assert str(first.encoding) == "image/png;7"
    assert first.attachment is not None
    assert first.attachment.to_bytes() == b"\x01\x02"
    assert str(first.timestamp) == str(stamp)
    assert first.priority == zenoh.Priority.DATA_HIGH
    assert first.express is True
    assert second.kind == zenoh.SampleKind.DELETE
    assert second.attachment is not None
    assert second.attachment.to_bytes() == b"gone"
    sources = [sample.source_info for sample in got]
    assert [source.source_sn for source in sources if source is not None] == [0, 1]
    assert {str(source.source_id.zid) for source in sources if source is not None} == {str(bench.relay.zid())}
    kept.undeclare()


def test_kept_values_warm_up_a_slot_key_by_key(bench: Bench) -> None:
    route = way_in(StreamClass.LATEST, "robot1/*/map", "edge1/t/*/map", keep_last=2)
    stream = bench.input(route)
    for name in ("a", "b"):
        publisher = bench.publisher(f"robot1/{name}/map")
        for number in range(3):
            publisher.put(f"{name}{number}")
    until(lambda: stream.count().messages == 6, "six values")
    got: list[tuple[str, str]] = []
    kept = bench.outside.declare_subscriber(
        "edge1/**", lambda sample: got.append((str(sample.key_expr), sample.payload.to_string()))
    )
    stream.open(1, route)
    until(lambda: stream.is_matching(1), "the target subscribes")
    assert stream.warm_up(1) == 4
    until(lambda: len(got) == 4, "the two newest of either key")
    assert got == [("edge1/t/a/map", "a1"), ("edge1/t/a/map", "a2"), ("edge1/t/b/map", "b1"), ("edge1/t/b/map", "b2")]
    assert not stream.is_behind(1)
    bench.publisher("robot1/a/map").put("a3")
    until(lambda: stream.is_behind(1), "a value that the slot has not had")
    assert stream.flip(1) == 1
    until(lambda: got[-1] == ("edge1/t/a/map", "a3"), "only that one again")
    assert stream.count().replayed == 5
    kept.undeclare()


@pytest.mark.parametrize("stream_class", [StreamClass.BEST_EFFORT, StreamClass.LATEST])
def test_images_are_taken_beside_their_topics_key_and_given_under_it(bench: Bench, stream_class: StreamClass) -> None:
    """rmw_zenoh's publishers of topics with buffer fields put there for who takes `cpu`; all take the key itself."""
    image = "sensor_msgs::msg::dds_::Image_/RIHS01_x"
    heard: list[str] = []
    kept = bench.outside.declare_subscriber("0/edge1/**", lambda sample: heard.append(str(sample.key_expr)))
    back = bench.outside.declare_subscriber("0/seen/**", lambda sample: heard.append(str(sample.key_expr)))
    settings = replace(way_in(stream_class).settings, graph=RosGraph.RMW_ZENOH)
    route = replace(way_in(stream_class), from_expr="0/cam/*/*", to_expr="0/edge1/cam/*/*", settings=settings)
    bench.flowing(route)
    for ending in ("", "/_buf_cpu"):
        bench.publisher(f"0/cam/{image}{ending}", congestion_control=zenoh.CongestionControl.BLOCK).put("image")
    until(lambda: heard == [f"0/edge1/cam/{image}"] * 2, "both")
    heard.clear()
    out = replace(
        route, direction=Direction.OUTPUT, stream="t/out/0", from_expr="0/edge2/seen/*/*", to_expr="0/seen/*/*"
    )
    stream = bench.output(out)
    stream.open(1, out)
    stream.flip(1, drops_held=False)
    for ending in ("", "/_buf_cpu"):
        bench.publisher(f"0/edge2/seen/{image}{ending}", congestion_control=zenoh.CongestionControl.BLOCK).put("image")
    until(lambda: heard == [f"0/seen/{image}"] * 2, "both")
    kept.undeclare()
    back.undeclare()


def latched(session: zenoh.Session, key: str, depth: int = 1) -> zenoh.ext.AdvancedPublisher:
    """A publisher as rmw_zenoh makes one of a transient-local topic."""
    return zenoh.ext.declare_advanced_publisher(
        session,
        key,
        cache=zenoh.ext.CacheConfig(depth),
        sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=None),
        publisher_detection=True,
    )


def late_subscriber(session: zenoh.Session, key: str, heard: list[str]) -> zenoh.ext.AdvancedSubscriber[None]:
    """A subscription as rmw_zenoh makes one of a transient-local topic."""
    return zenoh.ext.declare_advanced_subscriber(
        session,
        key,
        lambda sample: heard.append(sample.payload.to_string()),
        history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
    )


def has_all(heard: list[str], wanted: list[str]) -> bool:
    return sorted(heard) == wanted


def test_a_new_owner_gets_the_value_of_each_publisher_of_a_key(bench: Bench) -> None:
    """Three drivers have put one transform each, once for all; the new owner heard one of three for ever."""
    route = way_in(StreamClass.LATEST, "robot1/tf_static", "edge1/t/tf_static")
    stream = bench.input(route)
    drivers = [latched(bench.outside, "robot1/tf_static") for _ in range(3)]
    for number, driver in enumerate(drivers):
        driver.put(f"driver {number}")
    until(lambda: stream.count().messages == 3, "three values")
    everything = [f"driver {number}" for number in range(3)]
    for epoch, owner in enumerate(("edge1", "edge2"), start=1):
        target = replace(route, to_expr=f"{owner}/t/tf_static")
        heard: list[str] = []
        late: list[str] = []
        node = late_subscriber(bench.outside, target.to_expr, heard)
        stream.open(epoch, target)
        until(partial(stream.is_matching, epoch), "the owner subscribes")
        assert stream.flip(epoch) == 3
        until(partial(has_all, heard, everything), "all")
        other = late_subscriber(bench.another(), target.to_expr, late)
        until(partial(has_all, late, everything), "also at a node of the worker that subscribes late")
        node.undeclare()
        other.undeclare()
    ended = (str(bench.outside.zid()), drivers[1].id.eid)
    drivers[1].undeclare()
    again = latched(bench.outside, "robot1/tf_static")
    until(lambda: stream._places._is_there(ended) is False, "its token goes")
    again.put("driver 1, again")
    until(lambda: stream.count().messages == 4, "the value of a driver that has begun again")
    kept = [sample.payload.to_string() for sample, _ in stream.kept()]
    assert sorted(kept) == ["driver 0", "driver 1, again", "driver 2"], "zenoh orders no two publishers"


def test_a_late_application_gets_the_value_of_each_publisher_of_the_owner(bench: Bench) -> None:
    settings = way_in(StreamClass.LATEST).settings

    def way(owner: str) -> Route:
        return Route(
            stream="t/out/0",
            direction=Direction.OUTPUT,
            from_expr=f"{owner}/tf_static",
            to_expr="robot1/tf_static",
            settings=settings,
        )

    stream = bench.output(way("edge1"))
    for epoch, (owner, count) in enumerate((("edge1", 3), ("edge2", 2)), start=1):
        stream.open(epoch, way(owner))
        stream.know(way(owner).from_expr)
        stream.flip(epoch, drops_held=False)
        drivers = [latched(bench.outside, f"{owner}/tf_static") for _ in range(count)]
        wanted = [f"{owner}, driver {number}" for number in range(count)]
        early: list[str] = []
        late: list[str] = []
        application = late_subscriber(bench.another(), "robot1/tf_static", early)
        for driver, value in zip(drivers, wanted, strict=True):
            driver.put(value)
        until(lambda early=early, wanted=wanted, count=count: early[-count:] == wanted, "they go on")  # type: ignore[misc]
        other = late_subscriber(bench.another(), "robot1/tf_static", late)
        until(partial(has_all, late, wanted), "those of this owner, and of no other")
        application.undeclare()
        other.undeclare()


def test_of_many_keys_those_give_way_that_have_rested_longest(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """A new owner lacked the value of the key that was known longest, however often it came."""
    monkeypatch.setattr(inputs, "MAX_KEYS", 2)
    stream = bench.input(way_in(StreamClass.LATEST, "robot1/*/map", "edge1/t/*/map"))
    a, b, c = (bench.publisher(f"robot1/{name}/map") for name in ("a", "b", "c"))
    for number, publisher in enumerate((a, b, a, c), start=1):
        publisher.put("value")
        until(lambda number=number: stream.count().messages == number, "it comes")  # type: ignore[misc]
    assert [str(sample.key_expr) for sample, _ in stream.kept()] == ["robot1/a/map", "robot1/c/map"]
    fence = Fence()
    stamps = [bench.relay.new_timestamp() for _ in range(2)]
    monkeypatch.setattr(fences, "MAX_STAMPS", 2)
    fence.begin(is_first=False)
    assert [fence.passes(key, stamps[1]) for key in ("a", "b", "a", "c")] == [True] * 4
    assert not fence.passes("a", stamps[0])


def test_what_waits_behind_a_flip_goes_out_when_the_stream_ends(bench: Bench) -> None:
    """Its application has closed: nobody sent it when the former owner had done its last."""
    got: list[str] = []
    kept = bench.outside.declare_subscriber("edge2/t/in", lambda sample: got.append(sample.payload.to_string()))
    former = bench.outside.declare_subscriber("edge1/t/in", lambda _: None)
    route, stream = way_in(StreamClass.RELIABLE), bench.flowing(way_in(StreamClass.RELIABLE))
    publisher = bench.publisher("robot1/in")
    stream.open(2, replace(route, to_expr="edge2/t/in"))
    until(lambda: stream.is_matching(2), "the next owner subscribes")
    with stream._lock:
        assert stream._active is not None
        stream._hold(stream._active, stream._slots[2])
    publisher.put("a sample")
    until(lambda: stream.count().messages == 1, "it comes")
    assert not got
    stream.finish()
    until(lambda: got == ["a sample"], "it goes on")
    stream.close()
    publisher.undeclare()
    kept.undeclare()
    former.undeclare()


def test_the_end_marker_names_its_source_and_the_number_behind_it(bench: Bench) -> None:
    ends: list[zenoh.Sample] = []
    kept = bench.outside.declare_subscriber(f"edge1/t/in/{END_CHUNK}", ends.append)
    came: list[zenoh.Sample] = []
    data = bench.outside.declare_subscriber("edge1/t/in", came.append)
    stream = bench.input(way_in(StreamClass.RELIABLE))
    stream.open(1, way_in(StreamClass.RELIABLE))
    stream.open(2, way_in(StreamClass.RELIABLE, to_expr="edge2/t/in"))
    until(lambda: stream.is_matching(1), "the target subscribes")
    stream.flip(1)
    publisher = bench.publisher("robot1/in")
    for _ in range(5):
        publisher.put(b"x")
    until(lambda: len(came) == 5, "five samples")  # what has not gone out at the flip goes to the new owner instead
    stream.send_end(1)  # still active: nothing
    stream.flip(2)
    stream.send_end(1)
    until(lambda: ends, "the marker")
    assert [decode_end(sample.payload.to_bytes()) for sample in ends] == [EndMarker(epoch=1, count=5)]
    kept.undeclare()
    data.undeclare()


def test_a_slow_receiver_slows_the_publisher_down_and_nothing_is_dropped(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """More than every buffer on the way holds: the relay's thread waits, zenoh and TCP hand that back to the source."""
    monkeypatch.setattr(outlet, "QUEUE_DEPTH", 8)
    monkeypatch.setattr(send_queue, "NO_ROOM_S", 60.0)
    settings = StreamSettings(stream_class=StreamClass.RELIABLE, depth=1)
    route = replace(way_in(StreamClass.RELIABLE), settings=settings)
    stream = bench.input(route)
    got: list[int] = []

    def slow(sample: zenoh.Sample) -> None:
        got.append(int(sample.payload.to_bytes()[:8]))
        time.sleep(0.001)

    kept = bench.outside.declare_subscriber(route.to_expr, slow)
    stream.open(1, route)
    until(lambda: stream.is_matching(1), "the receiver")
    stream.flip(1)
    source = bench.another().declare_publisher(route.from_expr, congestion_control=zenoh.CongestionControl.BLOCK)
    until(lambda: matches(source), "the relay's subscription")
    for number in range(1200):
        source.put(f"{number:08d}".encode() + bytes(100_000))
    until(lambda: len(got) == 1200, "all of it", deadline_s=60.0)
    assert got == list(range(1200))
    assert drops(stream) == {}
    kept.undeclare()


def test_without_an_owner_the_loss_is_counted_and_kept_values_are_none(bench: Bench) -> None:
    best, latest = bench.input(way_in(StreamClass.BEST_EFFORT)), bench.input(way_in(StreamClass.LATEST))
    publisher = bench.publisher("robot1/in")
    until(lambda: publisher.put(b"x") or (best.count().messages and latest.count().messages), "a sample in both")
    assert drops(best)["no_route"] == best.count().messages
    assert drops(latest) == {}


def test_what_this_process_put_does_not_come_back(bench: Bench) -> None:
    bench.own_ids = frozenset({str(bench.outside.zid())})  # as if that session were ours too
    stream = bench.input(way_in(StreamClass.BEST_EFFORT))
    publisher = bench.publisher("robot1/in")
    publisher.put(b"x", source_info=zenoh.SourceInfo(publisher.id, 0))
    until(lambda: drops(stream) == {"loop": 1}, "the loop is cut and counted")


@dataclass
class Burst:
    """Samples that come while their stream stands still: its lock is held."""

    bench: Bench
    stream: InputStream | OutputStream
    key: str
    is_numbered: bool = False
    count: int = 0

    def put(self, publisher: zenoh.Publisher) -> None:
        source = zenoh.SourceInfo(publisher.id, self.count) if self.is_numbered else None
        publisher.put(str(self.count), source_info=source)
        self.count += 1

    def run(self, count: int) -> None:
        """Return when all have reached the relay; one is in the hand of the stream's thread."""
        publisher = self.bench.publisher(self.key, congestion_control=zenoh.CongestionControl.BLOCK)
        reached: list[zenoh.Sample] = []
        beside = self.bench.relay.declare_subscriber(self.key, reached.append)
        self.put(publisher)
        until(lambda: self.stream.count().messages == 1, "it carries")
        with self.stream._lock:
            for _ in range(count):
                self.put(publisher)
            until(lambda: len(reached) == self.count, "all have reached the relay")
        beside.undeclare()


@pytest.mark.parametrize("stream_class", list(StreamClass))
def test_no_sample_of_a_burst_is_lost_without_a_counter(
    bench: Bench, stream_class: StreamClass, monkeypatch: pytest.MonkeyPatch
) -> None:
    """More than `depth` come while one waits: what zenoh's ring channel dropped then, nobody counted."""
    monkeypatch.setattr(receive, "BEHIND_S", 0.0)
    got: list[str] = []
    kept = bench.outside.declare_subscriber("edge1/t/in", lambda s: got.append(s.payload.to_string()))
    route = way_in(stream_class)
    route = replace(route, settings=replace(route.settings, depth=16))
    stream = bench.flowing(route)
    Burst(bench, stream, "robot1/in").run(200)
    until(lambda: stream.count().messages == 201, f"each in a counter: {stream.count()}")
    until(lambda: got[-1:] == ["200"], "the newest")
    assert unaccounted(stream.count()) == 0
    dropped = drops(stream)
    until(lambda: len(got) + dropped.get("overflow", 0) == 201, f"{len(got)} came, {dropped}")
    if stream_class is StreamClass.BEST_EFFORT:
        assert dropped["overflow"] >= 100, "the oldest give way"
    if stream_class is StreamClass.RELIABLE:
        assert not dropped
    kept.undeclare()


@pytest.mark.parametrize("is_numbered", [False, True])
def test_an_answer_that_gives_way_is_counted_once(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, *, is_numbered: bool
) -> None:
    """As overflow; as lost where its number is missed."""
    monkeypatch.setattr(receive, "BEHIND_S", 0.0)
    got: list[str] = []
    kept = bench.outside.declare_subscriber("robot1/out", lambda s: got.append(s.payload.to_string()))
    route = way_out(1, HandoverRule.LATEST, StreamClass.BEST_EFFORT)
    route = replace(route, settings=replace(route.settings, depth=16))
    stream = bench.output(route)
    stream.open(1, route)
    stream.flip(1, drops_held=False)
    Burst(bench, stream, route.from_expr, is_numbered=is_numbered).run(200)
    until(lambda: got[-1:] == ["200"], "the newest")
    left = 201 - len(got)
    assert left >= 100
    assert (stream.count().lost, drops(stream)) == ((left, {}) if is_numbered else (0, {"overflow": left}))
    kept.undeclare()


def test_a_mirrored_input_feeds_both_owners_until_the_old_slot_closes(bench: Bench) -> None:
    got: list[str] = []
    kept = [bench.outside.declare_subscriber(f"edge{n}/**", lambda s: got.append(str(s.key_expr))) for n in (1, 2)]
    routes = [way_in(StreamClass.RELIABLE, to_expr=f"edge{n}/t/in", mirror=True) for n in (1, 2)]
    stream = bench.input(routes[0])
    for epoch, route in enumerate(routes, start=1):
        stream.open(epoch, route)
        until(partial(stream.is_matching, epoch), "the target subscribes")
    publisher = bench.publisher("robot1/in")
    stream.flip(1)
    publisher.put("a")
    until(lambda: got == ["edge1/t/in"], "the first owner")
    stream.flip(2)
    stream.send_end(1)  # the old owner works on: no end
    publisher.put("b")
    until(lambda: sorted(got[1:]) == ["edge1/t/in", "edge2/t/in"], f"both, not {got}")
    stream.close_slot(1)
    publisher.put("c")
    until(lambda: got[3:] == ["edge2/t/in"], f"the new one alone, not {got}")
    for one in kept:
        one.undeclare()


def test_a_relay_that_ends_sends_the_newest_value_that_a_rate_holds_back(bench: Bench) -> None:
    got: list[str] = []
    kept = bench.outside.declare_subscriber("edge1/t/in", lambda sample: got.append(sample.payload.to_string()))
    route = way_in(StreamClass.LATEST, max_hz=0.1)
    stream = bench.flowing(route)
    publisher = bench.publisher("robot1/in")
    for number in range(3):
        publisher.put(str(number))
    until(lambda: drops(stream) == {"thinned": 2}, "two are over the rate")
    stream.stop()
    until(lambda: got == ["0", "2"], "the first and the newest", 10)
    kept.undeclare()


@pytest.mark.parametrize("is_counted", [True, False])
def test_the_newest_value_that_is_given_up_with_a_data_session_comes_again(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, *, is_counted: bool
) -> None:
    """The owner, which froze, has acknowledged nothing of it; or a put to it waits, and the value behind that."""
    gate, put = threading.Event(), Lane.put

    def slow(lane: Lane, sample: zenoh.Sample, stamp: zenoh.Timestamp | None) -> None:
        gate.wait(10)
        put(lane, sample, stamp)

    got: list[str] = []
    kept = bench.outside.declare_subscriber("edge1/t/in", lambda s: got.append(s.payload.to_string()))
    route = way_in(StreamClass.LATEST, keep_last=2)
    stream = bench.input(route)
    acks = Acks(bench.relay, Keyspace("t"), "robot1", lambda _node, _task, _life: True)
    stream.open(1, route, acks.of("edge1", "t") if is_counted else None)
    until(lambda: stream.is_matching(1), "the target subscribes")
    stream.flip(1)
    monkeypatch.setattr(Lane, "put", slow)
    came = ["0", "1", "2"] if is_counted else ["0"]
    if is_counted:
        gate.set()
    publisher = bench.publisher("robot1/in")
    for number in range(3):
        publisher.put(str(number))
    until(lambda: stream.count().messages == 3, "all are taken")
    if is_counted:
        until(lambda: got == came, "all come")
    stream.hold()
    assert stream.leave() == (3 if is_counted else 0)
    gate.set()
    until(lambda: got == came, "what was put comes")
    stream.rejoin(bench.relay, bench.own_ids | {str(bench.relay.zid())})
    stream.resume()
    until(lambda: got == [*came, "2"], f"the newest: {got}")
    assert unaccounted(stream.count()) == 0
    acks.stalled.close()
    kept.undeclare()


def test_what_a_rate_held_back_waits_for_the_next_data_session_in_its_order(bench: Bench) -> None:
    """The newest one went ahead of what had come before it, and came again behind that."""
    got: list[str] = []
    kept = bench.outside.declare_subscriber("edge1/t/in", lambda s: got.append(s.payload.to_string()))
    stream = bench.flowing(way_in(StreamClass.LATEST, keep_last=2, max_hz=10))
    publisher = bench.publisher("robot1/in")
    publisher.put("0")
    until(lambda: got == ["0"], "what passes")
    stream.hold()
    time.sleep(0.2)  # the rate lets the next one pass
    for number in range(1, 5):
        publisher.put(str(number))
    until(lambda: stream.count().messages == 5, "all are taken")
    assert drops(stream)["thinned"], "the newest, at least"
    time.sleep(0.2)  # the one that the rate has held back is due
    stream.look_after()
    stream.resume()

    def newest_came() -> bool:
        stream.look_after()
        return got[-1:] == ["4"]

    until(newest_came, "the newest")
    publisher.put("5")
    until(lambda: got[-1:] == ["5"] or newest_came(), "one more")
    assert got == sorted(got, key=int), "in order"
    kept.undeclare()


def test_a_thinned_stream_ends_with_its_newest_value(bench: Bench) -> None:
    got: list[str] = []
    kept = bench.outside.declare_subscriber("edge1/t/in", lambda s: got.append(s.payload.to_string()))
    route = way_in(StreamClass.LATEST, max_hz=10)
    stream = bench.flowing(route)
    publisher = bench.publisher("robot1/in")
    began = time.monotonic()
    for number in range(30):
        publisher.put(str(number))
        time.sleep(0.005)
    took_s = time.monotonic() - began

    def newest_came() -> bool:
        stream.look_after()
        return got[-1:] == ["29"]

    until(newest_came, "the newest")
    assert got == sorted(set(got), key=int)
    between(0, len(got), 5 + 10 * took_s)
    assert drops(stream)["thinned"] >= 30 - len(got), "also the newest, which went out later"
    kept.undeclare()


# --- outputs ---------------------------------------------------------------------------------------------------------


class Handover:
    """An output between the owner of epoch 1 (the carrier) and that of epoch 2 (prepared)."""

    def __init__(self, bench: Bench, rule: HandoverRule, stream_class: StreamClass = StreamClass.RELIABLE) -> None:
        self.got: list[str] = []
        self.wakes: list[int] = []
        self.bench = bench
        self.kept = bench.outside.declare_subscriber("robot1/out", lambda s: self.got.append(s.payload.to_string()))
        first, second = (way_out(epoch, rule, stream_class) for epoch in (1, 2))
        self.stream = bench.output(first, lambda: self.wakes.append(1))
        for epoch, route in ((1, first), (2, second)):
            self.stream.open(epoch, route)
        self.old, self.new = (bench.publisher(route.from_expr) for route in (first, second))
        self.stream.flip(1, drops_held=False)
        self.count = 0

    def put(self, publisher: zenoh.Publisher, text: str) -> None:
        publisher.put(text)
        self.count += 1
        until(lambda: self.stream.count().messages == self.count, f"{text} came")

    def end(self, epoch: int, count: int) -> None:
        marker = encode_end(EndMarker(epoch=epoch, count=count))
        before = len(self.wakes)
        source = zenoh.SourceInfo((self.old, self.new)[epoch - 1].id, count)
        self.bench.outside.put(f"edge{epoch}/t/{epoch}/out/{END_CHUNK}", marker, source_info=source)
        until(lambda: len(self.wakes) > before, "the marker")

    def is_through(self, *texts: str) -> bool:
        return bool(until(lambda: self.got == list(texts), f"{texts}, not {self.got}"))


def test_the_first_sample_of_the_new_owner_cuts(bench: Bench) -> None:
    move = Handover(bench, HandoverRule.LATEST)
    move.put(move.old, "old 1")
    move.stream.flip(2, drops_held=False)
    move.put(move.old, "old 2")
    move.put(move.new, "new 1")
    move.put(move.old, "old 3")
    move.put(move.new, "new 2")
    assert move.is_through("old 1", "old 2", "new 1", "new 2")
    assert drops(move.stream) == {"cut": 1}
    assert move.stream.has_ended(1)


def test_what_a_cut_owner_had_on_its_way_is_counted_once_its_slot_is_closed(bench: Bench) -> None:
    """A slot that is cut closes at once; what came then was in no counter. The owner that comes back is heard once."""
    move = Handover(bench, HandoverRule.LATEST)
    move.stream.flip(2, drops_held=False)
    move.put(move.new, "new 1")
    move.stream.close_slot(1)
    move.put(move.old, "old 1")
    assert drops(move.stream) == {"cut": 1}
    move.stream.open(1, way_out(1, HandoverRule.LATEST))
    until(lambda: getattr(move.old.matching_status, "matching", False), "the slot again")
    move.put(move.old, "old 2")
    assert drops(move.stream) == {"cut": 2}
    move.stream.close_slot(1)

    def is_left() -> bool:
        move.stream.look_after()
        return not getattr(move.old.matching_status, "matching", True)

    until(is_left, "the end of the subscription")
    assert move.is_through("new 1")


def test_a_stream_that_closes_gives_no_owner_that_is_cut_the_word_again(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It carried for a moment, while the carrier's slot closed."""
    move, carriers, close = Handover(bench, HandoverRule.LATEST), [], OutputStream.close_slot
    move.put(move.old, "old 1")
    move.stream.flip(2, drops_held=False)
    move.put(move.new, "new 1")
    assert move.is_through("old 1", "new 1")

    def noted(stream: OutputStream, epoch: int) -> None:
        close(stream, epoch)
        carriers.append(None if stream._carrier is None else stream._carrier.epoch)

    monkeypatch.setattr(OutputStream, "close_slot", noted)
    move.stream.close()
    assert carriers == [2, None]


def test_with_all_the_new_owner_waits_for_the_old_ones_last(bench: Bench) -> None:
    move = Handover(bench, HandoverRule.ALL)
    move.put(move.old, "old 1")
    move.stream.flip(2, drops_held=False)
    move.put(move.new, "new 1")
    move.end(1, count=2)
    assert not move.stream.has_ended(1)
    move.put(move.old, "old 2")
    assert move.stream.has_ended(1)
    assert move.is_through("old 1", "old 2")
    move.stream.close_slot(1)
    assert move.is_through("old 1", "old 2", "new 1")
    move.put(move.new, "new 2")
    assert move.is_through("old 1", "old 2", "new 1", "new 2")
    assert drops(move.stream) == {}
    counted = move.stream.count()
    assert counted.move_epoch == 2
    assert counted.move_gap_s is not None


def test_with_all_the_answers_of_an_owner_that_dies_before_its_turn_come_in_their_turn(bench: Bench) -> None:
    """They have been acknowledged to it, and so has its input: nobody would do that again."""
    move = Handover(bench, HandoverRule.ALL)
    move.stream.flip(2, drops_held=False)
    move.put(move.new, "new 1")
    move.stream.open(3, way_out(3, HandoverRule.ALL))
    newest = bench.publisher(way_out(3, HandoverRule.ALL).from_expr)
    move.stream.close_slot(2)
    move.stream.flip(3, drops_held=False)
    move.put(newest, "newest 1")
    move.put(move.old, "old 1")
    move.stream.close_slot(1)
    move.put(newest, "newest 2")
    assert move.is_through("old 1", "new 1", "newest 1", "newest 2")
    assert drops(move.stream) == {}


def test_answers_of_owners_that_died_before_their_turn_are_bounded_and_counted(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(outputs, "LEFT_SLOTS", 1)
    move = Handover(bench, HandoverRule.ALL)
    move.stream.open(3, way_out(3, HandoverRule.ALL))
    for epoch, owner in ((2, move.new), (3, bench.publisher(way_out(3, HandoverRule.ALL).from_expr))):
        move.stream.flip(epoch, drops_held=False)
        move.put(owner, f"{epoch}")
        move.stream.close_slot(epoch)
    assert drops(move.stream) == {"closed": 1}
    move.stream.close()
    assert drops(move.stream) == {"closed": 2}


def test_an_end_whose_samples_were_dropped_counts_after_a_grace_time(bench: Bench) -> None:
    move = Handover(bench, HandoverRule.ALL)
    move.stream.flip(2, drops_held=False)
    move.end(1, count=9)
    assert not move.stream.has_ended(1)
    until(lambda: move.stream.has_ended(1), "the grace time")


def test_a_marker_of_another_epoch_ends_nothing(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(slots, "END_GRACE_S", 60.0)
    move = Handover(bench, HandoverRule.ALL)
    move.stream.flip(2, drops_held=False)
    bench.outside.put(f"edge1/t/1/out/{END_CHUNK}", encode_end(EndMarker(epoch=7, count=0)))
    bench.outside.put(f"edge1/t/1/out/{END_CHUNK}", b"no marker")
    move.end(1, count=9)  # behind them, and the first that counts: there is something to wait for
    assert not move.stream.has_ended(1)
    for number in range(9):
        move.put(move.old, str(number))
    assert move.stream.has_ended(1)


def test_reliable_answers_are_never_dropped_for_a_warm_up_value_that_has_changed(bench: Bench) -> None:
    """They may be to what another robot has sent, which has flipped before, and their worker has let go of them."""
    move = Handover(bench, HandoverRule.ALL)
    move.put(move.new, "to robot2")
    move.stream.flip(2, drops_held=True)
    move.put(move.new, "to us")
    move.stream.close_slot(1)
    assert move.is_through("to robot2", "to us")
    assert drops(move.stream) == {}


def test_answers_to_warm_up_values_that_have_changed_are_dropped(bench: Bench) -> None:
    move = Handover(bench, HandoverRule.ALL, StreamClass.LATEST)
    move.put(move.new, "stale")
    move.stream.flip(2, drops_held=True)
    move.put(move.new, "fresh")
    move.stream.close_slot(1)
    assert move.is_through("fresh")
    assert drops(move.stream) == {"superseded": 1}


def test_what_waits_is_bounded(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outputs, "HOLD_SAMPLES", 2)
    move = Handover(bench, HandoverRule.ALL)
    move.stream.flip(2, drops_held=False)
    for number in range(4):
        move.put(move.new, f"new {number}")
    move.stream.close_slot(1)
    assert move.is_through("new 2", "new 3")
    assert drops(move.stream) == {"overflow": 2}


@pytest.mark.parametrize("rule", list(HandoverRule))
def test_a_new_owners_answer_to_an_older_value_never_follows_a_newer_one(bench: Bench, rule: HandoverRule) -> None:
    got: list[str] = []
    kept = bench.outside.declare_subscriber("robot1/out", lambda s: got.append(s.payload.to_string()))
    routes = [way_out(epoch, rule, StreamClass.LATEST) for epoch in (1, 2)]
    stream = bench.output(routes[0])
    for epoch, route in enumerate(routes, start=1):
        stream.open(epoch, route)
    old, new = (bench.publisher(route.from_expr) for route in routes)
    stamps = [bench.relay.new_timestamp() for _ in range(4)]
    stream.flip(1, drops_held=False)
    old.put("old 1", timestamp=stamps[1])
    until(lambda: stream.count().messages == 1, "the old owner's")
    stream.flip(2, drops_held=False)
    for number in (0, 1, 3, 2):
        new.put(f"new {number}", timestamp=stamps[number])
    until(lambda: stream.count().messages == 5, "the new owner's")
    stream.close_slot(1)
    until(lambda: got == ["old 1", "new 1", "new 3"], f"{got}")
    assert drops(stream) == {"superseded": 2}
    kept.undeclare()


def test_answers_to_robots_with_other_clocks_hold_up_each_other_in_no_move(bench: Bench) -> None:
    """One task's only output, robot2's clock an hour behind: its answers were superseded for 2 s after each move."""
    got: list[str] = []
    kept = bench.outside.declare_subscriber("robot1/out", lambda s: got.append(s.payload.to_string()))
    routes = [way_out(epoch, HandoverRule.LATEST, StreamClass.LATEST) for epoch in (1, 2)]
    stream = bench.output(routes[0])
    for epoch, route in enumerate(routes, start=1):
        stream.open(epoch, route)
    old, new = (bench.publisher(route.from_expr) for route in routes)
    ahead, hour = bench.relay.new_timestamp(), timedelta(hours=1)
    behind = zenoh.Timestamp(ahead.get_time() - hour, bench.outside.new_timestamp().get_id())
    stream.flip(1, drops_held=False)
    old.put("robot1", timestamp=ahead)
    until(lambda: stream.count().messages == 1, "the old owner's")
    stream.flip(2, drops_held=False)
    new.put("robot2", timestamp=behind)
    until(lambda: got == ["robot1", "robot2"], f"{got}")
    assert drops(stream) == {}
    kept.undeclare()


@dataclass
class Thinned:
    """An output of class ``latest`` with one sample a second, whose clock the test turns."""

    bench: Bench
    monkeypatch: pytest.MonkeyPatch
    got: list[str] = field(default_factory=list)
    now: float = 100.0
    count: int = 0

    def __post_init__(self) -> None:
        self.monkeypatch.setattr(outputs, "monotonic_s", lambda: self.now)
        self.kept = self.bench.outside.declare_subscriber(
            "robot1/out", lambda s: self.got.append(s.payload.to_string())
        )
        routes = [way_out(epoch, HandoverRule.LATEST, StreamClass.LATEST) for epoch in (1, 2)]
        routes = [replace(route, settings=replace(route.settings, max_hz=1.0)) for route in routes]
        self.stream = self.bench.output(routes[0])
        for epoch, route in enumerate(routes, start=1):
            self.stream.open(epoch, route)
        self.old, self.new = (self.bench.publisher(route.from_expr) for route in routes)
        self.stream.flip(1, drops_held=False)

    def put(self, publisher: zenoh.Publisher, text: str) -> None:
        publisher.put(text)
        self.count += 1
        until(lambda: self.stream.count().messages == self.count, f"{text} came")

    def wait(self) -> None:
        """What was passed over may go on now."""
        self.now += 1.5
        self.stream.look_after()


def test_an_old_owners_thinned_value_never_follows_the_new_owners(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    move = Thinned(bench, monkeypatch)
    move.put(move.old, "1")
    move.put(move.old, "2")
    move.stream.flip(2, drops_held=False)
    move.put(move.new, "3")
    move.wait()
    move.wait()
    move.put(move.new, "4")
    until(lambda: move.got == ["1", "3", "4"], f"{move.got}")
    assert drops(move.stream) == {"thinned": 2}


def test_numbers_that_do_not_fit_are_counted_and_old_ones_dropped(bench: Bench) -> None:
    move = Handover(bench, HandoverRule.ALL)
    source = move.old.id
    for number in (0, 1, 4, 4, 3, 5):
        move.old.put(str(number), source_info=zenoh.SourceInfo(source, number))
    until(lambda: move.stream.count().messages == 6, "all of them")
    assert move.is_through("0", "1", "4", "5")
    count = move.stream.count()
    assert (count.lost, count.doubled, count.reordered) == (2, 1, 1)


def test_one_epoch_after_another_of_the_same_owner_doubles_nothing(bench: Bench) -> None:
    """Without {epoch} both slots have one key: its one subscription passes from the old slot to the new one."""
    got: list[str] = []
    kept = bench.outside.declare_subscriber("robot1/out", lambda s: got.append(s.payload.to_string()))
    settings = StreamSettings(stream_class=StreamClass.RELIABLE, depth=500, handover=HandoverRule.ALL)
    route = Route(
        stream="t/out/0", direction=Direction.OUTPUT, from_expr="edge1/t/out", to_expr="robot1/out", settings=settings
    )
    stream = bench.output(route)
    stream.open(1, route)
    owner = bench.publisher("edge1/t/out")
    stream.flip(1, drops_held=False)
    for epoch in (2, 3):
        owner.put(f"before {epoch}")
        stream.open(epoch, route)
        stream.flip(epoch, drops_held=False)
        owner.put(f"between {epoch}")
        assert stream.has_ended(epoch - 1)
        stream.close_slot(epoch - 1)
        owner.put(f"after {epoch}")
    expected = [f"{when} {epoch}" for epoch in (2, 3) for when in ("before", "between", "after")]
    until(lambda: got == expected, f"each once: {got}")
    kept.undeclare()


def test_an_answer_in_hand_while_its_subscription_goes_to_the_next_slot_is_that_ones(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The receiver's thread waited for the lock with it."""
    is_in_hand = threading.Event()
    carry, hand_on = OutputStream._carry, OutputStream._hand_on

    def take(stream: OutputStream, *given: Any) -> None:
        is_in_hand.set()
        carry(stream, *given)

    def put_and_hand_on(stream: OutputStream, slot: slots.OutputSlot) -> slots.Feed | None:
        publisher.put("0")
        assert is_in_hand.wait(10)
        return hand_on(stream, slot)

    monkeypatch.setattr(OutputStream, "_carry", take)
    monkeypatch.setattr(OutputStream, "_hand_on", put_and_hand_on)
    got: list[str] = []
    kept = bench.outside.declare_subscriber("robot1/out", lambda s: got.append(s.payload.to_string()))
    route = replace(way_out(1, HandoverRule.ALL), from_expr="edge1/t/out")
    stream = bench.output(route)
    for epoch in (1, 2):
        stream.open(epoch, route)
        stream.flip(epoch, drops_held=False)
    publisher = bench.publisher(route.from_expr)
    stream.close_slot(1)
    until(lambda: stream.count().messages == 1, "it is carried")
    assert drops(stream) == {}
    until(lambda: got == ["0"], "it goes on")
    kept.undeclare()


def test_a_forged_number_does_not_end_an_output(bench: Bench) -> None:
    """Whoever hears a stream knows its publisher: one sample in its name must not make the rest old."""
    out = bench.output(way_out(1, HandoverRule.LATEST, StreamClass.BEST_EFFORT))
    out.open(1, way_out(1, HandoverRule.LATEST, StreamClass.BEST_EFFORT))
    out.flip(1, drops_held=False)
    heard: list[int] = []
    got = bench.outside.declare_subscriber("robot1/out", lambda one: heard.append(int(one.payload.to_bytes())))
    publisher = bench.publisher("edge1/t/1/out")
    stranger = bench.another()
    until(lambda: matches(stranger.declare_publisher("edge1/t/1/out")), "the stranger reaches the relay")

    def put(number: int, session: zenoh.Session) -> None:
        session.put("edge1/t/1/out", str(number).encode(), source_info=zenoh.SourceInfo(publisher.id, number))

    for number in range(3):
        put(number, bench.outside)
    until(lambda: len(heard) == 3, "the first ones")
    put(10**6, stranger)
    until(lambda: len(heard) == 4, "the forged one")
    for number in range(3, 8):
        put(number, bench.outside)
    until(lambda: len(heard) == 7, "the stream to go on")
    assert heard == [0, 1, 2, 10**6, 5, 6, 7]
    assert out.count().lost == 2
    got.undeclare()


def test_answers_that_wait_when_an_output_ends_are_counted(bench: Bench) -> None:
    """The next owner's wait for the end of the one before, with `HandoverRule.ALL`."""
    stream = bench.output(way_out(1, HandoverRule.ALL))
    for epoch in (1, 2):
        stream.know(way_out(epoch, HandoverRule.ALL).from_expr)
        stream.open(epoch, way_out(epoch, HandoverRule.ALL))
        stream.flip(epoch, drops_held=False)
    publisher = bench.publisher("edge2/t/2/out")
    for _ in range(3):
        publisher.put(b"x")
    until(lambda: stream.count().messages == 3, "all of them")
    stream.close()
    assert drops(stream) == {"closed": 3}
