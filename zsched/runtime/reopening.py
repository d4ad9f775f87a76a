"""Decides when a daemon begins again, so that its sessions go by other access rules or another certificate.

An open session of zenoh keeps the access rules, and the certificate with which it listens, that it was opened with. So
the nodes of a secured fleet begin again one after another, electors last, and an elector only while the others live.

Knows: the order of nodes, how long each of them has at most, whose lives are new. Does not know: which nodes live,
what has changed, how a daemon begins again (`zsched.daemon`).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

from zsched.core.values.model import NodeId

FIRST_S = 2.0
"""The first one waits this long: the operator's tool may still ask it, and the others learn of the change meanwhile."""
TURN_S = 10.0
"""Each has at most this long: a daemon that owns tasks gives them away (3 s), ends (2 s) and is heard again (3 s)."""
SETTLE_S = 1.0
"""Once all before it are heard in a new life, the next one waits this long: their workers start meanwhile."""
LONGEST_WAIT_S = 120.0
"""An elector waits this long for the others; one that is away for good must not keep a new node out."""


def turns(nodes: Collection[NodeId], electors: Collection[NodeId]) -> tuple[NodeId, ...]:
    """The nodes in the order in which they begin again.

    >>> turns(("edge1", "edge2", "robot1"), ("edge1", "robot1"))
    ('edge2', 'edge1', 'robot1')
    """
    return tuple(sorted(nodes, key=lambda name: (name in electors, name)))


@dataclass(slots=True)
class Reopening:
    """One node's turn: when all before it have begun again, at the latest when the time of all of them is over."""

    me: NodeId
    due_at: float | None = None
    """The latest of its turn (monotonic seconds); ``None``: nothing is to be opened again."""
    _first_at: float = 0.0
    _before: Mapping[NodeId, int | None] = field(default_factory=dict)
    """{node whose turn comes first: its incarnation when something changed}."""
    _anew_at: float | None = None
    """Since when all of them are heard in a new life."""

    def want(self, order: Collection[NodeId], lives: Mapping[NodeId, int | None], now: float) -> None:
        """Something has changed for all of ``order``, this node among them; a turn that is set stays.

        Args:
            order: the nodes, by their turns.
            lives: {node: its incarnation, as far as it was heard}.
            now: monotonic seconds.
        """
        if self.due_at is None:
            names = list(order)
            count = names.index(self.me)
            self._first_at, self.due_at = now + FIRST_S, now + FIRST_S + TURN_S * count
            self._before, self._anew_at = {name: lives.get(name) for name in names[:count]}, None

    def forget(self) -> None:
        """The sessions are right as they are."""
        self.due_at = None

    def put_off(self, now: float) -> None:
        """It cannot be now."""
        self.due_at = self._first_at = now + LONGEST_WAIT_S

    def is_due(
        self,
        electors: Collection[NodeId],
        lives: Mapping[NodeId, int | None],
        now: float,
        *,
        is_free: bool = True,
    ) -> bool:
        """Whether to begin again now.

        Args:
            electors: of the fleet.
            lives: {other node that lives: its incarnation}.
            now: monotonic seconds.
            is_free: every task of this node's could go to another one; else it waits for the latest of its turn.
        """
        if self.due_at is None or now < self._first_at:
            return False
        if now < self.due_at and not (is_free and self._is_next(lives, now)):
            return False
        missing = {name for name in electors if name not in lives} - {self.me}
        return self.me not in electors or not missing or now >= self.due_at + LONGEST_WAIT_S

    def _is_next(self, lives: Mapping[NodeId, int | None], now: float) -> bool:
        """Whether all before it have begun again, and have had time to start their workers."""
        if not all(_is_newer(lives.get(name), before) for name, before in self._before.items()):
            self._anew_at = None
            return False
        if self._anew_at is None:
            self._anew_at = now
        return not self._before or now >= self._anew_at + SETTLE_S


def _is_newer(life: int | None, before: int | None) -> bool:
    return life is not None and before is not None and life > before
