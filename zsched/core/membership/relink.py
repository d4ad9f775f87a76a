"""Decides when peers that miss each other are introduced again: soon, and ever more rarely while it does not help.

Knows: how long somebody has been missing. Does not know: who it is, which links there are, how an introduction is made.
"""

from __future__ import annotations

import math

LINK_WAIT_S = 1.0
"""So long a link has to come back by itself: who has an address is redialled within a second."""
FIRST_PAUSE_S, MAX_PAUSE_S = 2.0, 60.0


class Introductions:
    """The times of one session's introductions."""

    def __init__(self) -> None:
        self._due_at = math.inf  # while nobody is missing
        self._pause_s = FIRST_PAUSE_S

    def is_due(self, now: float, *, is_missing: bool) -> bool:
        """Whether to introduce everybody to everybody now; ask often.

        Args:
            now: monotonic seconds.
            is_missing: whether somebody is missing at this moment. Nobody: the next time begins from the start.
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
