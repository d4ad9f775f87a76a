"""One output's answers that are kept, and how far each robot's relay is with them.

Knows: numbers, acknowledgements, who lacks what, for whom an input waits. Does not know: sessions, when to send again
(`zsched.worker.keep`), which inputs wait (`zsched.worker.debts`).

An input waits for its answers: for its own robot until that has them, wants no more of them, or is forgotten; for any
other robot while it comes further, since a frozen one must not stop the inputs of the others.

Anybody can acknowledge under any relay's name. So a lane remembers at most `MAX_RECEIVERS` of them.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from dataclasses import dataclass, field
from itertools import islice
from typing import Any, Final

import zenoh

from zsched.clock import monotonic_s
from zsched.core.hop.serial import number_near, serial_of
from zsched.core.relay_protocol import EndMarker, StreamAck

KEPT_BYTES: Final = 32 << 20
RESEND_S: Final = 0.3
FORGET_S: Final = 10.0
MAX_RECEIVERS: Final = 256
"""Relays that a lane remembers; beyond, the longest silent one goes, first of those that were never reached."""
NEWCOMERS_S: Final = 3.0
"""So long after an epoch's first answer a robot may begin with it: one that learnt of the move late, or had no link."""
STALLED_S: Final = 1.0
"""A robot that lacks answers and has not come further for so long is stalled: no other robot's input waits for it."""
BATCH: Final = 512
BATCH_BYTES: Final = 4 << 20
"""So much is sent again at one time; progress brings the next."""

_log = logging.getLogger("zsched.worker")


@dataclass(frozen=True, slots=True)
class Kept:
    """An answer that is kept."""

    number: int
    payload: Any
    attachment: Any
    encoding: Any
    stamp: zenoh.Timestamp | None
    size: int
    at: float


@dataclass(slots=True, eq=False)
class Receiver:
    """A relay that acknowledges: ``arrived`` is the number it comes to next."""

    node: str
    arrived: int = 0
    had: int | None = None
    """The numbers below this one an earlier life of it has acknowledged; it is not sent them."""
    waits_for: int = 0
    """What it comes to next by its own word: a new life begins at 0."""
    moved_at: float = 0.0
    pause_s: float = RESEND_S
    batch_end: int | None = None
    unreached_since: float | None = None
    heard_at: float = 0.0
    owes_since: float | None = None
    """Since when it lacks something and has not come further."""
    is_ended: bool = False
    has_left: bool = False
    """It wants nothing more."""
    is_confirmed: bool = False
    """It was seen to subscribe to what is sent again."""
    publisher: zenoh.Publisher | None = None
    """Of what is sent again; there while something is owed."""

    def is_awaited(self, now: float, *, is_own: bool) -> bool:
        """Whether an input waits until it has the answers; ``is_own``: the input came from it."""
        is_moving = self.owes_since is None or now - self.owes_since <= STALLED_S
        return not self.has_left and (is_own or is_moving)

    def note_debt(self, count: int, now: float, *, has_moved: bool) -> None:
        """Note since when it stands still with less than ``count`` answers."""
        if self.arrived >= count:
            self.owes_since = None
        elif has_moved or self.owes_since is None:
            self.owes_since = now


@dataclass(slots=True, eq=False)
class Expected:
    """A relay whose inputs answers were made of, and that has acknowledged none: it may not be told of them at all."""

    since: float
    publisher: zenoh.Publisher | None = None
    """Matches where the relay subscribes; there until that is known."""
    is_decided: bool = False
    """It is a receiver by now, or does not subscribe."""


@dataclass(slots=True, eq=False)
class KeptLane:
    """One publisher's answers. Its lock guards it; `keep` may be called from any thread, the rest is the keeper's."""

    key: str
    source_id: zenoh.EntityGlobalId
    limit: int
    wake: threading.Event
    lock: threading.Lock = field(default_factory=threading.Lock)
    kept: deque[Kept] = field(default_factory=deque)
    size: int = 0
    count: int = 0
    receivers: dict[str, Receiver] = field(default_factory=dict)
    expected: dict[str, Expected] = field(default_factory=dict)
    """{relay that may come to be a receiver: what is known of it}."""
    had: dict[str, tuple[str, int]] = field(default_factory=dict)
    """{relay that was forgotten: (its node, how far it has acknowledged)}, the oldest first."""
    end: EndMarker | None = None
    ended_at: float = 0.0
    began_at: float | None = None
    is_closed: bool = False
    is_over: bool = False
    """Nobody looks after it any more: there is nothing left to do."""
    crowded_out: int = 0
    """Relays that were forgotten for want of room."""
    gone: list[Receiver] = field(default_factory=list)
    """Relays that were forgotten, their publishers not given back yet."""

    def keep(self, number: int, payload: Any, attachment: Any, encoding: Any, stamp: Any, size: int) -> None:
        """Keep what is about to be put under a number; the oldest give way."""
        now = monotonic_s()
        with self.lock:
            self.count, self.end = number + 1, None
            self.began_at = now if self.began_at is None else self.began_at
            self.kept.append(Kept(number, payload, attachment, encoding, stamp, size, now))
            self.size += size
            while len(self.kept) > self.limit or (self.size > KEPT_BYTES and len(self.kept) > 1):
                self.size -= self.kept.popleft().size
        if not self.wake.is_set():
            self.wake.set()

    def note_end(self, marker: EndMarker) -> None:
        """The end marker was put behind the last answer."""
        with self.lock:
            self.end, self.ended_at = marker, monotonic_s()
        self.wake.set()

    def acknowledge(self, relay: str, node: str, ack: StreamAck, now: float) -> tuple[Receiver, bool]:
        """Take a relay's word; answers (it, whether it has come further)."""
        with self.lock:
            receiver = self.receivers.get(relay)
            if receiver is None:  # a relay that restarted is another session of the same node
                for old in [name for name, one in self.receivers.items() if one.node == node]:
                    self.forget(old)
                if len(self.receivers) >= MAX_RECEIVERS:
                    self._make_room()
                receiver = self.receivers[relay] = Receiver(node=node, arrived=-1, had=self._had_by(relay, node))
            # one that came late knows the lowest bits only; nobody can have more than was sent
            receiver.waits_for = min(number_near(serial_of(ack.arrived), self.count), self.count)
            arrived = max(receiver.waits_for, receiver.had or 0)
            has_moved = arrived > receiver.arrived
            receiver.heard_at, receiver.is_ended, receiver.has_left = now, ack.is_ended, ack.has_left
            if has_moved:
                receiver.arrived, receiver.moved_at, receiver.pause_s = arrived, now, RESEND_S
            receiver.note_debt(self.count, now, has_moved=has_moved)
            self._let_go(now)
            return receiver, has_moved

    def settled(self, relay: str, now: float) -> int:
        """The answers below this number have reached everybody for whom an input of ``relay`` waits."""
        with self.lock:
            if self.is_over:
                return self.count
            awaited = [one for name, one in self.receivers.items() if one.is_awaited(now, is_own=name == relay)]
            is_known = relay in self.receivers or relay in self.had
            low = self.count if is_known or not self._is_expected(relay, now) else 0
            return min((one.arrived for one in awaited), default=low) if low else 0

    def _is_expected(self, relay: str, now: float) -> bool:
        expected = self.expected.get(relay)
        if expected is None:
            if len(self.expected) >= MAX_RECEIVERS:
                return False
            expected = self.expected[relay] = Expected(since=now)
        return not expected.is_decided

    def note_debts(self, now: float) -> None:
        """Note which receivers stand still."""
        with self.lock:
            for one in self.receivers.values():
                one.note_debt(self.count, now, has_moved=False)

    def forget(self, relay: str) -> None:
        """A relay is another one by now, or cannot be reached (under the lock); what it had is remembered."""
        gone = self.receivers.pop(relay, None)
        if gone is None:
            return
        self.gone.append(gone)
        self.had[relay] = (gone.node, gone.arrived)
        if len(self.had) > MAX_RECEIVERS:
            self.had.pop(next(iter(self.had)))

    def _had_by(self, relay: str, node: str) -> int | None:
        """How far a relay's node has come by another relay, ``None``: by none; one that is known knows it itself."""
        if self.had.pop(relay, None) is not None:
            return None
        return max((arrived for of, arrived in self.had.values() if of == node), default=None)

    def _make_room(self) -> None:
        least = min(self.receivers, key=lambda name: (self.receivers[name].is_confirmed, self.receivers[name].heard_at))
        self.forget(least)
        self.crowded_out += 1
        if self.crowded_out == 1:
            _log.warning("%s: more than %d relays acknowledge answers: some are strangers", self.key, MAX_RECEIVERS)

    def take_gone(self) -> list[Receiver]:
        """Relays that were forgotten since the last time."""
        with self.lock:
            gone, self.gone = self.gone, []
            return gone

    def _let_go(self, now: float) -> None:
        """Of what every relay that we know of has, once those that we do not know have had time to come."""
        if not self.receivers or (self.began_at is not None and now - self.began_at < NEWCOMERS_S):
            return
        low = min(one.arrived for one in self.receivers.values())
        while self.kept and self.kept[0].number < low:
            self.size -= self.kept.popleft().size

    def wanted(self, start: int, until: int) -> tuple[Kept, ...]:
        """What is kept of the numbers from ``start`` to before ``until``, as much as goes at one time."""
        with self.lock:
            first = self.kept[0].number if self.kept else self.count
            chosen: list[Kept] = []
            size = 0
            for one in islice(self.kept, max(0, start - first), None):
                if one.number >= until or len(chosen) >= BATCH or size > BATCH_BYTES:
                    break
                chosen.append(one)
                size += one.size
            return tuple(chosen)

    def late(self, now: float) -> list[tuple[str, Receiver]]:
        """Relays that lack something and have made no progress for a while."""
        with self.lock:
            first = self.kept[0].number if self.kept else self.count
            return [(relay, one) for relay, one in self.receivers.items() if self._is_late(one, first, now)]

    def _is_late(self, receiver: Receiver, first: int, now: float) -> bool:
        if now - receiver.moved_at < receiver.pause_s:
            return False
        if receiver.arrived >= self.count:
            return self.end is not None and not receiver.is_ended and now - self.ended_at > RESEND_S
        at = receiver.arrived - first
        return at < 0 or (at < len(self.kept) and now - self.kept[at].at > RESEND_S)

    def expire(self, now: float) -> bool:
        """Let go of what nobody will acknowledge; ``True`` when the lane has nothing left to do."""
        with self.lock:
            self._let_go(now)
            while self.kept and not self.receivers and now - self.kept[0].at > FORGET_S:
                self.size -= self.kept.popleft().size
            is_told = all(one.is_ended for one in self.receivers.values()) or now - self.ended_at > FORGET_S
            return not self.kept and (self.end is None or is_told)
