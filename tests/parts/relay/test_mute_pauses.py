"""Which links are ended while a machine's worker is missed, and how often: on real connections, by a given time."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Iterator

import pytest

from support.sessions import hub_and_neighbour
from support.waiting import until
from zsched.core.values.model import NodeId
from zsched.link.keyspace import Keyspace
from zsched.link.sessions.link_sockets import LinkSocket
from zsched.relay.mute_links import QUIET_BYTES, MuteLinks

MISSED = frozenset({NodeId("edge1")})


class Link:
    """A worker's, which it dials again when it ends."""

    def __init__(self, server: socket.socket) -> None:
        self._server = server
        self.ends = 0
        self._dial()

    def _dial(self) -> None:
        self.theirs = socket.create_connection(self._server.getsockname())
        self.ours, _ = self._server.accept()
        self.theirs.setblocking(False)
        self.socket = LinkSocket("1", (self.ours.getsockname(), self.ours.getpeername()), self.ours.fileno())

    def brings(self, count: int) -> None:
        at = self.socket.brought()
        self.theirs.sendall(bytes(count))
        until(lambda: self.socket.brought() >= at + count, "what it brings")

    def is_sent(self, count: int) -> None:
        at = self.socket.taken()
        self.ours.sendall(bytes(count))
        until(lambda: self.socket.taken() >= at + count, "what it takes")

    def heed(self) -> None:
        """Dial again if it was ended."""
        with contextlib.suppress(BlockingIOError):
            while self.theirs.recv(1 << 16):
                pass
            self.ends += 1
            self.close()
            self._dial()

    def close(self) -> None:
        self.theirs.close()
        self.ours.close()


@pytest.fixture
def link() -> Iterator[Link]:
    with socket.create_server(("127.0.0.1", 0)) as server:
        made = Link(server)
        yield made
        made.close()


@pytest.fixture
def mute(link: Link, monkeypatch: pytest.MonkeyPatch) -> Iterator[MuteLinks]:
    with hub_and_neighbour() as (session, _):
        made = MuteLinks(session, Keyspace("hall"))
        monkeypatch.setattr(made, "_of_workers", lambda _: [link.socket])
        yield made


def test_pauses_grow_while_a_worker_is_missed_also_over_busy_seconds(link: Link, mute: MuteLinks) -> None:
    """A task whose only worker has failed is missed for hours: another worker's links are not ended all the time."""
    for second in range(120):
        if second % 5 == 0:
            link.brings(2 * QUIET_BYTES)
        mute.look(MISSED, float(second))
        link.heed()
    assert 3 <= link.ends <= 7
    mute.look(frozenset(), 120.0)
    ends = link.ends
    for second in range(121, 126):
        mute.look(MISSED, float(second))
        link.heed()
    assert link.ends > ends, "who is missed anew is helped soon"


def test_one_that_only_receives_keeps_its_link_while_samples_go_to_it(link: Link, mute: MuteLinks) -> None:
    for second in range(20):
        link.is_sent(2 * QUIET_BYTES)
        mute.look(MISSED, float(second))
        link.heed()
    assert link.ends == 0
