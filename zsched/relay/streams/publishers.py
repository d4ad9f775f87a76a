"""Declares the publishers of streams by their class, and puts the markers that travel behind their samples.

Knows: what each class asks of zenoh. Does not know: lanes, numbers, when.

Class ``latest`` is not put with zenoh's BLOCK_FIRST: that drops a sample whenever the one before is still on its way (1
in 40 at 1 kHz on an idle machine, 42 µs a put), and what is put with BLOCK overtakes it. Its advanced publishers have a
cache and numbers, but no heartbeat: towards a frozen receiver a heartbeat blocks zenoh's own runtime (tokens and
samples of every other peer came more than 0.3 s late) and makes ``undeclare`` hold Python's global lock until the
receiver's lease ends (measured with zenoh 1.10.2: 4 s of an 8 s lease).
"""

from __future__ import annotations

from typing import Final

import zenoh
from zenoh import CongestionControl, Priority, Reliability, Session, ext

from zsched.core.hop.serial import serial_of
from zsched.core.relay_protocol import EndMarker
from zsched.core.values.plan import StreamClass, StreamSettings
from zsched.ipc.pipe import encode_end
from zsched.wire.keyspace import END_CHUNK

_CONGESTION: Final = {
    StreamClass.BEST_EFFORT: CongestionControl.DROP,
    StreamClass.LATEST: CongestionControl.BLOCK,
    StreamClass.RELIABLE: CongestionControl.BLOCK,
}


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
    session: Session, key: str, source_id: zenoh.EntityGlobalId, priority: Priority, marker: EndMarker
) -> None:
    """Put an end or start marker on the way of the samples of ``key``; may wait for its link."""
    session.put(
        f"{key}/{END_CHUNK}",
        encode_end(marker),
        congestion_control=CongestionControl.BLOCK,
        priority=priority,
        source_info=zenoh.SourceInfo(source_id, serial_of(marker.count)),
    )
