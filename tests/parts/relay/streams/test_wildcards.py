"""Streams with wildcards: each captured key goes its own way, has its own kept values and its own end."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import zenoh

from support.sessions import hub_and_neighbour
from support.waiting import until
from zsched.core.hop.books import unaccounted
from zsched.core.values.fleet import LocalMode, LocalSide
from zsched.core.values.plan import Direction, Route, StreamClass, StreamSettings
from zsched.link.keyspace import END_CHUNK
from zsched.link.pipe.frames import decode_end
from zsched.link.sessions.config import local_config
from zsched.relay.streams import outlet
from zsched.relay.streams.inputs import InputStream
from zsched.relay.streams.outputs import OutputStream

SENSORS = ("front/scan", "rear/scan", "imu")


class Bench:
    """A relay's session and one for everybody else, which keeps what it hears by key."""

    def __init__(self, relay: zenoh.Session, outside: zenoh.Session) -> None:
        self.relay, self.outside = relay, outside
        self.heard: dict[str, list[bytes]] = {}
        self.streams: list[InputStream | OutputStream] = []

    @property
    def own_ids(self) -> frozenset[str]:
        return frozenset({str(self.relay.zid())})

    def listen(self, expr: str) -> None:
        self.outside.declare_subscriber(
            expr, lambda sample: self.heard.setdefault(str(sample.key_expr), []).append(sample.payload.to_bytes())
        )

    def put(self, key: str, payload: str) -> bool:
        """Publish; `False`, so that conditions can be joined with ``or``."""
        self.outside.put(key, payload, congestion_control=zenoh.CongestionControl.BLOCK)
        return False

    def close(self) -> None:
        for stream in self.streams:
            stream.close()


@pytest.fixture
def bench() -> Iterator[Bench]:
    with hub_and_neighbour() as (relay, outside):
        made = Bench(relay, outside)
        yield made
        made.close()


def way(direction: Direction, from_expr: str, to_expr: str, stream_class: StreamClass) -> Route:
    settings = StreamSettings(stream_class=stream_class, depth=100)
    return Route(stream="t/x/0", direction=direction, from_expr=from_expr, to_expr=to_expr, settings=settings)


def test_every_captured_key_goes_on_under_its_own(bench: Bench) -> None:
    route = way(Direction.INPUT, "robot1/s/**", "edge1/t/robot1/**", StreamClass.RELIABLE)
    stream = InputStream(bench.relay, route, bench.own_ids)
    bench.streams.append(stream)
    bench.listen("edge1/t/**")
    bench.listen(f"edge1/t/**/{END_CHUNK}")
    stream.open(1, route)
    until(lambda: stream.is_matching(1), "the worker's subscription")
    stream.flip(1)
    until(lambda: bench.put("robot1/s/imu", "0") or bench.heard, "the relay's subscription")
    for count in range(1, 6):
        for sensor in SENSORS:
            bench.put(f"robot1/s/{sensor}", str(count))
    for sensor in SENSORS:
        key = f"edge1/t/robot1/{sensor}"
        until(lambda key=key: bench.heard.get(key, [])[-5:] == [b"1", b"2", b"3", b"4", b"5"], key)  # type: ignore[misc] # bound at once
    other = way(Direction.INPUT, route.from_expr, "edge2/t/robot1/**", StreamClass.RELIABLE)
    stream.open(2, other)
    stream.flip(2)
    stream.send_end(1)
    for sensor in SENSORS:
        key = f"edge1/t/robot1/{sensor}"
        (raw,) = until(lambda key=key: bench.heard.get(f"{key}/{END_CHUNK}"), f"the end of {key}")  # type: ignore[misc] # bound at once
        end = decode_end(raw)
        assert end is not None
        assert (end.epoch, end.count) == (1, len(bench.heard[key]))


def test_the_last_value_of_every_key_warms_a_new_owner_up(bench: Bench) -> None:
    route = way(Direction.INPUT, "robot1/s/*/scan", "edge1/t/*", StreamClass.LATEST)
    stream = InputStream(bench.relay, route, bench.own_ids)
    bench.streams.append(stream)
    until(lambda: bench.put("robot1/s/a/scan", "old") or stream.count().messages, "the relay's subscription")
    for name in "abc":
        bench.put(f"robot1/s/{name}/scan", f"new {name}")
    bench.put("robot1/s/a/b/scan", "two chunks are not one")
    seen: list[zenoh.Sample] = []
    bench.relay.declare_subscriber("robot1/s/end", seen.append)
    until(lambda: bench.put("robot1/s/end", "") or seen, "what was put before: a link keeps its order")
    bench.listen("edge1/t/**")
    stream.open(1, route)
    until(lambda: stream.is_matching(1), "the worker's subscription")
    stream.warm_up(1)
    expected = {f"edge1/t/{name}": [f"new {name}".encode()] for name in "abc"}
    until(lambda: bench.heard == expected, "the kept values, one for each key")


def test_an_output_takes_its_captures_from_whoever_is_the_owner(bench: Bench) -> None:
    first = way(Direction.OUTPUT, "edge1/t/1/**", "robot1/out/**", StreamClass.RELIABLE)
    second = way(Direction.OUTPUT, "edge2/t/2/**", "robot1/out/**", StreamClass.RELIABLE)
    stream = OutputStream(bench.relay, first, bench.own_ids, lambda: None)
    bench.streams.append(stream)
    bench.listen("robot1/out/**")
    for epoch, route in ((1, first), (2, second)):
        stream.know(route.from_expr)
        stream.open(epoch, route)
        stream.flip(epoch, drops_held=False)
        owner = f"edge{epoch}"

        def has_come(owner: str = owner, epoch: int = epoch) -> bool:
            return bench.put(f"{owner}/t/{epoch}/a/b", owner) or owner.encode() in bench.heard.get("robot1/out/a/b", [])

        if epoch == 2:
            stream.close_slot(1)
        until(has_come, f"the output of {owner}")
    assert set(bench.heard) == {"robot1/out/a/b"}


def test_keys_are_bounded_and_what_is_too_much_is_counted(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outlet, "MAX_LANES", 3)
    route = way(Direction.INPUT, "robot1/*", "edge1/t/*", StreamClass.BEST_EFFORT)
    stream = InputStream(bench.relay, route, bench.own_ids)
    bench.streams.append(stream)
    bench.listen("edge1/t/*")
    stream.open(1, route)
    stream.flip(1)
    until(lambda: bench.put("robot1/k0", "x") or bench.heard, "the stream flows")
    for number in range(6):
        bench.put(f"robot1/k{number}", "x")
    until(lambda: dict(stream.count().drops).get("too_many_keys", 0) >= 3, "three keys too many")
    wanted = {"edge1/t/k0", "edge1/t/k1", "edge1/t/k2"}
    until(lambda: set(bench.heard) >= wanted, "the three keys that have a lane")
    assert set(bench.heard) == wanted


@pytest.mark.parametrize("stream_class", list(StreamClass))
@pytest.mark.parametrize("direction", [Direction.INPUT, Direction.OUTPUT])
def test_keys_that_rest_give_way_to_new_ones(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, direction: Direction, stream_class: StreamClass
) -> None:
    """Robots that put under a new id each time would be heard no more after the first thousands."""
    monkeypatch.setattr(outlet, "MAX_LANES", 3)
    monkeypatch.setattr(outlet, "REST_S", 0.0)
    monkeypatch.setattr(outlet, "ROOM_EVERY_S", 0.0)
    route = way(direction, "from/t/*", "to/t/*", stream_class)
    stream: InputStream | OutputStream
    if direction is Direction.INPUT:
        stream = InputStream(bench.relay, route, bench.own_ids)
        bench.streams.append(stream)
        stream.open(1, route)
        stream.flip(1)
    else:
        stream = OutputStream(bench.relay, route, bench.own_ids, lambda: None)
        bench.streams.append(stream)
        stream.open(1, route)
        stream.flip(1, drops_held=False)
    bench.listen("to/t/*")
    until(lambda: bench.put("from/t/k", "x") or bench.heard, "the stream flows")
    for number in [*range(8), 0]:
        before = len(bench.heard.get(f"to/t/k{number}", []))
        bench.put(f"from/t/k{number}", "x")
        until(lambda number=number, before=before: len(bench.heard.get(f"to/t/k{number}", [])) > before, "the sample")  # type: ignore[misc] # bound at once
    count = stream.count()
    assert (count.drops, count.lost, count.doubled) == ((), 0, 0)
    if direction is Direction.INPUT:
        until(lambda: unaccounted(stream.count()) == 0, "the books")


def test_a_local_side_is_a_client_or_a_peer_without_the_fleets_settings() -> None:
    client = zenoh.Config.from_json5(local_config(LocalSide(connect=("tcp/127.0.0.1:7447",))))
    assert client.get_json("mode") == '"client"'
    assert client.get_json("connect/endpoints") == '["tcp/127.0.0.1:7447"]'
    peer = zenoh.Config.from_json5(local_config(LocalSide(mode=LocalMode.PEER, listen=("tcp/127.0.0.1:7500",))))
    assert peer.get_json("mode") == '"peer"'
    assert peer.get_json("listen/endpoints") == '["tcp/127.0.0.1:7500"]'
    for config in (client, peer):
        assert config.get_json("scouting/multicast/enabled") == "false"
        assert config.get_json("transport/shared_memory/enabled") == "false"
