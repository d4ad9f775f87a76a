"""Counts what one stream carried and what it dropped, with the reason.

Knows: `StreamCount`. Does not know: zenoh, routes. Its owner's lock guards it.
"""

from __future__ import annotations

from zsched.clock import monotonic_s
from zsched.core.plan import StreamCount


class StreamCounter:
    """Counters of one stream since the relay started."""

    def __init__(self, stream: str) -> None:
        self.stream = stream
        self._messages = 0
        self._bytes = 0
        self._drops: dict[str, int] = {}
        self._last_seen: float | None = None

    def seen(self, size: int) -> None:
        """A sample of ``size`` bytes came in."""
        self._messages += 1
        self._bytes += size
        self._last_seen = monotonic_s()

    def dropped(self, reason: str, count: int = 1) -> None:
        """``count`` samples did not go on, because of ``reason`` (or went on once more: ``repeated``, ``replayed``)."""
        if count:
            self._drops[reason] = self._drops.get(reason, 0) + count

    def value(self) -> StreamCount:
        """The counters now; ``last_seen_s`` is an age in seconds."""
        age = None if self._last_seen is None else round(max(0.0, monotonic_s() - self._last_seen), 3)
        return StreamCount(
            stream=self.stream,
            messages=self._messages,
            bytes=self._bytes,
            drops=tuple(sorted(self._drops.items())),
            last_seen_s=age,
        )
