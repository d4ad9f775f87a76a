"""Decides when peers that miss each other are introduced again: soon, then more rarely while it does not help.

Knows: how long a node has been missing. Does not know: which one, which links there are, how an introduction works.
"""

from __future__ import annotations

import math

LINK_WAIT_S = 1.0
"""A link has this long to come back by itself: zenoh redials known addresses within a second."""
FIRST_PAUSE_S, MAX_PAUSE_S = 2.0, 60.0


class Introductions:
    """The times of one session's introductions."""

    def __init__(self) -> None:
        self._due_at = math.inf  # while nobody is missing
        self._pause_s = FIRST_PAUSE_S

    def is_due(self, now: float, *, is_missing: bool) -> bool:
        """Whether to introduce all nodes to each other now; ask often.

        Args:
            now: monotonic seconds.
            is_missing: whether a node is missing at this moment. If not, the pauses begin from the start.
        """
        if not is_missing:
            self._due_at = math.inf
            return False
        if self._due_at == math.inf:
            self._due_at, self._pause_s = now + LINK_WAIT_S, FIRST_PAUSE_S
        if now < self._due_at:
            return False
        self._due_at = now + self._pause_s
        self._pause_s = min(2 * self._pause_s, MAX_PAUSE_S)
        return True
