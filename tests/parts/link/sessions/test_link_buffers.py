"""Send buffers of real links: large towards a fast receiver, small before a thin radio, small once it becomes thin."""

from __future__ import annotations

import contextlib
import json
import socket
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest
import zenoh

from support.certificates import make_tls
from support.programs import process
from support.waiting import free_endpoint, until
from zsched.core.hop.room import OWN, SMALL
from zsched.link.sessions import link_buffers
from zsched.link.sessions.config import data_config
from zsched.link.sessions.link_buffers import LinkBuffers
from zsched.link.sessions.link_sockets import LinkSocket, LinkSockets
from zsched.link.sessions.stalled_links import StalledLinks
from zsched_lab.fleet import netns

WHY_NOT = netns.why_not()
MIB = 1 << 20
PORT = 7458
SO_BUF_LOCK, RCVBUF_LOCKED = 72, 2
LISTENER = """
import sys, zenoh
session = zenoh.open(zenoh.Config.from_json5(sys.argv[1]))
kept = session.declare_subscriber("there", lambda sample: None)
print(flush=True)
sys.stdin.read()
"""
SENDER = """
import sys, zenoh
from zsched.link.sessions.link_buffers import LinkBuffers
from zsched.link.sessions.link_sockets import LinkSockets
from zsched.link.sessions.stalled_links import StalledLinks
session = zenoh.open(zenoh.Config.from_json5(sys.argv[1]))
publisher = session.declare_publisher("there", congestion_control=zenoh.CongestionControl.BLOCK)
stalled = StalledLinks(session, 10.0)
sockets = LinkSockets(session)
print(flush=True)
for line in sys.stdin:
    with stalled:
        publisher.put(bytes(int(line)))
    print(*(link.send_buffer() for link in sockets.links()), flush=True)
"""


def _listener(config: str) -> list[str | Path]:
    return [sys.executable, "-c", LISTENER, config]


@contextlib.contextmanager
def pair(endpoint: str, operator_json5: str = "") -> Iterator[zenoh.Session]:
    """A session that is linked to a listener in another process."""
    listens = data_config(listen=(endpoint,), connect=(), operator_json5=operator_json5, shared_memory=False)
    dials = data_config(listen=(), connect=(endpoint,), operator_json5=operator_json5, shared_memory=False)
    with process(_listener(listens)), zenoh.open(zenoh.Config.from_json5(dials)) as session:
        publisher = session.declare_publisher("there")
        until(lambda: bool(getattr(publisher.matching_status, "matching", False)), "they are linked")
        yield session


def only(sockets: LinkSockets) -> LinkSocket:
    (link,) = sockets.links()
    return link


@pytest.mark.parametrize("protocol", ["tcp", "tls"])
def test_a_fast_receivers_buffer_becomes_the_kernels_own(protocol: str, tmp_path: Path) -> None:
    endpoint, text = free_endpoint(), ""
    if protocol == "tls":
        endpoint = endpoint.replace("tcp/", "tls/")
        settings = json.loads(make_tls(tmp_path).read_text())
        settings["transport"]["link"]["tls"]["verify_name_on_connect"] = False
        text = json.dumps(settings)
    with pair(endpoint, text) as session:
        link, stalled = only(LinkSockets(session)), StalledLinks(session, 10.0)
        assert link.send_buffer() == SMALL
        publisher = session.declare_publisher("there", congestion_control=zenoh.CongestionControl.BLOCK)

        def is_sized_by_the_kernel() -> bool:
            with stalled:
                publisher.put(bytes(MIB))
            return link.send_buffer() == OWN

        until(is_sized_by_the_kernel, "a larger buffer")
        stalled.close()


def test_a_buffer_of_the_operators_own_size_stays() -> None:
    endpoint = f"{free_endpoint().partition('#')[0]}#so_sndbuf=32768"
    with pair(endpoint) as session:
        link, stalled = only(LinkSockets(session)), StalledLinks(session, 10.0)
        publisher = session.declare_publisher("there", congestion_control=zenoh.CongestionControl.BLOCK)
        taken = link.taken()

        def is_all_taken() -> bool:
            with stalled:
                publisher.put(bytes(MIB))
            return link.taken() - taken > 64 * MIB

        until(is_all_taken, "64 MiB are taken")
        assert link.send_buffer() == 32768
        stalled.close()


def test_a_link_that_was_dialled_by_gossip_begins_small_too() -> None:
    """zenoh passes no ``so_sndbuf`` on with an address."""
    with pair(free_endpoint()) as session:
        link = only(LinkSockets(session))
        assert link.set_send_buffer(OWN)
        assert link.send_buffer() == OWN
        buffers = LinkBuffers(session)
        buffers.look()
        assert link.send_buffer() == SMALL


def test_the_receive_buffer_stays_as_the_operator_has_set_it() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server, socket.create_connection(server.getsockname()) as ours:
        ours.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 20_000)
        ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SMALL)
        link = LinkSocket("zid", (ours.getsockname(), ours.getpeername()), ours.fileno())
        assert link.set_send_buffer(OWN)
        assert link.send_buffer() == OWN
        assert ours.getsockopt(socket.SOL_SOCKET, SO_BUF_LOCK) == RCVBUF_LOCKED


def test_links_that_carry_nothing_are_looked_at_once_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    now, looks = 100.0, list[float]()

    def links() -> tuple[zenoh.Link, ...]:
        looks.append(now)
        return ()

    monkeypatch.setattr(link_buffers, "monotonic_s", lambda: now)
    buffers = LinkBuffers(cast("zenoh.Session", SimpleNamespace(info=SimpleNamespace(links=links))))
    for is_still, count in ((True, 10), (False, 25)):
        looks.clear()
        for _ in range(50):
            now += 0.2
            buffers.look(is_still=is_still)
        assert len(looks) == count
    now += 0.3
    looks.clear()
    buffers.look(is_still=True)
    assert not looks
    buffers.look()
    assert looks == [now], "what begins to flow is seen as soon as before"


def test_a_session_that_rests_is_not_looked_at_by_anybody() -> None:
    with pair(free_endpoint()) as session:
        stalled = StalledLinks(session, 10.0)
        looks: list[None] = []
        stalled.buffers.look = lambda **_: looks.append(None)  # type: ignore[method-assign]
        with stalled:
            session.put("there", b"x")
        until(lambda: bool(looks), "a look while something is put")
        until(lambda: stalled.is_resting, "the thread rests")
        count = len(looks)
        with contextlib.suppress(AssertionError):
            until(lambda: len(looks) > count, "another look", 1.0)
        assert len(looks) == count
        stalled.close()


@pytest.mark.skipif(WHY_NOT is not None, reason=f"no namespaces: {WHY_NOT}")
@pytest.mark.root
def test_before_a_thin_radio_it_stays_small_grows_when_the_radio_widens_and_shrinks_when_it_narrows() -> None:
    with netns.Network(("edge1", "robot1")) as network:
        endpoint = f"tcp/{network.address('edge1')}:{PORT}"
        listens = data_config(listen=(endpoint,), connect=(), shared_memory=False)
        dials = data_config(listen=(), connect=(endpoint,), shared_memory=False)
        network.narrow("robot1", 20.0)
        there = network.wrap("edge1", _listener(listens))
        here = network.wrap("robot1", [sys.executable, "-c", SENDER, dials])
        with process(there), process(here) as put:
            until(lambda: put("100") == str(SMALL), "they are linked")
            thin = [put(str(MIB)) for _ in range(8)]  # 0.4 s each
            assert set(thin) <= {str(SMALL), str(2 * SMALL)}
            assert thin[-1] == str(SMALL)
            network.narrow("robot1", None)
            until(lambda: put(str(MIB)) == str(OWN), "the buffer of a fast link", 20.0)
            network.narrow("robot1", 20.0)
            put(str(4 * MIB))
            assert put(str(MIB)) == str(SMALL)
