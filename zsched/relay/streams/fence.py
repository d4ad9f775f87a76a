"""Keeps a new owner's answers to older values from following newer ones that have passed already (class ``latest``).

Knows: the newest timestamp that has passed, key by key and clock by clock; for how long after a handover to look. Does
not know: slots, samples. Its owner's lock guards it.

An answer has the timestamp of its input, and that is of the machine which stamped it. So timestamps of two machines are
never compared: one robot's clock may be an hour behind another's.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import Final

from zenoh import Timestamp

from zsched.host.clock import monotonic_s

FENCE_S: Final = 2.0
"""For this long after a new owner took over, its answers to values older than what has passed are dropped."""
MAX_STAMPS: Final = 4096


class Fence:
    """The timestamps of one output stream."""

    def __init__(self) -> None:
        self._newest: OrderedDict[tuple[str, str], Timestamp] = OrderedDict()
        """{(key, whose clock): newest that has passed}."""
        self._until = 0.0

    def begin(self, *, is_first: bool) -> None:
        """An owner takes over: look for a while, unless nothing has passed before."""
        if self._newest or not is_first:
            self._until = monotonic_s() + FENCE_S

    def passes(self, key: str, stamp: Timestamp) -> bool:
        """True unless a newer value has passed; asked about a new owner's first answers only (an owner may go back)."""
        name = key, str(stamp.get_id())
        newest = self._newest.get(name)
        is_older = newest is not None and stamp < newest  # type: ignore[operator] # zenoh's stubs
        if is_older and monotonic_s() < self._until:
            return False
        self._newest[name] = stamp
        self._newest.move_to_end(name)
        if len(self._newest) > MAX_STAMPS:
            self._newest.popitem(last=False)
        return True
