"""Makes what zenoh sends of what a program gives to a put, before that takes a number or waits anywhere.

Knows: the types that zenoh takes. Does not know: sessions, streams, numbers.

A value that zenoh refuses when its turn comes has a number already, which its receiver would miss for ever.
"""

from __future__ import annotations

from typing import Any

import zenoh

Payload = bytes | bytearray | str | zenoh.ZBytes
PutArguments = tuple[zenoh.ZBytes, zenoh.ZBytes | None, zenoh.Encoding | None, zenoh.Timestamp | None]
"""(payload, attachment, encoding, timestamp)."""


def put_arguments(payload: Any, attachment: Any, encoding: Any, timestamp: Any) -> PutArguments:
    """What is sent; of all but ``payload`` nothing where it is ``None``. Bytes are copied, zenoh's own are not.

    Raises:
        TypeError: zenoh takes no such thing.
    """
    if encoding is not None and not isinstance(encoding, zenoh.Encoding | str):
        raise TypeError(f"encoding: {type(encoding).__name__} is neither str nor zenoh.Encoding")
    if timestamp is not None and not isinstance(timestamp, zenoh.Timestamp):
        raise TypeError(f"timestamp: {type(timestamp).__name__} is no zenoh.Timestamp (of Session.new_timestamp)")
    return (
        _bytes("payload", payload),
        None if attachment is None else _bytes("attachment", attachment),
        zenoh.Encoding(encoding) if isinstance(encoding, str) else encoding,
        timestamp,
    )


def _bytes(name: str, value: Any) -> zenoh.ZBytes:
    if isinstance(value, zenoh.ZBytes):
        return value
    try:
        made = None if value is None else zenoh.ZBytes(value)  # zenoh makes an empty one of `None`
    except TypeError:
        made = None
    if made is None:
        kind = type(value).__name__
        raise TypeError(f"{name}: {kind} is none of bytes, bytearray, str, zenoh.ZBytes (of an array: bytes(...))")
    return made
