"""Numbered messages of one sender: is a message news, old, or doubtful?

Knows: lives (incarnations), sequence numbers, how far ahead an honest one can be, the way back from a wrong one. Does
not know: the messages' content, what silence means.

Anybody who can send a frame can send one number, and the highest number wins. So a number far ahead of the last one, or
of an unknown life, is *doubtful*. It counts only after `RUN` messages in a row have continued it while nothing more
came of the known course. In the same way a sender is heard again whose number a forged one has overtaken.
"""

from __future__ import annotations

import math
from enum import StrEnum

from zsched.core.values.struct import Struct

WINDOW = 16
"""No honest message is further ahead of the one before..."""
RATE_HZ = 50.0
"""...plus this many numbers for each second between the two (a cut)."""
RUN = 3
"""This many messages in a row make another course believed."""
STEP = 8
"""Messages are in a row when they are at most this many numbers apart."""


class Order(StrEnum):
    """The verdict on a number."""

    NEW = "new"
    OLD = "old"
    DOUBTFUL = "doubtful"


class _Course(Struct):
    """A run of numbers that is not believed yet."""

    incarnation: int
    sequence: int
    since: float
    count: int = 1


class Track(Struct):
    """The newest believed (incarnation, sequence) of one sender, and another course that may replace it."""

    incarnation: int = -1
    sequence: int = -1
    at: float = -math.inf
    """When its last message came (monotonic seconds)."""
    _other: _Course | None = None

    def judge(self, incarnation: int, sequence: int, now: float, *, may_begin: bool) -> Order:
        """Take a number in; `Order.NEW` makes it the newest.

        ``may_begin``: another life may begin with its first message, since the known one is over or was never heard.
        """
        if self.incarnation < 0 or (may_begin and incarnation != self.incarnation):
            return self._take(incarnation, sequence, now)
        ahead = sequence - self.sequence
        if incarnation == self.incarnation and 0 < ahead <= WINDOW + RATE_HZ * (now - self.at):
            return self._take(incarnation, sequence, now)
        if self._is_believed(incarnation, sequence, now):
            return self._take(incarnation, sequence, now)
        return Order.OLD if incarnation == self.incarnation and ahead <= 0 else Order.DOUBTFUL

    def _take(self, incarnation: int, sequence: int, now: float) -> Order:
        self.incarnation, self.sequence, self.at, self._other = incarnation, sequence, now, None
        return Order.NEW

    def _is_believed(self, incarnation: int, sequence: int, now: float) -> bool:
        """Whether this continues a course that has now run for long enough."""
        other = self._other
        if other is None or other.incarnation != incarnation or not 0 < sequence - other.sequence <= STEP:
            if (incarnation, sequence) != (self.incarnation, self.sequence):  # a mere repeat begins nothing
                self._other = _Course(incarnation, sequence, now)
            return False
        other.sequence, other.count = sequence, other.count + 1
        return other.count >= RUN and now > other.since
