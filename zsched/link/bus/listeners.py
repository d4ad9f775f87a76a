"""Tells which keys of the data network somebody subscribes to: a client session of its own looks, and puts nothing.

Knows: zenoh sessions, publishers and what matches them. Does not know: nodes, streams, what is put.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Final

import zenoh

from zsched.core.values.errors import AdapterError
from zsched.host.clock import monotonic_s
from zsched.host.guard import ends_within
from zsched.link.bus.stream_tap import CLOSE_S
from zsched.link.sessions.matching import is_matched

_LOOK_S: Final = 0.02


def keys_with_listeners(config: str, keys: Sequence[str], within_s: float) -> frozenset[str]:
    """Which of ``keys`` have a subscriber, seen from a session of ``config`` (zenoh's, as JSON).

    Returns as soon as each has one, at the latest after ``within_s`` seconds.

    Raises:
        AdapterError: the session cannot be opened, or a key is none.
    """
    session = None
    try:
        session = zenoh.open(zenoh.Config.from_json5(config))
        publishers = {key: session.declare_publisher(key) for key in keys}
        end = monotonic_s() + within_s
        while True:
            heard = frozenset(key for key, one in publishers.items() if is_matched(one))
            if len(heard) == len(publishers) or monotonic_s() >= end:
                return heard
            time.sleep(_LOOK_S)
    except (zenoh.ZError, ValueError) as error:
        raise AdapterError(f"the data network cannot be joined: {error}; is the node's relay running?") from error
    finally:
        if session is not None:
            ends_within(CLOSE_S, session.close, name="listeners close")
