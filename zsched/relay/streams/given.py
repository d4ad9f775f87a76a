"""Samples that we make: zenoh lets nobody make one of its own.

Knows: what the streams' code reads of a sample. Does not know: streams.
"""

from __future__ import annotations

from typing import Final, cast

import zenoh
from zenoh import CongestionControl, Priority, Sample, SampleKind

from zsched.core.values.struct import Struct

PLAIN: Final = zenoh.Encoding.ZENOH_BYTES
_DATA: Final = Priority.DATA
_PUT: Final = SampleKind.PUT
_BLOCK: Final = CongestionControl.BLOCK


class Given(Struct, frozen=True, eq=False):
    """What an application puts, as the streams' code reads it."""

    key_expr: str
    payload: zenoh.ZBytes
    encoding: zenoh.Encoding = PLAIN
    attachment: zenoh.ZBytes | None = None
    timestamp: zenoh.Timestamp | None = None
    priority: Priority = _DATA
    express: bool = False
    source_info: zenoh.SourceInfo | None = None
    kind: SampleKind = _PUT
    congestion_control: CongestionControl = _BLOCK


def under(key: str, sample: Sample) -> Sample:
    """The same sample under another key."""
    made = Given(
        key,
        sample.payload,
        sample.encoding,
        sample.attachment,
        sample.timestamp,
        sample.priority,
        sample.express,
        sample.source_info,
        sample.kind,
    )
    return cast("Sample", made)
