"""Decides when the lanes of a ``reliable`` outlet may send: greets each receiver and waits for its answer.

Knows: which lanes nobody has answered for yet, how long to wait for an answer. Does not know: samples, slots, what the
answer leads to (`zsched.core.hop.sender`).

A start marker (an end marker of epoch 0) says the lowest number that may still come; `zsched.worker` acknowledges it at
once. A subscriber that never answers is no `zsched.worker`: after `FOREIGN_S`, longer than any lease of a frozen
process, or after `STRANGE_S` where the worker answers for other keys, its samples go out and are counted ``uncounted``.
A worker may stand still for a second, too: so it is asked for a key that it has answered for, and must have said
something meanwhile.
The outlet's lock guards what it holds; `greet` is called in the queue's thread only, because its puts may block.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping
from typing import Any, Final

from zsched.host.clock import monotonic_s
from zsched.link.sessions.matching import is_matched
from zsched.relay.streams.lanes import Lane

STRANGE_S: Final = 1.0
FOREIGN_S: Final = 10.0
ASK_S: Final = 0.2
"""A worker that says nothing is asked this often, at most."""


class Greetings:
    """The lanes of one outlet whose receiver has not answered."""

    def __init__(self, lock: threading.Lock, put_start: Callable[[Lane, int], None]) -> None:
        """``put_start`` puts the start marker of a lane with the lowest number that may come; it may block."""
        self._lock = lock
        self._put_start = put_start
        self._unmet: dict[int, Lane] = {}
        self._is_away = False
        self._is_parted = False
        self._known: Lane | None = None
        """The lane that the worker has answered for last..."""
        self._heard_at = -math.inf
        """...and when it said something."""
        self._asked_at = -math.inf

    @property
    def is_waiting(self) -> bool:
        """Whether an answer is awaited."""
        return bool(self._unmet)

    def add(self, lane: Lane) -> None:
        """A lane is new, or its receiver is (under the lock)."""
        if lane.eid not in self._unmet:
            lane.part(monotonic_s())
            self._unmet[lane.eid] = lane

    def forget(self, lane: Lane) -> None:
        """A lane is given back (under the lock)."""
        self._unmet.pop(lane.eid, None)
        if self._known is lane:
            self._known = None

    def heard(self, lane: Lane) -> None:
        """A lane's receiver has said something (under the lock): whether it is met by that, or must be greeted."""
        if lane.is_met:
            self._known, self._heard_at = lane, monotonic_s()
            self._unmet.pop(lane.eid, None)
        else:
            self.add(lane)

    def part(self, *, is_parted: bool) -> None:
        """The worker's token went (nothing goes out until another one comes), or a new one came."""
        self._is_parted = is_parted
        self._is_away = True

    def is_there(self, lanes: Mapping[Any, Lane], *, is_matching: bool) -> bool:
        """Whether there is somebody to greet; a worker that was away is greeted again."""
        if not is_matching or self._is_parted:
            self._is_away = True
            return False
        if self._is_away:
            self._is_away = False
            with self._lock:
                now = monotonic_s()
                for lane in lanes.values():
                    lane.part(now)
                    self._unmet[lane.eid] = lane
        return True

    def greet(self, lane_count: int) -> bool:
        """Greet whose answer is due; true when nobody's is awaited any more."""
        now = monotonic_s()
        with self._lock:
            unmet = tuple(self._unmet.values())
        has_others = len(unmet) < lane_count
        for lane in unmet:
            with self._lock:
                lowest = lane.take_greeting(now)
            if lowest is not None:
                self._put_start(lane, lowest)
            if self._is_foreign(lane, now, has_others=has_others):
                with self._lock:
                    if not lane.is_met:
                        lane.is_foreign = True
                        self._unmet.pop(lane.eid, None)
        return not self._unmet

    def _is_foreign(self, lane: Lane, now: float, *, has_others: bool) -> bool:
        """Whether a lane's receiver will not answer any more; ``has_others``: the worker answers for other keys."""
        if has_others and not is_matched(lane.publisher):
            return True
        waited_s = now - lane.unmet_since
        if has_others and waited_s > STRANGE_S / 2 and self._heard_at - lane.unmet_since <= STRANGE_S / 2:
            self._ask(now)
        elif has_others and waited_s > STRANGE_S:
            return True
        return waited_s > FOREIGN_S

    def _ask(self, now: float) -> None:
        """Have the worker say something of a key that it has answered for."""
        with self._lock:
            known = self._known
            lowest = None if known is None or now - self._asked_at < ASK_S else known.lowest
        if known is not None and lowest is not None:
            self._asked_at = now
            self._put_start(known, lowest)
