"""Ends the link that a put waits for when its receiver takes nothing at all: the others wait for it behind that put.

Knows: which puts are under way, whose socket has no room (`zsched.link.sessions.link_sockets`), zenoh's lease. Does not
know: what is put.

A put that must not lose anything (congestion control BLOCK) goes to one receiver after the other, and for a frozen one
it waits. zenoh ends a link whose lease is over; but it first takes back what is queued for it, for which it waits until
that put has given up: 5 s, longer with every fragment of a large sample, and on when the receiver is awake again
(1.10). A link that ends while its lease still holds lets the put go at once. So the link is ended here, before. What it
held is not lost: it is kept until it is acknowledged, and sent again.

While anything is put, its thread also sizes the links' send buffers (`zsched.link.sessions.link_buffers`).
"""

from __future__ import annotations

import contextlib
import logging
import math
import threading
from typing import Final

from zenoh import Session, ZError

from zsched.host.clock import monotonic_s
from zsched.host.guard import guarded
from zsched.link.sessions.link_buffers import LinkBuffers
from zsched.link.sessions.link_sockets import LinkSocket, LinkSockets, with_room

SILENT_RATIO: Final = 0.7
"""A receiver that has no room, and was not heard for this share of the lease, is frozen, or its link is dead."""
TICK_S: Final = 0.1
QUICK_TICK_S: Final = 0.05
"""While a put is under way."""
REST_S: Final = 2.0
"""Nothing was put for this long: the thread rests."""

_log = logging.getLogger("zsched.streams")


class StalledLinks(contextlib.AbstractContextManager[None]):
    """The links of one session. ``with`` it around every put that may wait (any thread, not nested)."""

    def __init__(self, session: Session, lease_s: float, full_s: float = math.inf) -> None:
        """The thread starts with the first put. ``lease_s`` is zenoh's, on these links.

        ``full_s``: a receiver that is heard, and takes nothing for this long while a put waits, is stalled, too.
        """
        self._full_s = full_s
        self._sockets = LinkSockets(session)
        self.buffers = LinkBuffers(session)
        """Of the same links."""
        self._silent_s = SILENT_RATIO * lease_s
        self._puts: dict[int, float] = {}
        """{thread: since when it puts}."""
        self._full: dict[LinkSocket, tuple[int, float]] = {}
        """{whose socket has no room: (how much it has taken, since when that much)}."""
        self._wake = threading.Event()
        self._closed = threading.Event()
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self.ended = 0
        """Links that were ended."""

    def __enter__(self) -> None:
        self._puts[threading.get_ident()] = monotonic_s()
        if not self._wake.is_set():
            self._begin()

    def __exit__(self, *_: object) -> None:
        self._puts.pop(threading.get_ident(), None)

    @property
    def is_resting(self) -> bool:
        """Whether nothing was put for a while, so that nobody looks."""
        return not self._wake.is_set()

    def close(self) -> None:
        """End the thread."""
        self._closed.set()
        self._wake.set()

    def _begin(self) -> None:
        with self._lock:
            if self._thread is None:
                thread = guarded(self._run, name="zsched stalled links")
                try:
                    thread.start()
                except RuntimeError:  # no thread is to be had: a put goes on without, and the next one tries again
                    return
                self._thread = thread
            self._wake.set()

    def _run(self) -> None:
        busy_at = monotonic_s()
        while not self._closed.wait(QUICK_TICK_S if self._puts else TICK_S):
            now = monotonic_s()
            if self._puts:
                busy_at = now
            elif now - busy_at > REST_S:
                self._rest()
                busy_at = monotonic_s()
            self.buffers.look()
            self._look(now)

    def _rest(self) -> None:
        self._wake.clear()
        if not self._puts:  # one that begins from here on sees that we rest
            self._wake.wait()
        self._wake.set()

    def _look(self, now: float) -> None:
        since = min(tuple(self._puts.values()), default=now)
        if now - since < QUICK_TICK_S:
            self._full.clear()
            return
        try:
            links = self._sockets.links()
        except ZError:
            return  # the session closes, and a put still waits
        ready = with_room(links, 0.0)
        before, self._full = self._full, {}
        for link in links:
            if link.fd in ready:
                continue
            taken = link.taken()
            has_taken, at = before.get(link, (-1, now))
            self._full[link] = (taken, at if taken == has_taken else now)
            is_stalled = link.silent_s() >= self._silent_s or now - self._full[link][1] >= self._full_s
            if is_stalled and link.abort():  # zenoh would read what has come under other keys, once the link is back
                self.ended += 1
                _log.warning("%s takes nothing: its link is ended", link.name)
