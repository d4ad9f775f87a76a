"""Adds up what the publishers of a stream have sent and what their receivers said of it.

Knows: lanes. Does not know: zenoh, why anything was lost.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields

from zsched.core.hop.sender import Sender, Sums
from zsched.core.values.struct import Struct


class Tally(Struct):
    """Sums over publishers that there are or were; all counts of samples."""

    acknowledged: int = 0
    in_flight: int = 0
    """Sent, and not processed as far as we know."""
    waiting: int = 0
    """Taken, and not sent yet."""
    lost: int = 0
    doubled: int = 0
    reordered: int = 0
    resent: int = 0
    at_most_lost: int = 0
    """In flight to a worker when it died: at most this many had no result."""
    errors: int = 0
    """Refused by zenoh in a queue's thread."""
    uncounted: int = 0
    """Put on to subscribers beside the worker, which acknowledge nothing."""
    unconfirmed: int = 0
    """Put on to a worker that acknowledges nothing."""

    def add(self, other: Tally) -> None:
        """Add another one to this."""
        for field in fields(self):
            setattr(self, field.name, getattr(self, field.name) + getattr(other, field.name))

    def plus(self, lanes: Iterable[Sender]) -> Tally:
        """This and what open publishers say now."""
        total = Tally()
        total.add(self)
        for lane in lanes:
            total.in_flight += lane.in_flight
            total.take(lane.sums())
        return total

    def take(self, sums: Sums) -> None:
        """Add what a life of a receiver has said."""
        self.acknowledged += sums.acknowledged
        self.lost += sums.lost
        self.doubled += sums.doubled
        self.reordered += sums.reordered
        self.at_most_lost += sums.at_most_lost
