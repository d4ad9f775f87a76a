"""How many bytes a sample takes while it is kept, for every bound in bytes.

Knows: that an application's attachment may be as large as a payload. Does not know: who keeps what.
"""

from __future__ import annotations

from typing import Any


def weight(sample: Any) -> int:
    """Bytes of a sample's payload and attachment; ``sample``: zenoh's, or one that is like it."""
    return weight_of(sample.payload, sample.attachment)


def weight_of(payload: Any, attachment: Any) -> int:
    """Bytes of both; ``attachment`` may be ``None``.

    >>> weight_of(b"map", None), weight_of(b"", b"at")
    (3, 2)
    """
    return len(payload) + (0 if attachment is None else len(attachment))
