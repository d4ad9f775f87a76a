"""What a worker processed while it was not the owner: kept for the day it is, then given back in order.

Knows: which samples wait, their order, bounds. Does not know: roles, epochs, threads (the dispatcher's lock guards it).

A sample whose output was withheld because the worker was not the owner (a warm-up, or one that outran the role) is kept
and processed again when it becomes the owner: else the newest map of a crashed owner would have no result at all.
So is, where a predecessor's state takes the place of its own, every sample processed before: it was sent to nobody else
(a flip waits only so long for the role), and what it had done to the state is gone.

Every sample has a *turn*, its place among all that were ever taken. What is given back goes by turns, and nothing of a
later turn may be answered before it: neither the sample that is in hand when the worker becomes the owner, nor what was
given back already when the role comes a second time.

A robot counts what a slot left open as lost when the slot closes, or gives it to the next owner; then nobody may do
it later, behind newer work. It says so to the worker that had it; a word that does not arrive (the link was broken, the
robot's relay died) is replaced by `STALE_S`.
"""

from __future__ import annotations

from bisect import insort
from collections import deque
from operator import attrgetter
from typing import Final, Generic, NamedTuple, Protocol, TypeVar

import zenoh

from zsched.core.hop.receiver import SourceName
from zsched.link.weight import weight
from zsched.worker.keep import Held

MAX_WITHHELD: Final = 256
"""Samples per key of an input without ``keep_last`` that a predecessor's state may want again."""
MAX_BACKLOG: Final = 4096
MAX_BACKLOG_BYTES: Final = 32 << 20
"""Of such an input, whose output was withheld, that are kept for the day this worker becomes the owner; older ones are
lost, and said to be."""
MAX_KEYS: Final = 8192
"""Keys of which something is kept: a wildcard input hears any number of them, of strangers too..."""
ROOM_SHARE: Final = 16
"""...and this share of them gives way at a time: first those of which everything has its result, the oldest first."""
STALE_S: Final = 2.5
"""What was withheld for this long before a newer epoch begins is given up; until then the robot may still be at
its slot (as `zsched.worker.epochs.CARRY_S`)."""
QUIET_S: Final = 10.0
"""What was processed longer ago than this came with another move, or the predecessor had it, too."""

_turn_of = attrgetter("turn")


class Source(Protocol):
    """An input: what of it is kept; ``is_whole``: the sample's publisher is of class ``reliable``."""

    def newest(self, *, is_whole: bool) -> int | None:
        """How many samples of a key are kept, ``None``: all."""

    def wants(self, *, is_whole: bool) -> bool:
        """Whether a sample that gives way is lost."""


SourceT = TypeVar("SourceT", bound=Source)


class Done(NamedTuple, Generic[SourceT]):
    """A sample processed while this worker was not the owner."""

    source: SourceT
    sample: zenoh.Sample
    turn: int
    epoch: int
    """The epoch in which its publisher was first heard."""
    quiet_at: float | None = None
    """When it was processed, if nothing was withheld of it: it counts where the state that it went into is replaced."""
    replayed: bool = False
    name: SourceName | None = None
    is_whole: bool = False
    """Its publisher is of class ``reliable``."""
    held: Held | None = None
    """What waits until it has been answered."""
    slot: int = 0
    """The epoch that it was sent in, 0: its publisher has not said."""
    at: float = 0.0
    """When it was first processed."""

    def is_over(self, *, is_restored: bool, now: float) -> bool:
        """True when it need not be processed again."""
        return self.quiet_at is not None and not (is_restored and now - self.quiet_at < QUIET_S)

    @property
    def is_lost(self) -> bool:
        """Whether it is, when it gives way now, and has to be told of."""
        is_wanted = self.quiet_at is None and self.source.wants(is_whole=self.is_whole)
        return is_wanted and self.name is not None

    def is_open(self, name: SourceName) -> bool:
        """Whether it is this publisher's, and what it was answered was withheld."""
        return self.name == name and self.quiet_at is None

    def is_stale(self, epoch: int, now: float) -> bool:
        """True when it is too late for it in ``epoch``: it was sent in an older one, long ago, and has no answer."""
        return self.quiet_at is None and 0 < self.slot < epoch and now - self.at > STALE_S


class StandbyInputs(Generic[SourceT]):
    """Samples that are *kept* until the worker becomes the owner, and samples that are to be processed *again*."""

    def __init__(self) -> None:
        self._kept: dict[tuple[int, SourceName | str], deque[Done[SourceT]]] = {}
        """{input and publisher: what is kept of it, never nothing}, the one that was heard last at the end."""
        self._bytes = 0
        self._again: deque[Done[SourceT]] = deque()

    @property
    def is_due(self) -> bool:
        """True while something is to be processed again."""
        return bool(self._again)

    def owes(self, epoch: int) -> bool:
        """Whether a sample of the epoch, or an older one, is still to be answered."""
        return any(done.epoch <= epoch and done.quiet_at is None for done in self._again)

    def is_before(self, turn: int) -> bool:
        """Whether a sample of an earlier turn is still to be processed again (the dispatch thread needs no lock)."""
        again = self._again  # replaced whole by other threads
        return bool(again) and again[0].turn < turn

    def keep(self, done: Done[SourceT]) -> list[Done[SourceT]]:
        """Keep a sample; answers those that gave way to it unanswered, and are lost."""
        source = done.source
        name = id(source), done.name or str(done.sample.key_expr)
        line = self._kept.pop(name, deque())
        self._kept[name] = line
        line.append(done)
        self._bytes += weight(done.sample)
        limit = source.newest(is_whole=done.is_whole) or (MAX_BACKLOG if done.quiet_at is None else MAX_WITHHELD)
        given_up = []
        while len(line) > limit or (self._bytes > MAX_BACKLOG_BYTES and len(line) > 1):
            given_up.append(line.popleft())
            self._bytes -= weight(given_up[-1].sample)
        if len(self._kept) > MAX_KEYS:
            given_up += self._make_room(name)
        return [one for one in given_up if one.is_lost]

    def _make_room(self, newest: tuple[int, SourceName | str]) -> list[Done[SourceT]]:
        """Let go of keys; answers what was kept of them."""
        others = [name for name in self._kept if name != newest]
        others.sort(key=lambda name: any(done.quiet_at is None for done in self._kept[name]))
        gone = [done for name in others[: max(1, MAX_KEYS // ROOM_SHARE)] for done in self._kept.pop(name)]
        self._bytes -= sum(weight(done.sample) for done in gone)
        return gone

    def stale(self, epoch: int, now: float) -> set[SourceName]:
        """The publishers of what is too old to be done in ``epoch``."""
        waiting = [*self._again, *(done for line in self._kept.values() for done in line)]
        return {done.name for done in waiting if done.name is not None and done.is_stale(epoch, now)}

    def forget(self, name: SourceName) -> int:
        """Let go of what one publisher has no answer to; answers how many samples that was."""
        before = len(self._again) + sum(len(line) for line in self._kept.values())
        self._again = deque(done for done in self._again if not done.is_open(name))
        for key, line in tuple(self._kept.items()):
            left = deque(done for done in line if not done.is_open(name))
            if left:
                self._kept[key] = left
            else:
                del self._kept[key]
            self._bytes -= sum(weight(done.sample) for done in line) - sum(weight(one.sample) for one in left)
        return before - len(self._again) - sum(len(line) for line in self._kept.values())

    def begin(self, *, is_settled: bool = False) -> None:
        """This worker is the owner: everything that is kept is to be processed again.

        ``is_settled``: no other state is on its way, so what has its result is not. What was to be processed again
        before still is: a lease begins an epoch once more, also while a state that has come is caught up with.
        """
        kept = (done for line in self._kept.values() for done in line if not is_settled or done.quiet_at is None)
        self._again = deque(sorted((*self._again, *kept), key=_turn_of))
        self._kept.clear()
        self._bytes = 0

    def settle(self, *, is_restored: bool, now: float) -> None:
        """The worker's state stays, or a predecessor's has taken its place: let go of what has its result."""
        self._again = deque(done for done in self._again if not done.is_over(is_restored=is_restored, now=now))

    def take(self) -> Done[SourceT] | None:
        """The next sample that is to be processed again."""
        return self._again.popleft() if self._again else None

    def put_back(self, done: Done[SourceT]) -> None:
        """A sample was withheld although the worker became the owner meanwhile: it is processed again in its turn."""
        insort(self._again, done, key=_turn_of)
