"""How much of what others send is looked at: a bucket of tokens for each peer, and drops that are counted together.

Knows: names, rates, counts. Does not know: frames, signatures.

A frame is counted before it is decoded and before its signature is checked. What is dropped wakes nobody up: counts
wait until the loop asks for them.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Iterable
from typing import Final

from zsched.core.values.fleet import Fleet, Timing
from zsched.core.values.struct import Struct
from zsched.link.keyspace import Keyspace

ROOM: Final = 20.0
"""A peer may send this many times what the timing profile lets it send at rest."""
LEAST_HZ: Final = 100.0
BURST_S: Final = 2.0
"""After a silence a peer may send what this many seconds allow at once."""
PER_TASK_HZ: Final = 10.0
"""For each task: proposals, two phases of a round, their answers, what was learnt."""
MAX_NAMES: Final = 16
EVERYBODY_ELSE: Final = ""
"""The one bucket of all names that are no node's, operator's or guest's."""


class Limit(Struct, frozen=True, kw_only=True):
    """Frames a second, and how many at once."""

    hz: float
    burst: float


def in_turn_hz(fleet: Fleet) -> dict[str, float]:
    """{key: how often} of each node's periodic frames, which wait in one ring: a flood would push out those of others.

    zenoh drops what comes sooner after the one before. It does so for each link and key.
    """
    keys, timing = Keyspace(fleet.name), fleet.timing
    beats = {keys.beat_in_turn(node.name): ROOM / timing.beat_s for node in fleet.nodes}
    return {**beats, **{keys.profile_in_turn(node.name): ROOM / timing.publish_s for node in fleet.nodes}}


def limit_for(timing: Timing, tasks: int) -> Limit:
    """What one peer may send: `ROOM` times its beats and profiles, and its part in the votes about all tasks.

    >>> limit_for(Timing(), 1).hz >= LEAST_HZ
    True
    """
    at_rest_hz = 1.0 / timing.beat_s + 1.0 / timing.publish_s
    hz = max(ROOM * at_rest_hz, LEAST_HZ) + PER_TASK_HZ * tasks
    return Limit(hz=hz, burst=hz * BURST_S)


class Buckets:
    """A token bucket for each name; any thread may take.

    Names that nobody has announced share one bucket, so that inventing names neither takes memory nor brings more.
    """

    def __init__(self, limit: Limit, names: Iterable[str]) -> None:
        self._limit = limit
        self._lock = threading.Lock()
        self._left: dict[str, tuple[float, float]] = dict.fromkeys((EVERYBODY_ELSE, *names), (limit.burst, 0.0))
        """{name: (tokens, when)}."""

    def know(self, names: Iterable[str], limit: Limit | None = None) -> None:
        """Give these names a bucket of their own, too; with a ``limit`` all have that from now on.

        A bucket that was full stays so.
        """
        with self._lock:
            if limit is not None:
                more, self._limit = max(limit.burst - self._limit.burst, 0.0), limit
                self._left = {name: (tokens + more, at) for name, (tokens, at) in self._left.items()}
            for name in names:
                self._left.setdefault(name, (self._limit.burst, 0.0))

    def take(self, name: str, now: float) -> bool:
        """Take one token; whether there was one."""
        with self._lock:
            whose = name if name in self._left else EVERYBODY_ELSE
            tokens, at = self._left[whose]
            tokens = min(tokens + max(now - at, 0.0) * self._limit.hz, self._limit.burst)
            is_there = tokens >= 1.0
            self._left[whose] = (tokens - 1.0 if is_there else tokens, now)
        return is_there


class Names:
    """Names of whom somebody will be told, until somebody takes them; more than `MAX_NAMES` are left out."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._held: set[str] = set()

    def add(self, name: str) -> None:
        """One more, unless it waits already."""
        with self._lock:
            if len(self._held) < MAX_NAMES:
                self._held.add(name)

    def take(self) -> tuple[str, ...]:
        """Those since the last call, sorted."""
        if not self._held:
            return ()
        with self._lock:
            held, self._held = self._held, set()
        return tuple(sorted(held))


class Drops:
    """Counts of what was dropped, until somebody takes them."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[tuple[str, str]] = Counter()

    def add(self, kind: str, reason: str) -> None:
        """One more."""
        with self._lock:
            self._counts[kind, reason] += 1

    def take(self) -> tuple[tuple[str, str, int], ...]:
        """(kind, reason, how many) since the last call."""
        if not self._counts:
            return ()
        with self._lock:
            counts, self._counts = self._counts, Counter()
        return tuple((kind, reason, count) for (kind, reason), count in counts.items())
