"""One output of a worker: stamped with the epoch, numbered, ended by a marker.

Knows: publishers per epoch, how many samples went out. Does not know: roles (it asks for the epoch), inputs, which
answers have arrived (`zsched.worker.keep`).
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, Final

import zenoh
from zenoh import CongestionControl, ext

from zsched.core.hop.serial import serial_of
from zsched.core.values.relay_protocol import EndMarker
from zsched.core.values.struct import Struct
from zsched.link.sessions.puts import Payload, PutArguments, put_arguments
from zsched.link.sessions.send_queue import SendQueue
from zsched.link.weight import weight_of
from zsched.worker.keep import Keeper, KeptLane, put_end

LATEST_DEPTH: Final = 16
"""Values of class ``latest`` that may wait for a receiver that keeps up; behind a stalled one, ``keep_last`` do."""
OUTPUT_DEPTH: Final = 4096
"""Answers of class ``reliable`` that an output keeps at most until they are acknowledged."""
RECEIVE_BUFFER: Final = 1 << 16
"""Bytes of zenoh's batches (``transport/link/rx/buffer_size``); what is larger has come in several, and has its own."""
KEPT_EPOCHS: Final = 2
"""Publishers of older epochs are given back once they have ended: nobody admits them any more."""


class OutputOptions(Struct, frozen=True, kw_only=True):
    """What `Worker.publisher` is asked for."""

    latest: bool = False
    """Whether the last value is kept for late subscribers."""
    reliable: bool = False
    keep_last: int = 1
    depth: int = OUTPUT_DEPTH

    def __post_init__(self) -> None:
        if self.latest and self.reliable:
            raise ValueError("an output is either latest or reliable")
        for name, value in (("keep_last", self.keep_last), ("depth", self.depth)):
            if value < 1:
                raise ValueError(f"{name}: {value!r} is not 1 or more")


class _Stamped(Struct, eq=False):
    """The publisher of one epoch."""

    key: str
    publisher: zenoh.Publisher | ext.AdvancedPublisher
    lane: KeptLane | None
    """Of what is kept until the robots' relays have it (classes ``latest`` and ``reliable``)."""
    unkept: int = 0
    """Samples put so far that are not kept."""
    has_ended: bool = False
    """The end marker is behind its last sample."""

    @property
    def count(self) -> int:
        """Samples put so far, and the number of the next one."""
        return self.unkept if self.lane is None else self.lane.state.count


class Output:
    """An output declared with `Worker.publisher`; `put` may be called from any thread."""

    def __init__(
        self,
        session: zenoh.Session,
        template: str,
        options: OutputOptions,
        *,
        keeper: Keeper,
        epoch_now: Callable[[], int | None],
        stamp_now: Callable[[], zenoh.Timestamp | None],
        owe: Callable[[KeptLane, int], None],
    ) -> None:
        """``owe`` hears of an answer of class ``reliable`` before it is put: (its lane, its number)."""
        self._session = session
        self._template = template
        self.options = options
        is_kept = options.latest or options.reliable
        self._keeper = keeper if is_kept else None
        self._stalled = keeper.stalled
        self._congestion = CongestionControl.BLOCK if is_kept else CongestionControl.DROP
        self._epoch_now = epoch_now
        self._stamp_now = stamp_now
        self._owe = owe
        self._lock = threading.Lock()
        self._epochs: dict[int, _Stamped] = {}
        self._queue: SendQueue | None = None
        if options.latest:
            depth = max(LATEST_DEPTH, options.keep_last)
            self._queue = SendQueue(f"out {template}", depth=depth, sheds=True, keep_last=options.keep_last)
        self.sent = 0
        """Samples that went out, or wait for their receiver."""
        self.withheld = 0
        """Samples that went nowhere, since this worker is not the owner."""
        self.shed = 0
        """Samples that gave way to newer ones behind a stalled receiver (class ``latest``)."""

    def put(
        self,
        payload: Payload,
        *,
        attachment: Payload | None = None,
        encoding: zenoh.Encoding | str | None = None,
        timestamp: zenoh.Timestamp | None = None,
    ) -> bool:
        """Publish; ``False``, and counted, while this worker is not the owner, and once it is closed.

        Without ``timestamp`` the value inherits that of the input it was made of, if that had one: gates tell by it
        that a new owner's first values are older than the old owner's last.

        Raises:
            TypeError: an argument is of another type, also while this worker is not the owner.
        """
        sent, attached, encoded, stamp = put_arguments(payload, attachment, encoding, timestamp)
        with self._lock:
            epoch = self._epoch_now()
            if epoch is None:
                self.withheld += 1
                return False
            stamped = self._epochs.get(epoch) or self._declare(epoch)
            stamped.has_ended = False
            if stamped.lane is not None:
                sent, attached = _own(sent), None if attached is None else _own(attached)
            given = (sent, attached, encoded, stamp or self._stamp_now())
            self.sent += 1
            if self._queue is None:
                self._put(stamped, given)
                return True
            size = weight_of(sent, attached)
            self.shed += self._queue.send(stamped.key, lambda: self._put(stamped, given), size)
            return True

    def send_end(self, epoch: int) -> None:
        """Put the end marker behind the last sample of an epoch (also when there was none)."""
        with self._lock:
            stamped = self._epochs.get(epoch) or self._declare(epoch)
            if self._queue is None:
                self._put_end(stamped, epoch)
            else:
                self._queue.then(lambda: self._put_end(stamped, epoch))

    def close(self) -> None:
        """End the thread of a class ``latest`` output."""
        if self._queue is not None:
            self._queue.close()

    def _put_end(self, stamped: _Stamped, epoch: int) -> None:
        marker = EndMarker(epoch=epoch, count=stamped.count)
        with self._stalled:
            put_end(self._session, stamped.key, stamped.publisher.id, marker)
        stamped.has_ended = True
        if stamped.lane is not None:
            stamped.lane.note_end(marker)

    def _declare(self, epoch: int) -> _Stamped:
        key = self._template.replace("{epoch}", str(epoch))
        publisher: zenoh.Publisher | ext.AdvancedPublisher
        if self.options.latest:
            publisher = ext.declare_advanced_publisher(
                self._session,
                key,
                congestion_control=self._congestion,
                cache=ext.CacheConfig(self.options.keep_last),
                sample_miss_detection=ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=None),
                publisher_detection=True,
            )
        else:
            publisher = self._session.declare_publisher(key, congestion_control=self._congestion)
        lane = None
        if self._keeper is not None:
            limit = self.options.keep_last if self.options.latest else self.options.depth
            lane = self._keeper.lane(key, publisher.id, limit, is_whole=self.options.reliable)
        stamped = self._epochs[epoch] = _Stamped(key=key, publisher=publisher, lane=lane)
        for old in [one for one in sorted(self._epochs)[:-KEPT_EPOCHS] if self._epochs[one].has_ended]:
            gone = self._epochs.pop(old)
            gone.publisher.undeclare()  # type: ignore[no-untyped-call] # zenoh's stubs
            if gone.lane is not None:
                gone.lane.close()
        return stamped

    def _put(self, stamped: _Stamped, given: PutArguments) -> None:
        payload, attachment, encoding, timestamp = given
        publisher, number = stamped.publisher, stamped.unkept
        if stamped.lane is None:
            stamped.unkept += 1
        else:
            size = weight_of(payload, attachment)
            number = stamped.lane.keep((payload, attachment, encoding), timestamp, size)
            if self.options.reliable:
                self._owe(stamped.lane, number)
        more: dict[str, Any] = {"attachment": attachment, "encoding": encoding, "timestamp": timestamp}
        if isinstance(publisher, zenoh.Publisher):
            more["source_info"] = zenoh.SourceInfo(publisher.id, serial_of(number))
        with self._stalled:
            publisher.put(payload, **more)


def _own(value: zenoh.ZBytes) -> zenoh.ZBytes:
    """As bytes of our own, where it is a small part of what came in.

    That lies in zenoh's receive buffer, which it would hold as a whole for as long as it is kept.
    """
    return zenoh.ZBytes(value.to_bytes()) if len(value) < RECEIVE_BUFFER else value
