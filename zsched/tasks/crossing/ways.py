"""Gives a parcel by the first gateway of another cell that takes it.

Knows: which gateway is asked next, when to give up. Does not know: zenoh (`zsched.tasks.crossing.gateway`), roles.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from typing import Final, Protocol

from zsched.clock import monotonic_s
from zsched.tasks.crossing.parcels import Parcel, is_lasting

PAUSE_S: Final = 0.1
"""Between two rounds of all gateways."""


class Way(Protocol):
    """One gateway of the other cell."""

    endpoint: str

    def give(self, parcel: Parcel) -> str:
        """Empty: it was taken there; else why not."""

    def reach(self) -> str:
        """Empty: a taker answers there; else why not."""


class Ways:
    """The gateways of one cell; the one that took last is asked first."""

    def __init__(self, ways: Iterable[Way], clock: Callable[[], float] = monotonic_s) -> None:
        self._ways = deque(ways)
        self._clock = clock

    def give(self, parcel: Parcel, patience_s: float, goes_on: Callable[[float], bool]) -> str:
        """Try for at most ``patience_s``, a round at least; empty: it was taken; else why not, by gateway.

        What is refused for good is not tried again: the samples behind it would wait.
        ``goes_on(pause_s)`` waits so long between two rounds, and says whether there is another one.
        """
        end = self._clock() + patience_s
        while why := self._round(lambda way: way.give(parcel)):
            if is_lasting(why) or self._clock() >= end or not goes_on(PAUSE_S):
                return why
        return ""

    def reach(self) -> str:
        """Empty: a taker answers at one of the gateways; else why not, by gateway."""
        return self._round(lambda way: way.reach())

    def _round(self, ask: Callable[[Way], str]) -> str:
        whys = []
        for _ in range(len(self._ways)):
            why = ask(self._ways[0])
            if not why:
                return ""
            whys.append(f"at {self._ways[0].endpoint} {why}")
            if is_lasting(why):
                break
            self._ways.rotate(-1)
        return "; ".join(whys)
