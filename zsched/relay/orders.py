"""What the thread of a task in the relay is told, in order; `RoutePlan` is the other kind (`zsched.relay.task`)."""

from __future__ import annotations

import threading

from zenoh import Session

from zsched.core.values.plan import Route
from zsched.core.values.struct import Struct


class Unowned(Struct, frozen=True):
    """Inputs that are taken whether or not there is an owner."""

    routes: tuple[Route, ...]


class Orphaned:
    """The daemon is gone: the plans behind this are another one's."""


class Leave(Struct, kw_only=True, eq=False):
    """The data session is about to close."""

    has_left: threading.Event
    began_at: float
    patience_s: float
    """When nothing of what is under way has arrived for this long, it is given up..."""
    at_most_s: float
    """...and in any case after this time."""
    under_way: int | None = None
    moved_at: float = 0.0

    def is_over(self, under_way: int, now: float) -> bool:
        """Whether to wait no longer for what is under way (a number of samples)."""
        if self.under_way is None or under_way < self.under_way:
            self.under_way, self.moved_at = under_way, now
        return now - self.moved_at >= self.patience_s or now - self.began_at >= self.at_most_s


class Rejoin(Struct, frozen=True, eq=False):
    """Another data session is there; ``own_ids`` are those of all sessions of this process."""

    session: Session
    own_ids: frozenset[str]


class Finish(Struct, frozen=True, eq=False):
    """This relay is about to end (``until``: monotonic seconds); its successor goes on with its counters."""

    is_done: threading.Event
    until: float


class Ended:
    """The task left the fleet file, nothing follows."""
