"""SCHEDULER, restraint under faults: a node that failed pays for it, and moves are capped.

Knows: what every learnt change of owner says about the node that was left. Does not know: why robots prefer a node.

Route flap damping (RFC 2439) in utility units: a node that failed collects two points, one more when it had just got
the task. To leave a node for a better one is what moves are for and costs it nothing, however soon the task leaves it
again; nor does a node pay that was told to stop. Points decay with a half-life, and the penalty grows as
``STEP * (2**points - 1)``, at most `MAX_PENALTY`. A penalised node stays eligible: when it is the only one, it serves.
Every robot learns the same allocations, so all come to the same penalties; but one that was cut off has missed some,
and one that was restarted has forgotten them. So robots tell each other (`UtilityVector.penalties`), and what any of
them remembers counts (`zsched.core.scheduler.standing.joined`).
"""

from __future__ import annotations

from collections import deque
from typing import Self

from zsched.core.values.decision import DampingMemory
from zsched.core.values.model import NodeId
from zsched.core.values.struct import Struct, field

STEP = 0.03
"""Penalty for the first point."""
MAX_PENALTY = 0.35
"""No node loses more."""
HALF_LIFE_S = 60.0
EARLY_FAILURE_S = 30.0
"""An owner that fails this soon pays more for it."""
FORGET_BELOW = 0.05
"""Fewer points are none."""
WINDOW_S = 60.0
ESCAPES_PER_MINUTE = 60
"""Even fleeing is bounded: one escape a second, on average."""


class Damping(Struct):
    """One task's record of moves at one node."""

    _points: dict[NodeId, tuple[float, float]] = field(default_factory=dict)
    _moves: deque[tuple[float, bool]] = field(default_factory=deque)
    _owner_since: float = 0.0

    @classmethod
    def of(cls, memory: DampingMemory) -> Self:
        """A record that goes on from a memory; it knows no longer since when the owner has the task."""
        points = {node: (points, at) for node, points, at in memory.points}
        return cls(_points=points, _moves=deque(memory.moves))

    def memory(self) -> DampingMemory:
        """What penalties and caps go by, as a value."""
        points = tuple((node, points, at) for node, (points, at) in sorted(self._points.items()))
        return DampingMemory(points=points, moves=tuple(self._moves))

    def note_move(
        self,
        left: NodeId | None,
        *,
        has_failed: bool,
        was_draining: bool = False,
        is_escape: bool = False,
        is_ordered: bool = False,
        now: float,
    ) -> None:
        """An epoch was learnt: ``left`` is the owner before (``None``: the first placement, which is no move).

        A node that drained was told to: that says nothing against it, however soon, and though it is gone by now.
        An operator's move counts neither against the node that was left nor in the cap. ``is_escape``: it was fled
        from, though it may not have failed.
        """
        if left is not None and not is_ordered:
            if has_failed and not was_draining:
                gained = 2.0 + float(now - self._owner_since < EARLY_FAILURE_S)
                self._points[left] = (self.points(left, now) + gained, now)
            self._forget_old(now)
            self._moves.append((now, has_failed or is_escape))
        self._owner_since = now

    def forgive(self, node: NodeId) -> None:
        """An operator has mended ``node``; the caps still count the moves."""
        self._points.pop(node, None)

    def points(self, node: NodeId, now: float) -> float:
        """What a node has collected, decayed to ``now``."""
        points, at = self._points.get(node, (0.0, now))
        left: float = points * 0.5 ** (max(now - at, 0.0) / HALF_LIFE_S)
        return left if left >= FORGET_BELOW else 0.0

    def penalty(self, node: NodeId, now: float) -> float:
        """What is taken off the node's aggregate, in [0, `MAX_PENALTY`].

        >>> damping = Damping()
        >>> damping.note_move("edge1", has_failed=True, now=100.0)
        >>> damping.penalty("edge1", 100.0), damping.penalty("edge1", 160.0), damping.penalty("edge2", 100.0)
        (0.09, 0.03, 0.0)
        """
        grown: float = STEP * (2.0 ** self.points(node, now) - 1.0)
        return min(grown, MAX_PENALTY)

    def penalties(self, now: float) -> dict[NodeId, float]:
        """{node: penalty} of every node that has one, sorted."""
        found = {node: self.penalty(node, now) for node in sorted(self._points)}
        return {node: penalty for node, penalty in found.items() if penalty > 0.0}

    def moves_within(self, seconds: float, now: float, *, escapes: bool) -> int:
        """How many moves (escapes or the others) this node has learnt in the last ``seconds`` (at most a minute)."""
        self._forget_old(now)
        return sum(now - at <= seconds and fled == escapes for at, fled in self._moves)

    def _forget_old(self, now: float) -> None:
        while self._moves and now - self._moves[0][0] > WINDOW_S:
            self._moves.popleft()
