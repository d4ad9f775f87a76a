"""Tells the publishers of a key apart: each has values of class ``latest`` of its own, as in ROS.

Knows: which publishers a key has, which of them have gone. Does not know: what is kept, how it goes on. Its owner's
lock guards it.

A publisher that numbers its samples has a place among those of its key, 0, 1 and so on. One that comes takes the place
of one that has gone: a program that begins again replaces its own values, and nobody else's. Whoever gives no numbers
keeps nothing itself: all of them together have place 0.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from typing import Final

from zenoh import Sample

from zsched.core.values.struct import Struct
from zsched.host.clock import monotonic_s

MAX_KEYS: Final = 4096
MAX_PLACES: Final = 256
"""Publishers of a key that are told apart; then the one that was heard longest ago gives way."""
QUIET_S: Final = 1.0
"""A publisher whose token was never seen has gone when another one comes after it has put nothing for this long."""

PublisherId = tuple[str, int]
"""(session, number there)."""


class _Held(Struct):
    place: int
    heard_at: float


class Places:
    """The places of the publishers of each key."""

    def __init__(self, is_there: Callable[[PublisherId], bool | None]) -> None:
        """``is_there``: whether a publisher shows the token of its cache; ``None``: it never has."""
        self._is_there = is_there
        self._keys: OrderedDict[str, dict[PublisherId, _Held]] = OrderedDict()

    def of(self, sample: Sample) -> int:
        """The place of a sample's publisher among those of its key."""
        info = sample.source_info
        if info is None:
            return 0
        key, publisher, now = str(sample.key_expr), (str(info.source_id.zid), info.source_id.eid), monotonic_s()
        known = self._keys.get(key)
        if known is None:
            known = self._keys[key] = {}
            if len(self._keys) > MAX_KEYS:
                self._keys.popitem(last=False)
        held = known.get(publisher)
        if held is None:
            held = known[publisher] = _Held(self._free(known, now), now)
        held.heard_at = now
        return held.place

    def clear(self) -> None:
        """All have gone."""
        self._keys.clear()

    def _free(self, known: dict[PublisherId, _Held], now: float) -> int:
        gone = [one for one, held in known.items() if self._has_gone(one, now - held.heard_at)]
        if not gone and len(known) >= MAX_PLACES:
            gone = [min(known, key=lambda one: known[one].heard_at)]
        return known.pop(min(gone, key=lambda one: known[one].place)).place if gone else len(known)

    def _has_gone(self, publisher: PublisherId, quiet_s: float) -> bool:
        is_there = self._is_there(publisher)
        return quiet_s > QUIET_S if is_there is None else not is_there
