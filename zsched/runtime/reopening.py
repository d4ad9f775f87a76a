"""Decides when a daemon begins anew, so that its sessions go by other access rules or another certificate.

An open session of zenoh keeps the access rules, and the certificate with which it listens, that it was opened with. So
the nodes of a secured fleet begin anew one after another, electors last, and an elector only while the others live.

Knows: the order of nodes, how long each of them has. Does not know: who lives, what has changed, how a daemon begins
anew (`zsched.daemon`).
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from zsched.core.values.model import NodeId

FIRST_S = 3.0
"""So long the first one waits: who has changed something may still ask it, and the others learn of it meanwhile."""
TURN_S = 10.0
"""So long each of them has: a daemon that owns tasks gives them away (3 s), ends (2 s) and is heard again (3 s)."""
PATIENCE_S = 120.0
"""So long an elector waits for the others; one that is away for good must not keep a new node out."""


def turns(nodes: Collection[NodeId], electors: Collection[NodeId]) -> tuple[NodeId, ...]:
    """The nodes in the order in which they begin anew.

    >>> turns(("edge1", "edge2", "robot1"), ("edge1", "robot1"))
    ('edge2', 'edge1', 'robot1')
    """
    return tuple(sorted(nodes, key=lambda name: (name in electors, name)))


@dataclass(slots=True)
class Reopening:
    """One node's turn."""

    me: NodeId
    due_at: float | None = None
    """When its turn is (monotonic seconds); ``None``: nothing is to be opened anew."""

    def want(self, order: Collection[NodeId], now: float) -> None:
        """Something has changed for all of ``order``, this node among them; a turn that is set stays."""
        if self.due_at is None:
            self.due_at = now + FIRST_S + TURN_S * list(order).index(self.me)

    def forget(self) -> None:
        """The sessions are right as they are."""
        self.due_at = None

    def put_off(self, now: float) -> None:
        """It cannot be now."""
        self.due_at = now + PATIENCE_S

    def is_due(self, electors: Collection[NodeId], alive: Collection[NodeId], now: float) -> bool:
        """Whether to begin anew now.

        Args:
            electors: of the fleet.
            alive: the other nodes that live.
            now: monotonic seconds.
        """
        if self.due_at is None or now < self.due_at:
            return False
        missing = {name for name in electors if name not in alive} - {self.me}
        return self.me not in electors or not missing or now >= self.due_at + PATIENCE_S
