"""Decides how soon this node beats again: at full pace while anything goes on, slower while nothing does.

A beat says whether its sender is *calm*: nothing goes on at that node, and its next beat may come at the slow pace. A
node beats slowly only while it is calm and every living peer's newest beat says so, too. A node of a version that does
not say it is never calm, so all others beat at full pace beside it.

Knows: what this node's beats have said. Does not know: what goes on (it is told), who is alive.
"""

from __future__ import annotations

import math

from zsched.core.values.beat import Beat
from zsched.core.values.in_force import InForce
from zsched.core.values.struct import Struct, replace

FULL_S = 5.0
"""After the last sign that something goes on, a node beats at full pace for this long."""


class Pace(Struct):
    """The pace of one node's beats."""

    in_force: InForce
    _full_until: float = -math.inf
    _said: Beat | None = None
    """What the newest beat said, without what changes with each."""
    _sent_at: float = -math.inf
    is_slow: bool = False
    """The next beat is due at the slow pace."""

    def marked(self, beat: Beat, now: float, *, is_restless: bool) -> Beat:
        """``beat`` as it is sent: it says whether this node is calm. A beat with any news is not.

        Args:
            beat: it, as it would be sent.
            now: monotonic seconds.
            is_restless: something goes on here that beats do not say.
        """
        said = replace(beat, sequence=0, loop_lag_s=0.0)
        if is_restless or said != self._said:
            self._full_until = now + FULL_S
        self._said, self._sent_at = said, now
        return replace(beat, calm=True) if now >= self._full_until else beat

    def next_at(self, beat: Beat, *, are_all_calm: bool) -> float:
        """When the beat after ``beat``, which was sent just now, is due.

        ``are_all_calm``: every living peer's newest beat says so.
        """
        self.is_slow = beat.calm and are_all_calm
        return self._sent_at + (self.in_force.timing.rest_beat_s if self.is_slow else self.in_force.timing.beat_s)

    def hasten(self, due_at: float, now: float) -> float:
        """Something goes on, here or elsewhere: when the beat is due that was due at ``due_at``."""
        if not self.is_slow:
            return due_at
        self.is_slow, self._full_until = False, now + FULL_S
        return min(due_at, max(now, self._sent_at + self.in_force.timing.beat_s))
