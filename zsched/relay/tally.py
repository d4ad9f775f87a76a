"""Adds up what the publishers of a stream have sent and what their receivers said of it.

Knows: lanes. Does not know: zenoh, why anything was lost.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields

from zsched.core.hop.sender import Sender


@dataclass(slots=True)
class Tally:
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
    """In flight to a worker when it died: so many at most had no result."""
    errors: int = 0
    """Refused by zenoh in a queue's thread."""
    uncounted: int = 0
    """Put on to whoever subscribes beside the worker, who acknowledges nothing."""
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
            total._take(lane)
        return total

    def new_life(self, lane: Sender, start: int) -> None:
        """The receiver died: what its last word left open below ``start`` may be lost."""
        self._take(lane)
        self.at_most_lost += max(0, start - lane.processed)

    def _take(self, lane: Sender) -> None:
        self.acknowledged += lane.acknowledged
        self.lost += lane.lost
        if lane.ack is not None:
            self.doubled += lane.ack.doubled
            self.reordered += lane.ack.reordered
