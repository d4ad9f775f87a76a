"""How fast each stream flows: the rates of the last seconds, out of the relay's totals.

Knows: totals and when they were told. Does not know: what flows, or why it stopped.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import Final

from zsched.core.values.plan import StreamCount
from zsched.core.values.struct import Struct

WINDOW_S: Final = 5.0
"""A rate is the mean over about this time; the relay tells totals once a second."""
STALE_S: Final = 5.0
"""Without new totals for this time a rate is not known."""


class _Total(Struct, frozen=True, kw_only=True):
    at: float
    messages: int
    size: int


class StreamRates:
    """The totals of the last seconds, per stream."""

    def __init__(self) -> None:
        self._totals: dict[str, deque[_Total]] = {}

    def absorb(self, counts: Iterable[StreamCount], now: float) -> None:
        """Take the relay's newest totals, told at ``now`` (monotonic seconds)."""
        before, self._totals = self._totals, {}
        for count in counts:
            totals = before.get(count.stream, deque())
            if totals and count.messages < totals[-1].messages:  # another service, which counts from 0
                totals.clear()
            totals.append(_Total(at=now, messages=count.messages, size=count.bytes))
            while len(totals) > 2 and now - totals[1].at >= WINDOW_S:
                totals.popleft()
            self._totals[count.stream] = totals

    def of(self, stream: str, now: float) -> tuple[float, float] | None:
        """Messages and bytes per second; ``None`` while they are not known."""
        totals = self._totals.get(stream)
        if totals is None or len(totals) < 2 or now - totals[-1].at > STALE_S:
            return None
        first, last = totals[0], totals[-1]
        elapsed_s = last.at - first.at
        if elapsed_s <= 0:
            return None
        return (last.messages - first.messages) / elapsed_s, (last.size - first.size) / elapsed_s
