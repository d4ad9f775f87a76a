"""Receives one key expression in a thread of its own: the only way samples enter the relay.

Knows: zenoh subscribers, ring and fifo handlers. Does not know: what becomes of a sample.

Never callbacks that work: a slow one blocks zenoh's receive pool and with it every other link of the process.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Any, Final, Protocol

import zenoh
from zenoh import Sample, Session

from zsched.core.plan import StreamClass, StreamSettings
from zsched.guard import guarded
from zsched.relay.history import History

JOIN_S: Final = 0.3

_log = logging.getLogger("zsched.relay")


class Declared(Protocol):
    """Anything declared on a session."""

    def undeclare(self) -> Any:
        """Take it back."""


def undeclare(entity: Declared) -> None:
    """Take a declaration back (zenoh's stubs leave the method untyped)."""
    entity.undeclare()


class Receiver:
    """A subscriber and the thread that drains it into ``carry``."""

    def __init__(
        self,
        session: Session,
        expr: str,
        settings: StreamSettings,
        carry: Callable[[Sample], None],
        *,
        with_history: bool,
        origin: zenoh.Locality = zenoh.Locality.REMOTE,
    ) -> None:
        """Subscribe and start; by default without what ``session`` itself puts (``origin``).

        ``with_history`` asks the publishers of class ``latest`` for what they still hold; wrong where a key outlives
        an owner's epoch (the old epoch's value would come back as the new one's).

        Raises:
            zenoh.ZError: ``expr`` is no key expression.
        """
        is_latest = settings.stream_class is StreamClass.LATEST
        self._history: History | None = None
        if with_history and is_latest and settings.keep_last:
            self._history = History(session, expr, settings.keep_last, carry, origin)
        self._carry = carry if self._history is None else self._history.live
        self._subscriber = _subscribe(session, expr, settings, origin)
        self._handler = self._subscriber.handler  # the thread's own: undeclare() refuses while recv() borrows
        self._thread = guarded(self._run, name=f"from {expr}", kind="from")
        self._thread.start()
        if self._history is not None:
            self._history.start()

    def close(self) -> None:
        """Unsubscribe; the thread ends behind what it has in hand."""
        undeclare(self._subscriber)
        if self._history is not None:
            self._history.close()
        if self._thread is not threading.current_thread():
            self._thread.join(JOIN_S)

    def _run(self) -> None:
        for sample in self._handler:
            try:
                self._carry(sample)
            except Exception:  # noqa: BLE001 - one bad sample must not end its stream
                _log.exception("%s: a sample could not be carried", sample.key_expr)


_Subscriber = zenoh.Subscriber[zenoh.handlers.Handler[Sample]]


def _subscribe(session: Session, expr: str, settings: StreamSettings, origin: zenoh.Locality) -> _Subscriber:
    if settings.stream_class is StreamClass.RELIABLE:
        fifo: zenoh.handlers.FifoChannel[Sample] = zenoh.handlers.FifoChannel(max(settings.depth, 256))
        return session.declare_subscriber(expr, fifo, allowed_origin=origin)
    ring: zenoh.handlers.RingChannel[Sample] = zenoh.handlers.RingChannel(settings.depth)
    return session.declare_subscriber(expr, ring, allowed_origin=origin)
