"""Thins a stream out to a highest rate, key by key; the newest value of a key is never lost to it.

Knows: when each key may pass again, what was passed over last. Does not know: zenoh, streams. Its owner's lock
guards it.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable
from typing import Final, Generic, TypeVar

T = TypeVar("T")

MAX_KEYS: Final = 4096


class Pace(Generic[T]):
    """At most ``max_hz`` per key, on average: a sample that is early by less than a period passes."""

    def __init__(self, max_hz: float, *, remembers: bool) -> None:
        """``remembers``: passed over values are kept for `overdue` (streams that keep the newest)."""
        self._remembers = remembers
        self._period_s = 1.0 / max_hz
        self._due: OrderedDict[Hashable, float] = OrderedDict()
        """{key: when it may pass again}, the one that has passed last at the end."""
        self._passed_over: dict[Hashable, T] = {}

    def passes(self, key: Hashable, value: T, now: float) -> bool:
        """True when the value may go on now; else it may be remembered until a newer one of its key comes."""
        due = self._due.get(key, now)
        if now < due:
            if self._remembers:
                self._passed_over[key] = value
            return False
        self._due[key] = max(due, now - self._period_s) + self._period_s
        self._due.move_to_end(key)
        self._passed_over.pop(key, None)
        if len(self._due) > MAX_KEYS:
            oldest, _ = self._due.popitem(last=False)
            self._passed_over.pop(oldest, None)
        return True

    def overdue(self, now: float) -> list[T]:
        """The newest values that were passed over and may go on by now, each once."""
        keys = [key for key in self._passed_over if now >= self._due.get(key, now)]
        for key in keys:
            self._due[key] = now + self._period_s
            self._due.move_to_end(key)
        return [self._passed_over.pop(key) for key in keys]
