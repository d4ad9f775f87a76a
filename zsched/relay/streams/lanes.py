"""One publisher of a stream: declared by its class, puts samples under their numbers, and markers behind them.

Knows: what each class asks of zenoh, how a sample is put on with everything that it had, and put again. Does not know:
what the numbers mean (`zsched.core.hop.sender`), queues, slots, when to send again. Its outlet's lock guards the
numbers.

Class ``latest`` is not put with zenoh's BLOCK_FIRST: that drops a sample whenever the one before is still on its way (1
in 40 at 1 kHz on an idle machine, 42 µs a put), and what is put with BLOCK overtakes it. Its advanced publishers have a
cache and numbers, but no heartbeat: towards a frozen receiver a heartbeat blocks zenoh's own runtime (tokens and
samples of every other peer came more than 0.3 s late) and makes ``undeclare`` hold Python's global lock until the
receiver's lease ends (measured with zenoh 1.10.2: 4 s of an 8 s lease).
"""

from __future__ import annotations

from typing import Any, Final

import zenoh
from zenoh import CongestionControl, Priority, Reliability, Sample, SampleKind, Session, Timestamp, ext

from zsched.core.hop.kept import Sent
from zsched.core.hop.sender import Sender
from zsched.core.hop.serial import serial_of
from zsched.core.values.plan import StreamClass, StreamSettings
from zsched.core.values.relay_protocol import EndMarker
from zsched.link.keyspace import END_CHUNK
from zsched.link.pipe.frames import encode_end

_DELETE: Final = SampleKind.DELETE
_Plain = zenoh.Publisher
_SourceInfo = zenoh.SourceInfo
_CONGESTION: Final = {
    StreamClass.BEST_EFFORT: CongestionControl.DROP,
    StreamClass.LATEST: CongestionControl.BLOCK,
    StreamClass.RELIABLE: CongestionControl.BLOCK,
}


class Lane(Sender, kw_only=True, eq=False):
    """A concrete key with one priority and express flag."""

    key: str
    publisher: zenoh.Publisher | ext.AdvancedPublisher
    source_id: zenoh.EntityGlobalId
    eid: int
    used_at: float = 0.0
    """When a sample was last given to it (monotonic seconds)."""
    is_left: bool = False
    """It was given back to make room for another key."""

    def put(self, sample: Sample, stamp: Timestamp | None) -> None:
        """Put a sample on under the next number (the caller counts), with everything that zenoh lets us keep."""
        publisher = self.publisher
        if sample.kind == _DELETE:
            self._delete(sample, stamp)
        elif isinstance(publisher, _Plain):
            publisher.put(
                sample.payload,
                encoding=sample.encoding,
                attachment=sample.attachment,
                timestamp=stamp,
                source_info=_SourceInfo(self.source_id, serial_of(self.count)),
            )
        else:
            publisher.put(sample.payload, encoding=sample.encoding, attachment=sample.attachment, timestamp=stamp)

    def _delete(self, sample: Sample, stamp: Timestamp | None) -> None:
        publisher = self.publisher
        if isinstance(publisher, zenoh.Publisher):
            source = zenoh.SourceInfo(self.source_id, serial_of(self.count))
            publisher.delete(attachment=sample.attachment, timestamp=stamp, source_info=source)
        else:
            publisher.delete(attachment=sample.attachment, timestamp=stamp)

    def put_again(self, session: Session, sent: Sent) -> None:
        """Put a kept sample on under the number it had (never into a cache a second time)."""
        source = _SourceInfo(self.source_id, serial_of(sent.number))
        self._put_by(session, sent.sample, sent.stamp, source, CongestionControl.BLOCK)

    def put_dropping(self, session: Session, sample: Sample, stamp: Timestamp | None) -> None:
        """Put without waiting, under the next number; an advanced publisher numbers only what its cache has."""
        is_numbered = isinstance(self.publisher, _Plain)
        source = _SourceInfo(self.source_id, serial_of(self.count)) if is_numbered else None
        self._put_by(session, sample, stamp, source, CongestionControl.DROP)

    def _put_by(
        self,
        session: Session,
        sample: Sample,
        stamp: Timestamp | None,
        source: zenoh.SourceInfo | None,
        congestion: CongestionControl,
    ) -> None:
        settings: dict[str, Any] = {
            "attachment": sample.attachment,
            "timestamp": stamp,
            "source_info": source,
            "congestion_control": congestion,
            "priority": sample.priority,
            "express": sample.express,
        }
        if sample.kind == _DELETE:
            session.delete(self.key, **settings)
        else:
            session.put(self.key, sample.payload, encoding=sample.encoding, **settings)


def declare_publisher(
    session: Session, key: str, settings: StreamSettings, priority: Priority, *, is_express: bool
) -> zenoh.Publisher | ext.AdvancedPublisher:
    """The publisher of one concrete key."""
    stream_class = settings.stream_class
    congestion = _CONGESTION[stream_class]
    if stream_class is StreamClass.LATEST:
        return ext.declare_advanced_publisher(
            session,
            key,
            congestion_control=congestion,
            priority=priority,
            express=is_express,
            reliability=Reliability.RELIABLE,
            cache=ext.CacheConfig(max(1, settings.keep_last)),
            sample_miss_detection=ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=None),
            publisher_detection=True,
        )
    is_reliable = stream_class is StreamClass.RELIABLE
    return session.declare_publisher(
        key,
        congestion_control=congestion,
        priority=priority,
        express=is_express,
        reliability=Reliability.RELIABLE if is_reliable else Reliability.BEST_EFFORT,
    )


def put_marker(
    session: Session,
    key: str,
    source_id: zenoh.EntityGlobalId,
    priority: Priority,
    marker: EndMarker,
    *,
    waits: bool = True,
) -> None:
    """Put an end or start marker on the way of the samples of ``key``; ``waits``: for its link, if that has no room."""
    session.put(
        f"{key}/{END_CHUNK}",
        encode_end(marker),
        congestion_control=CongestionControl.BLOCK if waits else CongestionControl.DROP,
        priority=priority,
        source_info=zenoh.SourceInfo(source_id, serial_of(marker.count)),
    )
