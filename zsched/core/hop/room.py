"""Decides how large a data link's send buffer is: what it holds shall be gone within `AHEAD_S`.

Knows: what TCP counts about one link, when. Does not know: sockets, streams, who is at the other end.

What is put lies behind what the buffer holds. Before a thin radio that has to be little; a fast link with a small
buffer waits for each acknowledgement, over TLS for 0.2 to 0.4 s at times. So a buffer grows by steps while more than
it holds passes between two looks. How fast its link is shows where the buffer was never empty between two looks: then
it gets the size that fits, and grows by steps again after a pause. TCP's own figures do not tell: its rate keeps its
highest value while the buffer is the limit, and its busy time counts each small sample's wait for an acknowledgement.
"""

from __future__ import annotations

from typing import Final

from zsched.core.values.struct import Struct

SMALL: Final = 65536
"""What a buffer holds, in bytes, until its link has shown that it is faster."""
LARGE: Final = 1 << 19
"""The largest size that we set; a link that deserves twice as much gets `OWN`."""
OWN: Final = 0
"""The kernel chooses: twice the window that TCP has measured."""
AHEAD_S: Final = 0.02
"""So long may what is put wait for what the buffer holds, beyond the round trips that it needs anyway."""
STALE_S: Final = 0.6
"""Of looks that are further apart (beyond two round trips) nobody knows what was between."""
SLOW_TIMES: Final = 2
"""A buffer shrinks when its link was too slow for it so many looks in succession..."""
BACKLOG_S: Final = 0.7
"""...or since its buffer began to hold something all the time, this long ago. TLS and lost packets pause for 0.4 s."""
PAUSE_S, MAX_PAUSE_S = 2.0, 64.0
"""After it shrank it grows by steps no sooner; twice as long each time."""


class Account(Struct, frozen=True):
    """What TCP has counted about a link."""

    acked: int
    """Bytes that the other end has taken since the link began."""
    held: int
    """Bytes that the buffer holds now."""
    round_trip_s: float
    """The shortest of late; 0: not measured."""


class Room:
    """The send buffer of one link."""

    def __init__(self) -> None:
        """Small, until the link has shown how fast it is."""
        self.size = SMALL
        """In bytes, or `OWN`."""
        self._last: tuple[Account, float] | None = None
        self._backlog: tuple[int, float] | None = None
        """(acknowledged then, since when the buffer was never nearly empty)."""
        self._has_paused = False
        self._slow = 0
        self._grows_at = 0.0
        self._pause_s = PAUSE_S

    def look(self, seen: Account, now: float) -> int:
        """How large the buffer should be from now on, in bytes or `OWN`; call it a few times a second."""
        if self._last is None:
            self._last = seen, now
            return self.size
        last, passed_s = self._last[0], now - self._last[1]
        if passed_s <= 1.5 * seen.round_trip_s:
            return self.size  # acknowledgements come in bursts
        self._last = seen, now
        acked = seen.acked - last.acked
        is_close = passed_s <= STALE_S + 2 * seen.round_trip_s
        had_backlog = is_close and last.held > SMALL // 2
        has_paused, self._has_paused = self._has_paused, had_backlog and acked == 0
        if self._is_backlog(seen, now, had_backlog=had_backlog):
            return self.size
        if had_backlog and (acked < last.held or seen.held > SMALL // 2):
            if not self._has_paused and not has_paused:  # else it says how long the pause was
                self._fit_twice(_fitting(acked / passed_s, seen.round_trip_s), now)
                return self.size
        elif acked >= 2 * self.size and self.size != OWN and now >= self._grows_at:
            shown = _fitting(acked / passed_s, seen.round_trip_s)  # it is at least so fast
            self._grow(max(OWN if self.size >= LARGE else 2 * self.size, shown, key=_order))
        self._slow = 0
        return self.size

    def _is_backlog(self, seen: Account, now: float, *, had_backlog: bool) -> bool:
        """Whether the buffer has just been fitted to what went out of it for `BACKLOG_S` and two round trips."""
        if seen.held <= SMALL // 2:
            self._backlog = None
            return False
        if self._backlog is None or not had_backlog:
            self._backlog = seen.acked, now
            return False
        acked, since = self._backlog
        if now - since < BACKLOG_S + 2 * seen.round_trip_s:
            return False
        self._backlog = seen.acked, now
        self._fit(_fitting((seen.acked - acked) / (now - since), seen.round_trip_s), now)
        return True

    def _fit_twice(self, wanted: int, now: float) -> None:
        if _order(wanted) < _order(self.size) and self._slow + 1 < SLOW_TIMES:
            self._slow += 1
        else:
            self._fit(wanted, now)

    def _fit(self, wanted: int, now: float) -> None:
        """The link had something to send all the time, and this is the size for what it took."""
        if _order(wanted) >= _order(self.size):
            self._grow(wanted)
            return
        self.size, self._slow = wanted, 0
        self._grows_at = now + self._pause_s
        self._pause_s = min(2 * self._pause_s, MAX_PAUSE_S)

    def _grow(self, size: int) -> None:
        self._slow, self.size = 0, size
        if size == OWN:
            self._pause_s = PAUSE_S


def _fitting(rate: float, round_trip_s: float) -> int:
    """The size for a link of so many bytes a second.

    A buffer is the limit itself where a round trip takes long: two of them let it grow.
    """
    wanted = rate * (AHEAD_S + 2 * round_trip_s)
    if wanted >= 2 * LARGE:
        return OWN
    size = SMALL
    while 2 * size <= min(wanted, LARGE):
        size *= 2
    return size


def _order(size: int) -> int:
    return 2 * LARGE if size == OWN else size
