"""The gaps in each output stream: the longest time without an answer, over the last seconds and at each move.

Knows: what the relay has measured between two counts. Does not know: what flows, or why it stopped.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import Final

from zsched.core.values.plan import StreamCount

GAP_WINDOW_S: Final = 10.0
"""The status tells the longest gap of this many seconds, so that a reader who looks every few seconds misses none."""


class StreamGaps:
    """The gaps of the last seconds, per stream, and the moves whose gap has been told."""

    def __init__(self) -> None:
        self._gaps: dict[str, deque[tuple[float, float]]] = {}
        self._told: dict[str, int] = {}
        """{stream: the epoch of the newest gap at a move}."""

    def absorb(self, counts: Iterable[StreamCount], now: float) -> tuple[StreamCount, ...]:
        """Take the relay's newest counts, told at ``now`` (monotonic seconds); answers those with a new move's gap."""
        before, self._gaps = self._gaps, {}
        told, self._told = self._told, {}
        news = []
        for count in counts:
            if count.move_epoch:
                self._told[count.stream] = count.move_epoch
                if told.get(count.stream) != count.move_epoch:
                    news.append(count)
            gaps = before.get(count.stream, deque())
            if count.gap_s is not None:
                gaps.append((now, count.gap_s))
            if gaps:
                self._gaps[count.stream] = gaps
                self._forget(gaps, now)
        return tuple(news)

    def of(self, stream: str, now: float) -> float | None:
        """The longest gap that ended within the last `GAP_WINDOW_S`, in seconds; ``None``: none has ended."""
        gaps = self._gaps.get(stream, ())
        return max((gap_s for at, gap_s in gaps if now - at < GAP_WINDOW_S), default=None)

    @staticmethod
    def _forget(gaps: deque[tuple[float, float]], now: float) -> None:
        while gaps and now - gaps[0][0] >= GAP_WINDOW_S:
            gaps.popleft()
