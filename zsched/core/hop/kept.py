"""What a publisher keeps of what it has sent, in the order of its numbers, to put it again; and what is put again.

Knows: numbers, sizes, bounds. Does not know: receivers (`zsched.core.hop.sender` has one, `zsched.core.hop.shared`
many), what a sample is, how it is put.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from itertools import islice
from typing import Any, Final, NamedTuple

from zsched.core.values.relay_protocol import EndMarker

RESEND_S: Final = 0.3
"""What is not acknowledged is put again when nothing has moved for this time, at the earliest."""


class Sent(NamedTuple):
    """A sample that went out under ``number`` and is kept (a tuple: one is made for every sample)."""

    number: int
    sample: Any
    """Whatever its publisher needs to put it again."""
    stamp: Any
    size: int
    at: float
    """When its put had returned, or was about to begin (monotonic seconds)."""
    took_s: float = 0.0
    """How long the put waited for the link."""


class Owed(NamedTuple):
    """What a receiver is to be put now, in this order."""

    start: int | None = None
    """It is told once more where the stream begins: the lowest number that may come."""
    skip: int | None = None
    """It must not wait for the numbers below this one: they are given up, since nobody keeps them, or it has them."""
    again: tuple[Sent, ...] = ()
    """These go out again, under the numbers that they had."""
    end: EndMarker | None = None
    """It lacks nothing but the end marker."""


NOTHING: Final = Owed()


class Kept:
    """The newest samples of one publisher; the numbers have no gap."""

    __slots__ = ("_samples", "size")

    def __init__(self) -> None:
        self._samples: deque[Sent] = deque()
        self.size = 0
        """Bytes."""

    def __len__(self) -> int:
        return len(self._samples)

    def __iter__(self) -> Iterator[Sent]:
        return iter(self._samples)

    def keep(self, sent: Sent, *, samples: int, least: int, size: int) -> None:
        """Keep what was just put: at most ``samples`` samples and ``size`` bytes, but ``least`` of them; oldest go."""
        kept = self._samples
        kept.append(sent)
        self.size += sent.size
        while len(kept) > samples or (self.size > size and len(kept) > least):
            self.size -= kept.popleft().size

    def let_go(self, limit: int) -> list[Sent]:
        """Let go of everything below a number; answers it."""
        gone: list[Sent] = []
        kept = self._samples
        while kept and kept[0].number < limit:
            gone.append(kept.popleft())
            self.size -= gone[-1].size
        return gone

    def let_go_before(self, at: float) -> None:
        """Let go of everything that was put before a time."""
        while self._samples and self._samples[0].at < at:
            self.size -= self._samples.popleft().size

    def take_back(self, sent: Sent) -> None:
        """Keep the newest of what was let go of again."""
        self._samples.appendleft(sent)
        self.size += sent.size

    def first(self, count: int) -> int:
        """The lowest number that is kept; ``count``, the next one of all, when nothing is."""
        return self._samples[0].number if self._samples else count

    def at(self, number: int) -> float | None:
        """When the sample of a number was put; ``None``: it is not kept."""
        index = number - self.first(number)
        return self._samples[index].at if 0 <= index < len(self._samples) else None

    def owed(self, start: int, until: int, waits_for: int, *, samples: int | None = None, size: int = 0) -> Owed:
        """What goes again of the numbers from ``start`` to before ``until``, to a receiver that waits for a number.

        With ``samples`` at most this many of them, and nothing more behind ``size`` bytes.
        """
        chosen: list[Sent] = []
        total = 0
        for one in islice(self._samples, max(0, start - self.first(start)), None):
            if one.number >= until or (samples is not None and (len(chosen) >= samples or total > size)):
                break
            chosen.append(one)
            total += one.size
        first = chosen[0].number if chosen else until
        return Owed(skip=first if first > waits_for else None, again=tuple(chosen))
