"""What stays of the counters of streams that open and close."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest
import zenoh

from support.sessions import hub_and_neighbour, matches
from support.waiting import until
from zsched.core.hop.books import unaccounted
from zsched.core.values.plan import Direction, Route, StreamClass, StreamSettings
from zsched.core.values.struct import replace
from zsched.link.keyspace import Keyspace
from zsched.link.sessions import send_queue
from zsched.relay.open_streams import OpenStreams
from zsched.relay.streams.acks import Acks
from zsched.relay.streams.outlet import QUEUE_DEPTH

IN = Route(
    stream="t/in/0",
    direction=Direction.INPUT,
    from_expr="robot1/in",
    to_expr="edge1/t/in",
    settings=StreamSettings(depth=100),
)


class Life:
    """A relay with the streams of one task."""

    def __init__(self, session: zenoh.Session, outside: zenoh.Session) -> None:
        self.streams = OpenStreams(session, frozenset({str(session.zid())}))
        self._outside = outside

    def take(self, count: int, route: Route = IN) -> None:
        """Open an input, and take so many samples."""
        source = self.streams.input_of(route)
        publisher = self._outside.declare_publisher(route.from_expr, congestion_control=zenoh.CongestionControl.BLOCK)
        until(lambda: matches(publisher), "the relay subscribes")
        wanted = source.count().messages + count
        for _ in range(count):
            publisher.put(b"x")
        until(lambda: source.count().messages == wanted, f"{count} samples")
        publisher.undeclare()

    def remove(self) -> None:
        """Close all, and wait until everybody knows."""
        self.streams.keep(())
        publisher = self._outside.declare_publisher(IN.from_expr)
        until(lambda: not matches(publisher), "nobody subscribes any more")
        publisher.undeclare()


@pytest.fixture
def sessions() -> Iterator[tuple[zenoh.Session, zenoh.Session]]:
    with hub_and_neighbour() as made:
        yield made


def test_an_input_that_comes_again_goes_on_with_its_counters(sessions: tuple[zenoh.Session, zenoh.Session]) -> None:
    """Under another key, too."""
    life = Life(*sessions)
    life.take(5)
    life.remove()
    life.take(3)
    other = replace(IN, from_expr="robot1/other")
    life.take(1, other)
    found = next(count for count in life.streams.counts() if count.stream == IN.stream)
    assert (found.messages, unaccounted(found)) == (9, 0)
    life.streams.close()


LATEST = StreamSettings(stream_class=StreamClass.LATEST, keep_last=2)
MAP = replace(IN, from_expr="robot1/map", to_expr="edge1/t/map", settings=LATEST)
SECOND = replace(MAP, stream="t/in/1")


@pytest.mark.parametrize(
    ("before", "behind"),
    [
        ((MAP,), (replace(MAP, settings=replace(LATEST, max_hz=5.0)),)),
        ((MAP,), (IN, SECOND)),
        ((IN, SECOND), (MAP,)),
    ],
    ids=["settings", "moves down", "moves up"],
)
def test_kept_values_outlive_a_change_of_their_rule(
    sessions: tuple[zenoh.Session, zenoh.Session], before: tuple[Route, ...], behind: tuple[Route, ...]
) -> None:
    """Their publisher has put them once, and keeps nothing itself: the next owner has them of nobody else."""
    got: list[str] = []
    kept = sessions[1].declare_subscriber("edge1/t/map", lambda sample: got.append(sample.payload.to_string()))
    streams = Life(*sessions).streams
    for route in before:
        streams.input_of(route)
    publisher = sessions[1].declare_publisher(MAP.from_expr)
    until(lambda: matches(publisher), "the relay subscribes")
    for number in range(3):
        publisher.put(str(number))
    until(lambda: sum(count.messages for count in streams.counts()) == 3, "they are kept")
    for route in behind:
        source = streams.input_of(route)
    streams.keep({route.stream for route in behind})
    source.open(1, behind[-1])
    until(lambda: source.is_matching(1), "the owner subscribes")
    assert source.flip(1) == 2
    until(lambda: got == ["1", "2"], f"the newest two, not {got}")
    until(lambda: matches(publisher), "the relay subscribes still")
    publisher.put("3")
    until(lambda: got == ["1", "2", "3"], "what comes behind them")
    streams.close()
    kept.undeclare()


@pytest.mark.parametrize("depth", [100, 300], ids=["by zenoh's thread", "by ours"])
def test_what_waits_for_a_slow_worker_is_counted_when_its_rule_changes(
    sessions: tuple[zenoh.Session, zenoh.Session], monkeypatch: pytest.MonkeyPatch, depth: int
) -> None:
    """The relay has taken it off the network, and its thread waited for room in the owner's queue."""
    monkeypatch.setattr(send_queue, "NO_ROOM_S", 30.0)  # as for a worker that takes one now and then
    relay, outside = sessions
    settings = StreamSettings(stream_class=StreamClass.RELIABLE, depth=depth)
    route, streams = replace(IN, settings=settings), Life(*sessions).streams
    acks = Acks(relay, Keyspace("test"), "robot1", lambda *_: True)
    source = streams.input_of(route)
    source.open(1, route, acks.of("edge1", "t"))  # whose worker is not there yet: nothing goes out
    source.flip(1)
    publisher = outside.declare_publisher(IN.from_expr, congestion_control=zenoh.CongestionControl.BLOCK)
    until(lambda: matches(publisher), "the relay subscribes")
    room = max(depth, QUEUE_DEPTH)
    for _ in range(room + 150):
        publisher.put(b"x")
    until(lambda: source.count().messages >= room, "the queue is full")
    time.sleep(0.1)
    assert source.count().messages < room + 150, "some are in hand"
    streams.input_of(replace(route, settings=replace(settings, depth=depth + 1)))
    told = streams.counts()[0]
    assert told.messages == room + 150
    assert unaccounted(told) == 0
    assert dict(told.drops) == {"closed": room + 150}
    streams.close()
