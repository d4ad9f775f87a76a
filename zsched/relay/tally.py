"""Adds up what the publishers of a stream have sent and what their receivers said of it.

Knows: `StreamAck`, lanes. Does not know: zenoh, why anything was lost.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields

from zsched.core.relay_protocol import StreamAck
from zsched.relay.lanes import Lane


@dataclass(slots=True)
class Tally:
    """Sums over publishers that there are or were; all counts of samples."""

    acknowledged: int = 0
    in_flight: int = 0
    lost: int = 0
    doubled: int = 0
    reordered: int = 0
    resent: int = 0
    at_most_lost: int = 0
    """In flight to a worker when it died: so many at most had no result."""

    def add(self, other: Tally) -> None:
        """Add another one to this."""
        for field in fields(self):
            setattr(self, field.name, getattr(self, field.name) + getattr(other, field.name))

    def plus(self, lanes: Iterable[Lane]) -> Tally:
        """This and what open publishers say now."""
        total = Tally()
        total.add(self)
        for lane in lanes:
            total.in_flight += lane.in_flight
            if lane.ack is not None:
                total._take(lane.ack)
        return total

    def new_life(self, before: StreamAck | None, sent: int) -> None:
        """The receiver died: what its last word left open may be lost."""
        if before is None:
            return
        self._take(before)
        self.at_most_lost += max(0, sent - before.processed)

    def _take(self, ack: StreamAck) -> None:
        self.acknowledged += max(0, ack.processed - ack.first - ack.lost)
        self.lost += ack.lost
        self.doubled += ack.doubled
        self.reordered += ack.reordered
