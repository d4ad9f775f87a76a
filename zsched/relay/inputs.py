"""Carries one input stream of this node to the task's owner: keeps the last values, warms up, flips.

Knows: which slots are open and which one the stream feeds. Does not know: why or when (the task tells it).

Everything happens under the stream's lock, the sample that just came included: between the kept values that a flip
sends and the first sample behind it there is no gap. A kept value reaches a new owner at least once; it may have
reached the old one too.
"""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
from dataclasses import dataclass
from typing import Final

import zenoh
from zenoh import Sample, Session

from zsched.clock import monotonic_s
from zsched.core.plan import Route, StreamClass, StreamCount
from zsched.relay.counter import StreamCounter
from zsched.relay.outlet import Outlet
from zsched.relay.receive import Receiver

MAX_KEYS: Final = 4096
"""Concrete keys of one wildcard stream whose values are kept; the oldest give way."""
REPEAT_AFTER_S: Final = 0.5
"""Silence after which a ``latest`` value that came in a burst is put once more."""

_Kept = tuple[int, Sample]


@dataclass(slots=True)
class _InputSlot:
    outlet: Outlet
    sent: int = 0
    """Number of the newest sample that went into this slot; kept values above it are still owed."""


class InputStream:
    """One input rule on this node; slots are named by their epoch."""

    def __init__(self, session: Session, route: Route, own_ids: frozenset[str]) -> None:
        self.route = route
        self._session = session
        self._own_ids = own_ids
        self._lock = threading.Lock()
        self._counter = StreamCounter(route.stream)
        self._slots: dict[int, _InputSlot] = {}
        self._active: _InputSlot | None = None
        self._number = 0
        is_latest = route.settings.stream_class is StreamClass.LATEST
        self._keep_last = route.settings.keep_last if is_latest else 0
        self._kept: OrderedDict[str, deque[_Kept]] = OrderedDict()
        self._last_at = -REPEAT_AFTER_S
        self._is_repeat_due = False
        self._receiver = Receiver(session, route.from_expr, route.settings, self._carry, with_history=True)

    def open(self, epoch: int, route: Route) -> None:
        """Declare the publishers of a slot; it carries nothing yet.

        Raises:
            ValueError, zenoh.ZError: the route makes no sense (see `Outlet`).
        """
        outlet = Outlet(self._session, route.from_expr, route.to_expr, route.settings)
        with self._lock:
            self._slots[epoch] = _InputSlot(outlet=outlet)

    def is_matching(self, epoch: int) -> bool:
        """True when somebody subscribes to the slot's keys."""
        slot = self._slots.get(epoch)
        return slot is not None and slot.outlet.is_matching

    def warm_up(self, epoch: int) -> int:
        """Send every kept value to a worker that has just become ready (again); answers how many."""
        with self._lock:
            slot = self._slots.get(epoch)
            if slot is None:
                return 0
            slot.sent = 0  # whatever went there before, this worker has not had it
            return self._catch_up(slot)

    def is_behind(self, epoch: int) -> bool:
        """True when a kept value has changed since the slot was warmed up: what it made of the old one is stale."""
        with self._lock:
            slot = self._slots.get(epoch)
            return slot is not None and any(
                number > slot.sent for values in self._kept.values() for number, _ in values
            )

    def flip(self, epoch: int) -> int:
        """Feed the slot from now on, behind the kept values it has not had; answers how many those were."""
        with self._lock:
            slot = self._slots.get(epoch)
            if slot is None or slot is self._active:
                return 0
            replayed = self._catch_up(slot)
            self._active = slot
            return replayed

    def send_end(self, epoch: int) -> None:
        """Put the end marker behind the slot's last sample (it must not be the active one); may block on its link."""
        slot = self._slots.get(epoch)
        if slot is not None and slot is not self._active:
            slot.outlet.send_end(epoch)

    def close_slot(self, epoch: int) -> None:
        """Forget a slot."""
        with self._lock:
            slot = self._slots.pop(epoch, None)
            if slot is None:
                return
            if slot is self._active:
                self._active = None
            self._counter.dropped("closed", slot.outlet.undeclare())

    def close(self) -> None:
        """Unsubscribe and close every slot."""
        self._receiver.close()
        for epoch in tuple(self._slots):
            self.close_slot(epoch)

    def repeat_if_silent(self) -> None:
        """Put the last values once more ``REPEAT_AFTER_S`` behind a burst: its newest may have been dropped."""
        with self._lock:
            if not self._is_repeat_due or self._active is None or monotonic_s() - self._last_at < REPEAT_AFTER_S:
                return
            self._is_repeat_due = False
            for values in self._kept.values():
                if values and not self._active.outlet.send(values[-1][1]):
                    self._counter.dropped("repeated")

    def count(self) -> StreamCount:
        """The counters now."""
        with self._lock:
            return self._counter.value()

    # --- one sample --------------------------------------------------------------------------------------------------

    def _carry(self, sample: Sample) -> None:
        with self._lock:
            self._counter.seen(len(sample.payload))
            if _is_own(sample, self._own_ids):
                self._counter.dropped("loop")
                return
            self._number += 1
            if self._keep_last:
                self._keep(sample)
            slot = self._active
            if slot is not None:
                slot.sent = self._number
                self._counter_drop(slot.outlet.send(sample))
            elif not self._keep_last:
                self._counter.dropped("no_route")

    def _counter_drop(self, reason: str) -> None:
        if reason:
            self._counter.dropped(reason)

    def _keep(self, sample: Sample) -> None:
        key = str(sample.key_expr)
        values = self._kept.get(key)
        if values is None:
            values = self._kept[key] = deque(maxlen=self._keep_last)
            if len(self._kept) > MAX_KEYS:
                self._kept.popitem(last=False)
        values.append((self._number, sample))
        now = monotonic_s()
        self._is_repeat_due = now - self._last_at < REPEAT_AFTER_S
        self._last_at = now

    def _catch_up(self, slot: _InputSlot) -> int:
        owed = sorted(
            (kept for values in self._kept.values() for kept in values if kept[0] > slot.sent), key=lambda kept: kept[0]
        )
        for _, sample in owed:
            self._counter_drop(slot.outlet.send(sample))
        slot.sent = self._number
        self._counter.dropped("replayed", len(owed))
        return len(owed)


def _is_own(sample: Sample, own_ids: frozenset[str]) -> bool:
    """True when a session of this process put the sample: a loop through another one of our sessions."""
    source: zenoh.SourceInfo | None = sample.source_info
    return source is not None and str(source.source_id.zid) in own_ids
