"""A sample that an application puts, and one that it is given.

Knows: what the streams' code reads of a zenoh sample (zenoh lets nobody make one). Does not know: streams.
"""

from __future__ import annotations

from typing import Final

import zenoh
from zenoh import Priority, SampleKind

from zsched.core.values.struct import Struct

PLAIN: Final = zenoh.Encoding.ZENOH_BYTES
_DATA: Final = Priority.DATA
_PUT: Final = SampleKind.PUT


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


class Received(Struct, frozen=True, kw_only=True, eq=False):
    """An answer, as a callback is given it."""

    key: str
    """The application's own key, as in the fleet file: not the owner's."""
    payload: zenoh.ZBytes
    """zenoh's own bytes (`to_bytes()`, `to_string()` copy)."""
    attachment: zenoh.ZBytes | None
    """The same of the attachment, `None` without one."""
    encoding: str
    """As text."""
    timestamp: zenoh.Timestamp | None
    """Its input's, where the worker is one of `zsched.worker`."""
    deleted: bool
    """The worker deleted the key; the payload is empty."""
