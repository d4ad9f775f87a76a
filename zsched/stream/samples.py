"""A sample as an application is given it. Does not know: streams."""

from __future__ import annotations

import zenoh

from zsched.core.values.struct import Struct


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
