"""Numbers and stamps a ROS publisher's messages, as rmw_zenoh's subscriptions want them.

Knows: rmw_zenoh's attachment, wall time. Does not know: topics, zenoh, what a message holds.
"""

from __future__ import annotations

import os
from collections.abc import Callable

from zsched.core.route.ros2 import GID_BYTES, Attachment, encode_attachment
from zsched.host.clock import wall_ns


class RosPublisher:
    """One publisher's identity: a random gid for the life of this process, and a gapless sequence from 1."""

    def __init__(self, put: Callable[[bytes, bytes], bool], *, clock_ns: Callable[[], int] = wall_ns) -> None:
        """``put`` sends (payload, attachment) and says whether it went out."""
        self._put = put
        self._clock_ns = clock_ns
        self._gid = os.urandom(GID_BYTES)
        self._sequence = 0

    def put(self, payload: bytes) -> bool:
        """Send one message; a message that did not go out leaves no gap, which ROS would count as lost."""
        value = Attachment(sequence=self._sequence + 1, stamp_ns=self._clock_ns(), gid=self._gid)
        is_out = self._put(payload, encode_attachment(value))
        self._sequence += is_out
        return is_out
