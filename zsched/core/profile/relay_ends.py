"""ROUTE: does this node's relay stay? Reported to the whole fleet.

One end is no news to others: the next relay has its plans within a second. A relay that ends again and again, or does
not come back, means that this node's streams do not flow. An operator must see that in any node's status.

Knows: when the relay ended and why. Does not know: processes, the relay's streams.
"""

from __future__ import annotations

import math
from collections import deque

from zsched.core.values.events import RelayChanged
from zsched.core.values.model import as_reason
from zsched.core.values.struct import Struct, field

WINDOW_S = 60.0
OFTEN = 3
"""This many ends within the window are a problem, until fewer of them are that young."""
DOWN_TOLD_S = 2.0
"""A node without a relay for longer is a problem: a new one starts faster."""


class RelayEnds(Struct):
    """The ends of one node's relay."""

    _ended_at: deque[float] = field(default_factory=deque)
    _down_since: float = math.inf
    _reason: str = ""

    def on_changed(self, event: RelayChanged, now: float) -> None:
        """A relay has ended, could not be started, or runs."""
        if event.is_running:
            self._down_since = math.inf
            return
        self._ended_at.append(now)
        self._down_since, self._reason = min(self._down_since, now), event.reason

    def told(self, now: float) -> str:
        """The problem, as text that follows "the relay"; empty: nothing lasting."""
        while self._ended_at and now - self._ended_at[0] > WINDOW_S:
            self._ended_at.popleft()
        if len(self._ended_at) >= OFTEN:
            return as_reason(f"has ended {len(self._ended_at)} times in {WINDOW_S:.0f} s, last: {self._reason}")
        if now - self._down_since >= DOWN_TOLD_S:
            return as_reason(f"is down: {self._reason}")
        return ""
