"""Real links: what TCP waits before it sends again is set at both ends, and only there."""

from __future__ import annotations

import contextlib
import os
import resource
import socket
from collections.abc import Iterator
from pathlib import Path

import zenoh

from support.waiting import free_endpoint, until
from zsched.link.sessions.config import control_config, data_config
from zsched.link.sessions.link_buffers import LinkBuffers
from zsched.link.sessions.link_retries import LinkRetries
from zsched.link.sessions.link_sockets import LinkSockets, retry_steadily

THIN_LINEAR_TIMEOUTS, NO_DELAY = 16, 1


@contextlib.contextmanager
def pair() -> Iterator[tuple[zenoh.Session, zenoh.Session]]:
    """One that listens and one that has dialled it."""
    endpoint = free_endpoint()
    with (
        zenoh.open(zenoh.Config.from_json5(control_config(listen=(endpoint,), connect=()))) as there,
        zenoh.open(zenoh.Config.from_json5(control_config(listen=(), connect=(endpoint,)))) as here,
    ):
        until(lambda: there.info.links() and here.info.links(), "a link")
        yield there, here


def settings(session: zenoh.Session) -> list[tuple[int, str]]:
    """(equal waits, congestion control) of each link."""
    found = []
    for link in LinkSockets(session).links():
        held = socket.socket(fileno=link.fd)
        try:
            control = held.getsockopt(socket.IPPROTO_TCP, socket.TCP_CONGESTION, 16).rstrip(b"\0").decode()
            found.append((held.getsockopt(socket.IPPROTO_TCP, THIN_LINEAR_TIMEOUTS), control))
        finally:
            held.detach()
    return found


def test_links_from_before_and_from_now_on_have_equal_waits() -> None:
    with pair() as (there, here):
        before = settings(there) + settings(here)
        assert [waits for waits, _ in before] == [0, 0]
        for session in (there, here):
            retries = LinkRetries(session)

            def has_equal_waits(retries: LinkRetries = retries, session: zenoh.Session = session) -> bool:
                retries.look()
                return settings(session) == [(1, "reno")]

            until(has_equal_waits, "equal waits")


@contextlib.contextmanager
def no_descriptor_left() -> Iterator[None]:
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    taken: list[int] = []
    highest = max(int(path.name) for path in Path("/proc/self/fd").iterdir())
    resource.setrlimit(resource.RLIMIT_NOFILE, (highest + 2, before[1]))
    try:
        with contextlib.suppress(OSError):
            while True:
                taken.append(os.open("/dev/null", os.O_RDONLY))
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)
        for descriptor in taken:
            os.close(descriptor)


def test_a_link_that_takes_the_last_descriptor_is_found_once_there_are_others() -> None:
    """The decision loop looks, and so does the thread that ends strangers' links: neither may end by it."""
    with pair() as (there, _here):
        retries, sockets = LinkRetries(there), LinkSockets(there)
        until(lambda: bool(retries._new), "word of the link")
        with no_descriptor_left():
            retries.look()
            assert sockets.links() == ()
        assert len(sockets.links()) == 1
        retries.look()
        assert settings(there) == [(1, "reno")]


def test_a_link_that_carries_streams_keeps_its_congestion_control() -> None:
    endpoint = free_endpoint()
    with (
        zenoh.open(zenoh.Config.from_json5(data_config(listen=(endpoint,), connect=()))) as there,
        zenoh.open(zenoh.Config.from_json5(data_config(listen=(), connect=(endpoint,)))) as here,
    ):
        until(lambda: there.info.links() and here.info.links(), "a link")
        ((_, control),) = settings(here)
        LinkBuffers(here).look(at_once=True)
        assert settings(here) == [(1, control)]


def test_other_sockets_of_the_process_are_left_alone() -> None:
    with socket.create_server(("127.0.0.1", 0)) as door, socket.create_connection(door.getsockname()) as other:
        assert retry_steadily([(("127.0.0.1", 9), ("127.0.0.1", 9))]) == 0
        assert other.getsockopt(socket.IPPROTO_TCP, THIN_LINEAR_TIMEOUTS) == 0
        assert retry_steadily([(other.getsockname(), other.getpeername())]) == 1
        assert other.getsockopt(socket.IPPROTO_TCP, THIN_LINEAR_TIMEOUTS) == 1
