"""Receives one key expression in a thread of its own: the only way samples enter the relay.

Knows: zenoh subscribers, ring and fifo handlers. Does not know: what becomes of a sample.

Never callbacks that work: a slow one blocks zenoh's receive pool and with it every other link of the process.

Nothing is lost in here that nobody counts: zenoh's ring channel drops without a word, so no class has one. A full
queue makes zenoh's thread wait, the publisher's link in the end, until ours takes the next sample. The puts of class
``best_effort`` are the only ones that may wait in our thread (zenoh gives a full link 1 to 50 ms): behind such a put
the oldest give way, and the stream hears of each.
"""

from __future__ import annotations

import contextlib
import logging
import threading
from collections import deque
from collections.abc import Callable
from typing import Any, Final, Protocol

import zenoh
from zenoh import Sample, Session

from zsched.core.route.ros2 import BUFFERS, has_buffers_beside
from zsched.core.values.plan import StreamClass, StreamSettings
from zsched.host.clock import awake_s
from zsched.host.guard import guarded, tolerant
from zsched.relay.streams.given import under
from zsched.relay.streams.history import HeldValues
from zsched.relay.streams.places import PublisherId

JOIN_S: Final = 0.3
REST_S: Final = 2.0
"""What a thread has in its queue is counted within this time, once nothing holds it up."""
QUEUE_DEPTH: Final = 256
"""Samples that zenoh's thread can leave for ours without waiting, at least; also as many as we take in one go."""
BEHIND_S: Final = 0.01
"""Class ``best_effort``: a thread that puts for this long without looking at newer samples waits for a link."""

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
        give_way: Callable[[Sample], None],
        origin: zenoh.Locality = zenoh.Locality.REMOTE,
    ) -> None:
        """Subscribe and start; by default without what ``session`` itself puts (``origin``).

        ``give_way`` hears of a sample of class ``best_effort`` that is not carried, since newer ones wait (our
        thread, as ``carry``).
        ``with_history`` asks the publishers of class ``latest`` for what they still hold; wrong where a key outlives
        an owner's epoch (the old epoch's value would come back as the new one's).

        Raises:
            zenoh.ZError: ``expr`` is no key expression.
            RuntimeError: no thread is to be had; nothing is subscribed to.
        """
        is_latest = settings.stream_class is StreamClass.LATEST
        self._history: HeldValues | None = None
        if is_latest and settings.keep_last:
            self._history = HeldValues(session, expr, settings.keep_last, carry, origin, asks=with_history)
        self._carry = self._history.live if self._history is not None and with_history else carry
        self._depth, self._give_way = settings.depth, give_way
        self._ended = threading.Event()
        self._subscriber: Declared
        if settings.stream_class is StreamClass.BEST_EFFORT or settings.depth > QUEUE_DEPTH:
            self._drain(_subscribe(session, expr, settings, origin), expr, settings)
        else:
            # zenoh's own thread sleeps until a sample comes; one that waits at a handler wakes up ten times a second
            take = zenoh.handlers.Callback(tolerant(self._carry, "from"), self._ended.set)
            self._subscriber = session.declare_subscriber(expr, take, allowed_origin=origin)
        self._beside: Receiver | None = None
        try:
            if self._history is not None:
                self._history.start()
            if has_buffers_beside(settings.graph, expr):
                self._beside = Receiver(
                    session,
                    expr + BUFFERS,
                    settings,
                    lambda sample: self._carry(under(str(sample.key_expr).removesuffix(BUFFERS), sample)),
                    with_history=False,
                    give_way=give_way,
                    origin=origin,
                )
        except RuntimeError:
            self.close()
            raise

    def is_there(self, publisher: PublisherId) -> bool | None:
        """Whether a publisher with a cache (class ``latest``) shows its token; ``None``: it never has."""
        return None if self._history is None else self._history.is_there(publisher)

    def close(self) -> None:
        """Unsubscribe; the thread ends behind what it has in hand."""
        if self._beside is not None:
            self._beside.close()
        undeclare(self._subscriber)
        if self._history is not None:
            self._history.close()
        self._ended.wait(JOIN_S)

    def wait(self) -> None:
        """Behind `close`, when nothing holds up ``carry`` any more: wait until the last sample has been given to it."""
        self._ended.wait(REST_S)
        if self._beside is not None:
            self._beside.wait()

    def _drain(self, subscriber: _Subscriber, expr: str, settings: StreamSettings) -> None:
        """Start a thread of our own for what zenoh's queue holds."""
        self._subscriber = subscriber
        self._handler = subscriber.handler  # the thread's own: undeclare() refuses while recv() borrows
        carry = self._carry_newest if settings.stream_class is StreamClass.BEST_EFFORT else self._carry_all
        try:
            guarded(carry, name=f"from {expr}", kind="from").start()
        except RuntimeError:
            undeclare(subscriber)
            raise

    def _carry_all(self) -> None:
        for sample in self._handler:
            self._carry_one(sample)
        self._ended.set()

    def _carry_newest(self) -> None:
        waiting: deque[Sample] = deque()
        for first in self._handler:
            waiting.append(first)
            while waiting:
                self._take(waiting)
                if self._is_behind(waiting):
                    self._take(waiting)
                    while len(waiting) > self._depth:
                        self._give_way(waiting.popleft())
        self._ended.set()

    def _is_behind(self, waiting: deque[Sample]) -> bool:
        """Carry one sample at least, and all that wait unless that takes too long: then newer ones may have come."""
        until = awake_s() + BEHIND_S
        self._carry_one(waiting.popleft())
        while (is_in_time := awake_s() < until) and waiting:
            self._carry_one(waiting.popleft())
        return not is_in_time

    def _carry_one(self, sample: Sample) -> None:
        try:
            self._carry(sample)
        except Exception:  # noqa: BLE001 - one bad sample must not end its stream
            _log.exception("%s: a sample could not be carried", sample.key_expr)

    def _take(self, waiting: deque[Sample]) -> None:
        """What has come meanwhile: one look at it costs less than one waiting for each."""
        with contextlib.suppress(zenoh.ZError):  # unsubscribed: the loop over the handler ends, too
            for _ in range(QUEUE_DEPTH):
                if (sample := self._handler.try_recv()) is None:
                    break
                waiting.append(sample)


_Subscriber = zenoh.Subscriber[zenoh.handlers.Handler[Sample]]


def _subscribe(session: Session, expr: str, settings: StreamSettings, origin: zenoh.Locality) -> _Subscriber:
    fifo: zenoh.handlers.FifoChannel[Sample] = zenoh.handlers.FifoChannel(max(settings.depth, QUEUE_DEPTH))
    return session.declare_subscriber(expr, fifo, allowed_origin=origin)
