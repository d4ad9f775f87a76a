"""SCHEDULER, restraint: at most so many moves of a task in a minute, whatever the figures say.

Knows: when a task has moved, and whether it fled. Does not know: why.
"""

from __future__ import annotations

from collections import deque
from typing import Self

from zsched.core.values.decision import FuseMemory
from zsched.core.values.struct import Struct, field

WINDOW_S = 60.0
ESCAPES_PER_MINUTE = 60
"""Even fleeing is bounded: one escape a second, on average."""


class Fuse(Struct):
    """One task's moves of the last minute, as one node has learnt them."""

    _moves: deque[tuple[float, bool]] = field(default_factory=deque)

    @classmethod
    def of(cls, memory: FuseMemory) -> Self:
        """A record that goes on from a memory."""
        return cls(_moves=deque(memory.moves))

    def memory(self) -> FuseMemory:
        """All of it, as a value."""
        return FuseMemory(moves=tuple(self._moves))

    def note_move(self, *, is_escape: bool, now: float) -> None:
        """An owner was left; an operator's move is none. ``is_escape``: it was fled from, or had failed."""
        self._forget_old(now)
        self._moves.append((now, is_escape))

    def moves_within(self, seconds: float, now: float, *, escapes: bool) -> int:
        """How many moves (escapes or the others) this node has learnt in the last ``seconds`` (at most a minute)."""
        self._forget_old(now)
        return sum(now - at <= seconds and fled == escapes for at, fled in self._moves)

    def _forget_old(self, now: float) -> None:
        while self._moves and now - self._moves[0][0] > WINDOW_S:
            self._moves.popleft()
