"""`zsched.relay.streams.crowd`: which application is waited for or left behind; TCP's word on real connections."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Iterator
from types import SimpleNamespace
from typing import cast

import pytest
import zenoh

from support.sessions import hub_and_neighbour
from support.waiting import free_endpoint, until
from zsched.core.values.plan import StreamClass, StreamSettings
from zsched.link.sessions.config import client_config, data_config
from zsched.link.sessions.link_sockets import LinkSocket, LinkSockets
from zsched.link.sessions.send_queue import NO_ROOM_S
from zsched.relay.streams import crowd
from zsched.relay.streams.crowd import MAX_REST_S, REST_S, Crowd, Reader, note_feeder
from zsched.relay.streams.given import Given
from zsched.relay.streams.lanes import Lane
from zsched.relay.streams.outlet import Outlet

NOW = 100.0


@contextlib.contextmanager
def connection() -> Iterator[tuple[socket.socket, socket.socket]]:
    """(ours, theirs)."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        ours = socket.create_connection(server.getsockname())
        theirs, _ = server.accept()
        with ours, theirs:
            yield ours, theirs


def link_of(ours: socket.socket) -> LinkSocket:
    return LinkSocket("1", (ours.getsockname(), ours.getpeername()), ours.fileno())


@pytest.fixture
def pair() -> Iterator[tuple[Reader, socket.socket, socket.socket]]:
    with connection() as (ours, theirs):
        yield Reader(link_of(ours), NOW), ours, theirs


Pair = tuple[Reader, socket.socket, socket.socket]


def test_what_the_other_end_has_taken_is_tcps_word(pair: Pair) -> None:
    reader, ours, _ = pair
    before = reader.link.taken()
    ours.sendall(bytes(1000))
    until(lambda: reader.link.taken() == before + 1000, "the acknowledgement")


def test_a_link_that_is_gone_has_taken_nothing_and_cannot_be_cut() -> None:
    with connection() as (ours, _):
        link = link_of(ours)
    assert (link.taken(), link.cut()) == (0, False)


def test_another_ones_descriptor_is_not_cut() -> None:
    with connection() as (ours, _), connection() as (other, peer):
        assert not LinkSocket("1", (ours.getsockname(), ours.getpeername()), other.fileno()).cut()
        other.sendall(b"x")
        assert peer.recv(1) == b"x"


def test_a_link_that_is_cut_ends(pair: Pair) -> None:
    reader, _, theirs = pair
    assert reader.link.cut()
    assert theirs.recv(1) == b""


def test_the_kernel_says_whose_link_has_room() -> None:
    with connection() as (full, theirs), connection() as (free, _):
        readers = [Reader(link_of(one), NOW) for one in (full, free)]
        assert crowd._ready(readers, 0.0) == {full.fileno(), free.fileno()}
        full.setblocking(False)
        sent = 0
        with contextlib.suppress(BlockingIOError):
            while True:
                sent += full.send(bytes(1 << 20))
        until(lambda: crowd._ready(readers, 0.0) == {free.fileno()}, "no room at the one that takes nothing")
        while sent:
            sent -= len(theirs.recv(sent))
        until(lambda: crowd._ready(readers, 0.0) == {full.fileno(), free.fileno()}, "room again")


def test_a_reader_moves_as_long_as_it_takes_something(pair: Pair) -> None:
    reader, ours, _ = pair
    reader.look(NOW + 1, has_room=False)
    assert reader.moved_at == NOW + 1, "it has only now no room"
    reader.look(NOW + 2, has_room=False)
    assert reader.moved_at == NOW + 1
    before = reader.link.taken()
    ours.sendall(b"more")
    until(lambda: reader.link.taken() > before, "the acknowledgement")
    reader.look(NOW + 3, has_room=False)
    assert reader.moved_at == NOW + 3
    reader.look(NOW + 4, has_room=True)
    reader.look(NOW + 5, has_room=False)
    assert reader.moved_at == NOW + 5


@pytest.mark.parametrize(("share", "receives"), [(2.5, True), (20, True), (100, False)])
def test_one_that_takes_some_of_the_keys_receives_the_stream(pair: Pair, share: float, *, receives: bool) -> None:
    """The link of one who only publishes carries next to nothing."""
    reader, ours, _ = pair
    reader.compare(crowd.TOLD_BYTES)  # what its link carried before
    reader.receives = not receives
    ours.sendall(bytes(int(crowd.TOLD_BYTES / share)))
    reader.compare(2 * crowd.TOLD_BYTES)
    assert reader.receives is receives


def fill(ours: socket.socket) -> None:
    """Until nothing fits any more, also after the kernel has moved what fits at the other end."""
    ours.setblocking(False)
    while crowd._ready([Reader(link_of(ours), NOW)], 0.2):
        with contextlib.suppress(BlockingIOError):
            while True:
                ours.send(bytes(1 << 20))


def test_a_full_queue_waits_no_longer_for_a_frozen_one_while_somebody_has_room(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever takes next to nothing of the stream counts as nobody, and hears it all the same."""
    monkeypatch.setattr(Crowd, "_look", lambda *_args, **_named: False)
    has_queue_room, left = [True], list[tuple[Reader, ...]]()
    with hub_and_neighbour() as (session, _), connection() as (stuck, _), connection() as (free, _):
        fill(stuck)
        frozen, little = Reader(link_of(stuck), NOW), Reader(link_of(free), NOW, receives=False)
        made = Crowd(session, "out", lambda: True, lambda _: has_queue_room[0], is_latest=False)
        made._readers = {one.link: one for one in (frozen, little)}
        thread = threading.Thread(target=lambda: left.append(made._wait(1)))
        thread.start()
        try:
            thread.join(4 * NO_ROOM_S)
            assert thread.is_alive(), "the queue holds what it does not take"
            has_queue_room[0] = False
            until(lambda: left == [(frozen,)], "a put")
        finally:
            made.close()
            thread.join(10)


def test_half_of_the_time_is_forgiven(pair: Pair) -> None:
    reader, _, _ = pair
    reader.cost_s = 1.0
    reader.look(NOW + 1, has_room=False)
    assert reader.cost_s == 0.5
    reader.look(NOW + 9, has_room=True)
    assert reader.cost_s == 0.0


def test_who_is_left_again_soon_rests_longer(pair: Pair) -> None:
    reader, _, _ = pair
    now, rests = NOW, []
    for _ in range(6):
        reader.leave(now)
        assert reader.left_until is not None
        rests.append(reader.left_until - now)
        reader.come_back(reader.left_until)
        assert reader.left_until is not None, "not before its rest is over"
        now = reader.left_until + 0.1
        reader.come_back(now)
        assert reader.left_until is None
    assert rests == [REST_S, 2 * REST_S, 4 * REST_S, MAX_REST_S, MAX_REST_S, MAX_REST_S]
    reader.leave(now + MAX_REST_S)
    assert reader.left_until == now + MAX_REST_S + REST_S


def test_the_sockets_of_all_links_are_found_and_workers_receive_no_outputs() -> None:
    endpoint = free_endpoint()
    with contextlib.ExitStack() as stack:
        texts = [data_config(listen=(endpoint,), connect=(), shared_memory=False)]
        texts += [client_config(connect=(endpoint,))] * 3
        hub, *apps = [stack.enter_context(zenoh.open(zenoh.Config.from_json5(text))) for text in texts]
        sockets = LinkSockets(hub)
        until(lambda: len(sockets.links()) == 3, "the links")
        made = crowd.Crowd(hub, "out", lambda: False, lambda _: True, is_latest=False)
        note_feeder(str(apps[2].zid()))
        made._look(NOW)
        links = list(made._readers)
        assert {link.zid for link in links} == {str(apps[0].zid()), str(apps[1].zid())}
        assert all(link.taken() > 0 for link in links)
        assert {link.ends[0][1] for link in links} == {int(endpoint.rsplit(":", 1)[1])}


def test_what_readers_have_missed_is_told_once_also_to_one_who_asks_meanwhile(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[int] = []

    monkeypatch.setattr(Crowd, "_look", lambda *_args, **_named: False)
    monkeypatch.setattr(Crowd, "_wait", lambda *_: (None, None))
    with hub_and_neighbour() as (session, _):
        made = Crowd(session, "out", lambda: False, lambda _: True, is_latest=False)
        lane = SimpleNamespace(put_dropping=lambda *_: told.append(made.take_missed()))
        for _ in range(3):
            made.put(cast("Lane", lane), cast("zenoh.Sample", None), None, 1)
        assert sum(told) + made.take_missed() == 6


def test_what_a_reader_has_missed_comes_again_and_never_behind_a_newer_sample(
    pair: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A put that waits lets newer samples queue up; what is owed when it ends is old."""
    left, got, put = [pair[0]], list[str](), Lane.put
    began, gate = threading.Event(), threading.Event()
    gate.set()

    def slow(lane: Lane, sample: zenoh.Sample, stamp: zenoh.Timestamp | None) -> None:
        began.set()
        gate.wait(10)
        put(lane, sample, stamp)

    monkeypatch.setattr(Lane, "put", slow)
    monkeypatch.setattr(Crowd, "_look", lambda *_args, **_named: False)
    monkeypatch.setattr(Crowd, "_wait", lambda *_: tuple(left))
    settings = StreamSettings(stream_class=StreamClass.LATEST, keep_last=1)
    with hub_and_neighbour() as (relay, outside):
        kept = outside.declare_subscriber("out", lambda sample: got.append(sample.payload.to_string()))
        way = Outlet(relay, "in", "out", settings, has_crowd=True)
        until(lambda: way.is_matching, "the application")

        def send(text: str) -> None:
            way.send(cast("zenoh.Sample", Given("in", zenoh.ZBytes(text))))

        def is_again() -> bool:
            way.look_after()
            return got == ["missed"] * 2

        send("missed")
        until(lambda: got == ["missed"], "those that have room get it")
        left.clear()
        until(is_again, "it is put again")
        left.append(pair[0])
        send("too old")
        until(lambda: got[2:] == ["too old"], "those that have room get it")
        left.clear()
        began.clear()
        gate.clear()
        send("newer")
        assert began.wait(10)
        send("newest")
        way.look_after()
        gate.set()
        until(lambda: got[-1:] == ["newest"], "the newest")
        send("end")
        until(lambda: got[-1:] == ["end"], "the end")
        assert got[2:] == ["too old", "newer", "newest", "end"]
        way.undeclare()
        kept.undeclare()
