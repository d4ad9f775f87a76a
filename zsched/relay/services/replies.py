"""Asks once and hands the replies over one by one: until the end, the deadline, or somebody says stop.

Knows: queries of zenoh, their end. Does not know: what a reply means.

Replies enter by a callback in zenoh's own thread that only enqueues: a channel would stop that thread (and with it
every other link of the process) as soon as a slow asker leaves it full.
"""

from __future__ import annotations

import queue
from collections.abc import Iterator
from typing import Any, Final

import zenoh
from zenoh import Reply, Session

from zsched.host.clock import monotonic_s
from zsched.host.guard import tolerant

MAX_WAITING: Final = 1024
"""Replies that may wait for a slow asker; further ones are dropped, and `Replies.has_overflowed` says so."""


class Replies:
    """The replies to one request. `send` once, iterate once, in one thread; `stop` may be called from any."""

    def __init__(self, timeout_s: float) -> None:
        self.is_stopped = False
        self.has_timed_out = False
        self.has_overflowed = False
        self._until = monotonic_s() + timeout_s
        self._waiting: queue.SimpleQueue[Reply | None] = queue.SimpleQueue()
        self._token = zenoh.CancellationToken()

    def send(self, session: Session, selector: zenoh.Selector, **request: Any) -> None:
        """Send the request; may block while the link to its target is full.

        ``request``: payload, encoding, attachment, as `zenoh.Session.get` takes them.

        Raises:
            zenoh.ZError: the session is closed.
        """
        left_s = max(0.0, self._until - monotonic_s())
        session.get(
            selector,
            zenoh.handlers.Callback(tolerant(self._take, "answer"), lambda: self._waiting.put(None), indirect=False),
            timeout=left_s + 1.0,  # ours comes first, and needs no telling from an owner's own "Timeout"
            consolidation=zenoh.ConsolidationMode.NONE,
            allowed_destination=zenoh.Locality.REMOTE,
            cancellation_token=self._token,
            **request,
        )

    def stop(self) -> None:
        """End the iteration behind what has come; never blocks."""
        self.is_stopped = True
        self._waiting.put(None)

    def __iter__(self) -> Iterator[Reply]:
        while True:
            try:
                reply = self._waiting.get(timeout=max(0.0, self._until - monotonic_s()))
            except queue.Empty:
                self.has_timed_out = True
                reply = None
            if reply is None:
                self._token.cancel()
                return
            yield reply

    def _take(self, reply: Reply) -> None:
        if self._waiting.qsize() < MAX_WAITING:
            self._waiting.put(reply)
        else:
            self.has_overflowed = True
