"""A tap on a real session: what waits for its reader is bounded, and what it drops is counted."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import zenoh

from support.sessions import hub_and_neighbour, matches
from support.waiting import free_endpoint, until
from zsched.host.clock import monotonic_s
from zsched.link.bus import stream_tap
from zsched.link.bus.stream_tap import StreamTap
from zsched.link.sessions.config import worker_config

KEY = "robot1/image"


@pytest.fixture
def hub() -> Iterator[tuple[zenoh.Publisher, str]]:
    """A publisher at a relay's session, and the configuration of a client of it."""
    endpoint = free_endpoint()
    with hub_and_neighbour(endpoint) as (session, _):
        publisher = session.declare_publisher(KEY, congestion_control=zenoh.CongestionControl.BLOCK)
        yield publisher, worker_config(connect=(endpoint,), shared_memory=False)


def taken(tap: StreamTap) -> list[stream_tap.Tapped]:
    return list(tap.until(monotonic_s() + 0.2))


def test_a_reader_that_stands_still_keeps_no_more_than_the_bound_and_misses_the_rest(
    hub: tuple[zenoh.Publisher, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A terminal that is held: images of 1 MiB came at 30 Hz and filled the robot's memory."""
    monkeypatch.setattr(stream_tap, "HELD_BYTES", 4000)
    publisher, config = hub
    with StreamTap({"fleet": config}, [KEY], kept_bytes=None) as tap:
        until(lambda: matches(publisher), "the tap")
        for _ in range(20):
            publisher.put(bytes(1000))
        until(lambda: tap.missed == 16, "all have come")
        assert [one.payload for one in taken(tap)] == [bytes(1000)] * 4
        publisher.put(bytes(5000))
        until(lambda: [one.size for one in taken(tap)] == [5000], "one that is larger than all that may wait")
        publisher.put(b"again")
        until(lambda: [one.payload for one in taken(tap)] == [b"again"], "the next one")
    assert tap.missed == 16
    assert tap.told("printed") == "16 samples came faster than they could be printed"


@pytest.mark.parametrize(("kept_bytes", "kept"), [(0, b""), (3, b"hel"), (None, b"hello")])
def test_as_much_of_a_payload_is_kept_as_is_asked_for(
    hub: tuple[zenoh.Publisher, str], kept_bytes: int | None, kept: bytes
) -> None:
    publisher, config = hub
    with StreamTap({"fleet": config}, [KEY], kept_bytes=kept_bytes) as tap:
        until(lambda: matches(publisher), "the tap")
        publisher.put(b"hello", attachment=b"four")
        (one,) = until(lambda: taken(tap), "the sample")
    assert (one.key, one.size, one.payload, one.attachment_size) == (KEY, 5, kept, 4)


def test_what_comes_faster_than_it_is_taken_is_told_though_zenoh_drops_it_without_a_word(
    hub: tuple[zenoh.Publisher, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stream_tap, "RING", 10)
    publisher, config = hub
    with StreamTap({"fleet": config}, [KEY]) as tap:
        until(lambda: matches(publisher), "the tap")
        came = 0
        for _ in range(200):
            for _ in range(200):
                publisher.put(b"x")
            came += len(list(tap.until(monotonic_s() + 0.01)))
            if tap.may_miss_more:
                break
        assert tap.may_miss_more, came
        assert tap.missed == 0
        assert tap.told("counted") == "maybe some samples came faster than they could be counted"
