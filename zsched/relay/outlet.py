"""Puts a stream's samples on under their new key: the publishers of one stream towards one place.

Knows: zenoh publishers, the three classes, what of a sample must be kept. Does not know: slots, epochs, when to switch.

Payloads are passed on as they came (reference counted, never turned into ``bytes``), with encoding, attachment,
timestamp, kind, priority and express. The source info becomes the publisher's own, numbered from 0 without a gap: that
number is what the next hop checks. ``reliable`` has a queue and a thread of its own, so that only this target waits
when its receiver stalls; the other classes never block.

Advanced publishers (``latest``) have a cache and numbers, but no heartbeat: towards a frozen receiver a heartbeat
blocks zenoh's own runtime (tokens and samples of every other peer came more than 0.3 s late) and makes ``undeclare``
hold Python's global lock until the receiver's lease ends (measured with zenoh 1.10.2: 4 s of an 8 s lease). What a
heartbeat is for, a lost *newest* value, is mended by putting it once more (`InputStream.repeat_if_silent`).
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from dataclasses import dataclass, field
from typing import Final

import zenoh
from zenoh import CongestionControl, Priority, Reliability, Sample, SampleKind, Session, ext

from zsched.core.keyexpr import is_wild
from zsched.core.plan import StreamClass, StreamSettings
from zsched.core.relay_protocol import EndMarker
from zsched.keyspace import END_CHUNK
from zsched.relay.receive import undeclare
from zsched.relay.rewrite import rewriter
from zsched.relay_pipe import encode_end

QUEUE_BYTES: Final = 64 << 20
"""Bound of a reliable outlet's queue beside its depth."""
QUEUE_DEPTH: Final = 1024
"""A reliable outlet's queue holds at least so many samples, whatever its depth says."""

_log = logging.getLogger("zsched.relay")

_CONGESTION: Final = {
    StreamClass.BEST_EFFORT: CongestionControl.DROP,
    StreamClass.LATEST: CongestionControl.BLOCK_FIRST,
    StreamClass.RELIABLE: CongestionControl.BLOCK,
}


@dataclass(slots=True, eq=False)
class _Lane:
    """One publisher: a concrete key with one priority and express flag."""

    key: str
    publisher: zenoh.Publisher | ext.AdvancedPublisher
    source_id: zenoh.EntityGlobalId
    count: int = 0

    def put(self, sample: Sample) -> None:
        if isinstance(self.publisher, zenoh.Publisher):
            self._put_numbered(self.publisher, sample)
        elif sample.kind == SampleKind.DELETE:
            self.publisher.delete(attachment=sample.attachment, timestamp=sample.timestamp)
        else:
            self.publisher.put(
                sample.payload,
                encoding=sample.encoding,
                attachment=sample.attachment,
                timestamp=sample.timestamp,
            )
        self.count += 1

    def _put_numbered(self, publisher: zenoh.Publisher, sample: Sample) -> None:
        source = zenoh.SourceInfo(self.source_id, self.count)
        if sample.kind == SampleKind.DELETE:
            publisher.delete(attachment=sample.attachment, timestamp=sample.timestamp, source_info=source)
            return
        publisher.put(
            sample.payload,
            encoding=sample.encoding,
            attachment=sample.attachment,
            timestamp=sample.timestamp,
            source_info=source,
        )


@dataclass(slots=True)
class _Queue:
    """What waits for a reliable outlet's thread."""

    items: deque[tuple[_Lane, Sample] | EndMarker] = field(default_factory=deque)
    size: int = 0
    wake: threading.Condition = field(default_factory=threading.Condition)
    is_closed: bool = False


class Outlet:
    """The way of one stream to one place; used by one thread at a time (its stream's lock)."""

    def __init__(self, session: Session, from_expr: str, to_expr: str, settings: StreamSettings) -> None:
        """Declare the publishers.

        Raises:
            ValueError: ``to_expr`` cannot be filled from ``from_expr``.
            zenoh.ZError: an expression is none.
        """
        self._session = session
        self._settings = settings
        self._rewrite = rewriter(from_expr, to_expr)
        self._is_wild = is_wild(to_expr)
        self._to = to_expr
        self._lanes: dict[tuple[str, str], _Lane] = {}
        self._probe = session.declare_publisher(to_expr)
        self._main = None if self._is_wild else self._declare(to_expr, Priority.DATA, is_express=False)
        self._queue: _Queue | None = None
        if settings.stream_class is StreamClass.RELIABLE:
            self._queue = _Queue()
            threading.Thread(target=self._run_queue, name=f"to {to_expr}", daemon=True).start()

    @property
    def is_matching(self) -> bool:
        """True when somebody subscribes to where this outlet leads (it may be a zombie or a recorder)."""
        status = self._probe.matching_status
        return bool(getattr(status, "matching", False))  # the object itself is always true

    def send(self, sample: Sample) -> str:
        """Put one sample; answers why it was dropped (``""``: it was not)."""
        lane = self._lane(sample)
        if lane is None:
            return "no_key"
        if self._queue is not None:
            return self._enqueue(self._queue, lane, sample)
        try:
            lane.put(sample)
        except zenoh.ZError:
            return "error"
        return ""

    def send_end(self, epoch: int) -> None:
        """Put the end marker behind the last sample of every key; blocks while the target's link is full."""
        if self._queue is None:
            self._put_ends(epoch)
            return
        with self._queue.wake:
            self._queue.items.append(EndMarker(epoch=epoch, count=0))
            self._queue.wake.notify()

    def undeclare(self) -> int:
        """Give the publishers back (a reliable queue's thread its own); answers how many samples still waited."""
        if self._queue is None:
            self._undeclare()
            return 0
        with self._queue.wake:
            self._queue.is_closed = True
            self._queue.wake.notify()
            return sum(not isinstance(item, EndMarker) for item in self._queue.items)

    # --- lanes -------------------------------------------------------------------------------------------------------

    def _lane(self, sample: Sample) -> _Lane | None:
        priority, is_express = sample.priority, sample.express
        if self._main is not None and priority == Priority.DATA and not is_express:
            return self._main
        key = self._rewrite(str(sample.key_expr)) if self._is_wild else self._to
        if key is None:
            return None
        name = (key, f"{priority}{is_express}")
        lane = self._lanes.get(name)
        return lane if lane is not None else self._declare(key, priority, is_express=is_express)

    def _declare(self, key: str, priority: Priority, *, is_express: bool) -> _Lane:
        stream_class = self._settings.stream_class
        congestion = _CONGESTION[stream_class]
        publisher: zenoh.Publisher | ext.AdvancedPublisher
        if stream_class is StreamClass.LATEST:
            publisher = ext.declare_advanced_publisher(
                self._session,
                key,
                congestion_control=congestion,
                priority=priority,
                express=is_express,
                reliability=Reliability.RELIABLE,
                cache=ext.CacheConfig(max(1, self._settings.keep_last)),
                sample_miss_detection=ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=None),
                publisher_detection=True,
            )
        else:
            is_reliable = stream_class is StreamClass.RELIABLE
            publisher = self._session.declare_publisher(
                key,
                congestion_control=congestion,
                priority=priority,
                express=is_express,
                reliability=Reliability.RELIABLE if is_reliable else Reliability.BEST_EFFORT,
            )
        lane = _Lane(key=key, publisher=publisher, source_id=publisher.id)
        self._lanes[key, f"{priority}{is_express}"] = lane
        return lane

    def _put_ends(self, epoch: int) -> None:
        for lane in tuple(self._lanes.values()):
            payload = encode_end(EndMarker(epoch=epoch, count=lane.count))
            self._session.put(
                f"{lane.key}/{END_CHUNK}",
                payload,
                congestion_control=CongestionControl.BLOCK,
                priority=lane.publisher.priority,
                source_info=zenoh.SourceInfo(lane.source_id, lane.count),
            )

    def _undeclare(self) -> None:
        try:
            for lane in self._lanes.values():
                undeclare(lane.publisher)
            undeclare(self._probe)
        except zenoh.ZError:
            _log.debug("%s: the session closed first", self._to)

    # --- the queue of class reliable ---------------------------------------------------------------------------------

    def _enqueue(self, queue: _Queue, lane: _Lane, sample: Sample) -> str:
        with queue.wake:
            if len(queue.items) >= max(self._settings.depth, QUEUE_DEPTH) or queue.size > QUEUE_BYTES:
                return "overflow"
            queue.items.append((lane, sample))
            queue.size += len(sample.payload)
            queue.wake.notify()
        return ""

    def _run_queue(self) -> None:
        queue = self._queue
        assert queue is not None
        while True:
            with queue.wake:
                while not queue.items and not queue.is_closed:
                    queue.wake.wait()
                if queue.is_closed:
                    break
                item = queue.items.popleft()
                if not isinstance(item, EndMarker):
                    queue.size -= len(item[1].payload)
            self._put_queued(item)
        self._undeclare()

    def _put_queued(self, item: tuple[_Lane, Sample] | EndMarker) -> None:
        try:
            if isinstance(item, EndMarker):
                self._put_ends(item.epoch)
            else:
                item[0].put(item[1])
        except zenoh.ZError as error:
            _log.warning("%s: a sample could not be put (%s)", self._to, error)
