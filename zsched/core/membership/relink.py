"""Decides when peers that miss each other are introduced again, and when the link to a gone one is ended.

Both come soon, then more rarely while they do not help. Knows: how long nodes have been missing. Does not know: which
links there are, how an introduction works.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from zsched.core.values.model import NodeId

LINK_WAIT_S = 1.0
"""A link has this long to come back by itself: zenoh redials known addresses within a second."""
FIRST_PAUSE_S, MAX_PAUSE_S = 2.0, 60.0
MUTE_S = 5.0
"""The link to a node that has been gone for this long is ended, if it is still up: it is mute."""
MUTE_PAUSE_S = 15.0
"""Longest pause between two ends of the links to one node: it may stay deaf for this long once it is well again."""


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


class MuteLinks:
    """The times at which the links to gone nodes are ended, one node apart from the other.

    A node that was slow for seconds may come back with a link that is up and brings nothing but signs of life: zenoh
    (1.10) has lost our subscriptions at the other end, where the old link of the same session ended after the new one
    had begun. Nothing mends it but a new link.
    """

    def __init__(self) -> None:
        self._due: dict[NodeId, tuple[float, float]] = {}
        """{gone node: (when its link is ended next, the pause after that)}."""

    def due(self, now: float, gone: Iterable[NodeId]) -> tuple[NodeId, ...]:
        """Which nodes' links to end now; ask often.

        Args:
            now: monotonic seconds.
            gone: who is gone at this moment. The pauses of all others begin from the start.
        """
        self._due = {node: self._due.get(node, (now + MUTE_S, FIRST_PAUSE_S)) for node in gone}
        found = tuple(node for node, (at, _) in self._due.items() if now >= at)
        for node in found:
            pause_s = self._due[node][1]
            self._due[node] = (now + pause_s, min(2 * pause_s, MUTE_PAUSE_S))
        return found
