"""Keeps a worker's answers until the robots' relays have acknowledged them, and sends again what one has missed.

Knows: publishers, numbers, each relay's acknowledgements. Does not know: epochs, roles, what is in an answer.

A link that closes (a freeze, a cut) takes with it what was on it, and a put says nothing about that. So every answer of
class ``reliable`` is kept, at most ``limit`` of an output and `KEPT_BYTES`, of ``latest`` the newest. A relay that sees
a gap asks at once; one that makes no progress for `RESEND_S`, longer each time, is sent what it lacks once its link is
there again. Both go to that relay alone, under `AGAIN_CHUNK`: other robots' radios carry nothing twice. Who cannot be
reached for `FORGET_S` is forgotten. A plain subscriber never acknowledges; for it nothing is kept longer than that.

Anybody can acknowledge under any relay's name. So a lane remembers at most `MAX_RECEIVERS` of them.
"""

from __future__ import annotations

import logging
import queue
import threading
from collections import deque
from dataclasses import dataclass, field
from itertools import islice
from typing import Any, Final

import zenoh
from zenoh import CongestionControl, Sample, Session

from zsched import wire
from zsched.clock import monotonic_s
from zsched.core.relay_protocol import SKIP_ENCODING, EndMarker, StreamAck, StreamAcks
from zsched.core.serial import number_near, serial_of
from zsched.errors import WireError
from zsched.guard import guarded
from zsched.keyspace import AGAIN_CHUNK, END_CHUNK, parse
from zsched.relay_pipe import encode_end

KEPT_BYTES: Final = 32 << 20
RESEND_S: Final = 0.3
MAX_PAUSE_S: Final = 2.0
ASKED_S: Final = 0.1
"""A relay that asks for the same once more within this time has it on its way."""
FORGET_S: Final = 10.0
MAX_RECEIVERS: Final = 256
"""Relays that a lane remembers; beyond, the longest silent one goes, first of those that were never reached."""
NEWCOMERS_S: Final = 3.0
"""So long after an epoch's first answer a robot may begin with it: one that learnt of the move late, or had no link."""
TICK_S: Final = 0.1
BATCH: Final = 512
BATCH_BYTES: Final = 4 << 20
"""So much is sent again at one time; progress brings the next."""

_log = logging.getLogger("zsched.worker")


@dataclass(frozen=True, slots=True)
class _Kept:
    number: int
    payload: Any
    attachment: Any
    encoding: Any
    stamp: zenoh.Timestamp | None
    size: int
    at: float


@dataclass(slots=True, eq=False)
class _Receiver:
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
    is_ended: bool = False
    is_confirmed: bool = False
    """It was seen to subscribe to what is sent again."""
    publisher: zenoh.Publisher | None = None
    """Of what is sent again; there while something is owed."""


@dataclass(slots=True, eq=False)
class KeptLane:
    """One publisher's answers. Its lock guards it; `keep` may be called from any thread, the rest is the keeper's."""

    key: str
    source_id: zenoh.EntityGlobalId
    limit: int
    wake: threading.Event
    lock: threading.Lock = field(default_factory=threading.Lock)
    kept: deque[_Kept] = field(default_factory=deque)
    size: int = 0
    count: int = 0
    receivers: dict[str, _Receiver] = field(default_factory=dict)
    had: dict[str, tuple[str, int]] = field(default_factory=dict)
    """{relay that was forgotten: (its node, how far it has acknowledged)}, the oldest first."""
    end: EndMarker | None = None
    ended_at: float = 0.0
    began_at: float | None = None
    is_closed: bool = False
    crowded_out: int = 0
    """Relays that were forgotten for want of room."""
    gone: list[_Receiver] = field(default_factory=list)
    """Relays that were forgotten, their publishers not given back yet."""

    def keep(self, number: int, payload: Any, attachment: Any, encoding: Any, stamp: Any, size: int) -> None:
        """Keep what is about to be put under a number; the oldest give way."""
        now = monotonic_s()
        with self.lock:
            self.count, self.end = number + 1, None
            self.began_at = now if self.began_at is None else self.began_at
            self.kept.append(_Kept(number, payload, attachment, encoding, stamp, size, now))
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

    def acknowledge(self, relay: str, node: str, ack: StreamAck, now: float) -> tuple[_Receiver, bool]:
        """Take a relay's word; answers (it, whether it has come further)."""
        with self.lock:
            receiver = self.receivers.get(relay)
            if receiver is None:  # a relay that restarted is another session of the same node
                for old in [name for name, one in self.receivers.items() if one.node == node]:
                    self.forget(old)
                if len(self.receivers) >= MAX_RECEIVERS:
                    self._make_room()
                receiver = self.receivers[relay] = _Receiver(node=node, arrived=-1, had=self._had_by(relay, node))
            # one that came late knows the lowest bits only; nobody can have more than was sent
            receiver.waits_for = min(number_near(serial_of(ack.arrived), self.count), self.count)
            arrived = max(receiver.waits_for, receiver.had or 0)
            has_moved = arrived > receiver.arrived
            receiver.heard_at, receiver.is_ended = now, ack.is_ended
            if has_moved:
                receiver.arrived, receiver.moved_at, receiver.pause_s = arrived, now, RESEND_S
            self._let_go(now)
            return receiver, has_moved

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

    def take_gone(self) -> list[_Receiver]:
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

    def wanted(self, start: int, until: int) -> tuple[_Kept, ...]:
        """What is kept of the numbers from ``start`` to before ``until``, as much as goes at one time."""
        with self.lock:
            first = self.kept[0].number if self.kept else self.count
            chosen: list[_Kept] = []
            size = 0
            for one in islice(self.kept, max(0, start - first), None):
                if one.number >= until or len(chosen) >= BATCH or size > BATCH_BYTES:
                    break
                chosen.append(one)
                size += one.size
            return tuple(chosen)

    def late(self, now: float) -> list[tuple[str, _Receiver]]:
        """Relays that lack something and have made no progress for a while."""
        with self.lock:
            first = self.kept[0].number if self.kept else self.count
            return [(relay, one) for relay, one in self.receivers.items() if self._is_late(one, first, now)]

    def _is_late(self, receiver: _Receiver, first: int, now: float) -> bool:
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


class Keeper:
    """The answers of one worker, and the thread that takes acknowledgements and sends again."""

    def __init__(self, session: Session, acks_key: str) -> None:
        """``acks_key``: where relays acknowledge, ``.../received/*/*/<our zenoh id>``. Starts with the first lane."""
        self._session = session
        self._acks_key = acks_key
        self._lock = threading.Lock()
        self._lanes: dict[int, KeptLane] = {}
        self._came: queue.SimpleQueue[Sample | None] = queue.SimpleQueue()
        self._wake = threading.Event()
        self._is_closed = False
        self._subscriber: zenoh.Subscriber[None] | None = None

    def lane(self, key: str, source_id: zenoh.EntityGlobalId, limit: int) -> KeptLane:
        """The lane of a new publisher."""
        lane = KeptLane(key=key, source_id=source_id, limit=max(1, limit), wake=self._wake)
        with self._lock:
            self._lanes[source_id.eid] = lane
            if self._subscriber is None:
                self._subscriber = self._session.declare_subscriber(self._acks_key, self._came.put)
                guarded(self._run, name="zsched keeper").start()
        return lane

    def close(self) -> None:
        """End the thread."""
        self._is_closed = True
        self._wake.set()
        self._came.put(None)

    # --- the thread --------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        due = 0.0
        while not self._is_closed:
            self._wake.wait()  # nothing is kept: no acknowledgement matters
            try:
                sample = self._came.get(timeout=max(0.0, due - monotonic_s()))
            except queue.Empty:
                sample = None
            try:
                if sample is not None:
                    self._take(sample)
                if monotonic_s() >= due:
                    self._look_after()
                    due = monotonic_s() + TICK_S
            except zenoh.ZError as error:  # the session closes
                _log.debug("answers are not sent again (%s)", error)

    def _take(self, sample: Sample) -> None:
        try:
            frame = wire.decode(sample.payload.to_bytes(), StreamAcks)
        except WireError as error:
            _log.warning("an unreadable acknowledgement was ignored (%s)", error)
            return
        key = parse(str(sample.key_expr))
        if key is None or len(key.rest) != 2:
            _log.warning("an acknowledgement under a malformed key was ignored")
            return
        for ack in frame.acks:
            lane = self._lanes.get(ack.eid)
            if lane is not None:
                self._acknowledged(lane, key.rest[0], key.owner, ack)

    def _acknowledged(self, lane: KeptLane, relay: str, node: str, ack: StreamAck) -> None:
        now = monotonic_s()
        receiver, has_moved = lane.acknowledge(relay, node, ack, now)
        for gone in lane.take_gone():
            _undeclare(gone)
        if ack.has_gap:
            if has_moved or now - receiver.moved_at > ASKED_S:
                until = number_near(serial_of(ack.until), lane.count) if ack.until else lane.count
                self._send_again(lane, relay, receiver, until, is_asked=True)
        elif receiver.batch_end is not None and receiver.arrived >= receiver.batch_end:
            receiver.batch_end = None
            if receiver.arrived < lane.count:
                self._send_again(lane, relay, receiver, lane.count)
        if receiver.publisher is not None and receiver.arrived >= lane.count:
            _undeclare(receiver)

    def _look_after(self) -> None:
        now = monotonic_s()
        is_idle = True
        with self._lock:
            lanes = tuple(self._lanes.items())
        for eid, lane in lanes:
            for relay, receiver in lane.late(now):
                self._send_again(lane, relay, receiver, lane.count)
                receiver.pause_s = min(2 * receiver.pause_s, MAX_PAUSE_S)
            is_done = lane.expire(now)
            is_idle &= is_done
            if is_done and lane.is_closed:
                with self._lock:
                    self._lanes.pop(eid, None)
        if is_idle:
            self._wake.clear()
            if any(lane.kept for _, lane in lanes):  # one that came just now
                self._wake.set()

    def _send_again(
        self, lane: KeptLane, relay: str, receiver: _Receiver, until: int, *, is_asked: bool = False
    ) -> None:
        now = receiver.moved_at = monotonic_s()
        if not self._is_reached(lane, relay, receiver, now):
            return
        wanted = lane.wanted(receiver.arrived, until)
        first = wanted[0].number if wanted else min(until, lane.count)
        publisher = receiver.publisher
        if publisher is None:
            return
        if is_asked and first > receiver.waits_for:  # older ones it has had, or they are kept no more
            age_s = None if lane.began_at is None else now - lane.began_at
            marker = EndMarker(epoch=0, count=first, had=receiver.had, age_s=age_s)
            source = zenoh.SourceInfo(lane.source_id, serial_of(first))
            publisher.put(encode_end(marker), encoding=SKIP_ENCODING, source_info=source)
        for one in wanted:
            source = zenoh.SourceInfo(lane.source_id, serial_of(one.number))
            publisher.put(
                one.payload, attachment=one.attachment, encoding=one.encoding, timestamp=one.stamp, source_info=source
            )
        receiver.batch_end = first + len(wanted) if wanted and wanted[-1].number + 1 < until else None
        if lane.end is not None and not receiver.is_ended and not wanted:
            put_end(self._session, lane.key, lane.source_id, lane.end)

    def _is_reached(self, lane: KeptLane, relay: str, receiver: _Receiver, now: float) -> bool:
        if receiver.publisher is None:
            receiver.publisher = self._session.declare_publisher(
                f"{lane.key}/{AGAIN_CHUNK}/{relay}", congestion_control=CongestionControl.BLOCK
            )
        status: Any = receiver.publisher.matching_status
        if bool(status.matching):  # the object itself is always true
            receiver.unreached_since, receiver.is_confirmed = None, True
            return True
        receiver.unreached_since = receiver.unreached_since or now
        if now - receiver.unreached_since > FORGET_S:
            with lane.lock:
                lane.forget(relay)
            _undeclare(receiver)
        return False


def put_end(session: Session, key: str, source_id: zenoh.EntityGlobalId, marker: EndMarker) -> None:
    """Put the end marker of a key behind its last answer."""
    session.put(
        f"{key}/{END_CHUNK}",
        encode_end(marker),
        congestion_control=CongestionControl.BLOCK,
        source_info=zenoh.SourceInfo(source_id, serial_of(marker.count)),
    )


def _undeclare(receiver: _Receiver) -> None:
    if receiver.publisher is not None:
        receiver.publisher.undeclare()
        receiver.publisher = None
