"""Keeps a worker's answers until the robots' relays have acknowledged them, and sends again what one has missed.

Knows: publishers, numbers, each relay's acknowledgements. Does not know: epochs, roles, what is in an answer.

A link that closes (a freeze, a cut) takes with it what was on it, and a put says nothing about that. So every answer of
class ``reliable`` is kept, at most ``limit`` of an output and `KEPT_BYTES`, of ``latest`` the newest. A relay that sees
a gap asks at once; one that makes no progress for `RESEND_S`, longer each time, is sent what it lacks once its link is
there again. Both go to that relay alone, under `AGAIN_CHUNK`: other robots' radios carry nothing twice. Who cannot be
reached for `FORGET_S` is forgotten. A plain subscriber never acknowledges; for it nothing is kept longer than that.

Anybody can put under the key of acknowledgements. What is too large to be one, or comes while too many wait, is dropped
and counted; what is dropped of a relay's is mended by its next one.
"""

from __future__ import annotations

import logging
import queue
import threading
from typing import Any, Final

import zenoh
from zenoh import CongestionControl, Sample, Session

from zsched.clock import monotonic_s
from zsched.core.hop.serial import number_near, serial_of
from zsched.core.relay_protocol import SKIP_ENCODING, EndMarker, StreamAck, StreamAcks
from zsched.errors import WireError
from zsched.guard import guarded, tolerant
from zsched.ipc.pipe import encode_end
from zsched.sessions.stalled_links import StalledLinks
from zsched.wire import codec as wire
from zsched.wire.keyspace import AGAIN_CHUNK, END_CHUNK, parse
from zsched.worker.debts import Debts
from zsched.worker.lanes import FORGET_S, Expected, KeptLane, Receiver

MAX_PAUSE_S: Final = 2.0
ASKED_S: Final = 0.1
"""A relay that asks for the same once more within this time has it on its way."""
LOOK_S: Final = 0.1
"""Nothing was heard of a robot whose input an answer was made of: then it is looked whether it subscribes at all."""
TICK_S: Final = 0.1
MAX_FRAME_BYTES: Final = 1 << 17
"""Of one frame of acknowledgements: ours have at most `zsched.hop.acknowledger.MAX_PER_FRAME`, and take less."""
MAX_FRAMES: Final = 256
"""Frames that wait for the thread."""

_log = logging.getLogger("zsched.worker")


class _Bell(threading.Event):
    """Set while something is kept; whoever sets it also wakes a thread that waits for a frame."""

    def __init__(self, frames: queue.SimpleQueue[Sample | None]) -> None:
        super().__init__()
        self._frames = frames

    def set(self) -> None:
        super().set()
        self._frames.put(None)


class Keeper:
    """The answers of one worker, and the thread that takes acknowledgements and sends again."""

    def __init__(self, session: Session, acks_key: str, debts: Debts, stalled: StalledLinks) -> None:
        """``acks_key``: where relays acknowledge, ``.../received/*/*/<our zenoh id>``. Starts with the first lane.

        ``debts`` are settled whenever more may have reached the robots; ``stalled`` watches over every put.
        """
        self.stalled = stalled
        self._session = session
        self._acks_key = acks_key
        self._debts = debts
        self._lock = threading.Lock()
        self._lanes: dict[int, KeptLane] = {}
        self._came: queue.SimpleQueue[Sample | None] = queue.SimpleQueue()
        self._wake = _Bell(self._came)
        self.dropped = 0
        """Frames that were too large, or too many."""
        self._is_closed = False
        self._subscriber: zenoh.Subscriber[None] | None = None

    def lane(self, key: str, source_id: zenoh.EntityGlobalId, limit: int) -> KeptLane:
        """The lane of a new publisher."""
        lane = KeptLane(key=key, source_id=source_id, limit=max(1, limit), wake=self._wake)
        with self._lock:
            self._lanes[source_id.eid] = lane
            if self._subscriber is None:
                self._subscriber = self._session.declare_subscriber(
                    self._acks_key, tolerant(self._hear, "acknowledgements")
                )
                guarded(self._run, name="zsched keeper").start()
        return lane

    def close(self) -> None:
        """End the thread."""
        self._is_closed = True
        self._wake.set()
        self.stalled.close()

    def _hear(self, sample: Sample) -> None:
        """Zenoh's thread: never wait, and let nobody fill our memory."""
        if len(sample.payload) > MAX_FRAME_BYTES or self._came.qsize() >= MAX_FRAMES:
            self.dropped += 1
            _log.warning("a frame of acknowledgements was dropped: too large, or too many")
            return
        self._came.put(sample)

    # --- the thread --------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        due = 0.0
        while not self._is_closed:
            is_idle = not self._wake.is_set()  # nothing is kept: only a frame can come
            try:
                sample = self._came.get(timeout=None if is_idle else max(0.0, due - monotonic_s()))
            except queue.Empty:
                sample = None
            try:
                if sample is not None:
                    with self.stalled:
                        self._take(sample)
                    self._debts.settle(monotonic_s())
                if monotonic_s() >= due:
                    with self.stalled:
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
            lane.note_debts(now)
            self._look_for_expected(lane, now)
            is_done = lane.expire(now)
            is_idle &= is_done
            if is_done and lane.is_closed:
                self._give_up(lane)
                with self._lock:
                    self._lanes.pop(eid, None)
        self._debts.settle(now)
        if is_idle and not self._debts.is_waiting:
            self._wake.clear()
            if any(lane.kept for _, lane in lanes):  # one that came just now
                self._wake.set()

    def _look_for_expected(self, lane: KeptLane, now: float) -> None:
        """Find out which relays that have said nothing are told of the lane's answers; what they said tells, too."""
        with lane.lock:
            expected = tuple(lane.expected.items())
        for relay, one in expected:
            if one.is_decided or now - one.since < LOOK_S:
                continue
            is_heard = relay in lane.receivers
            if one.publisher is None and not is_heard:
                one.publisher = self._publisher_to(lane, relay)  # it is known at the next tick whether it matches
                continue
            if not is_heard and _matches(one.publisher) and now - one.since <= FORGET_S:
                continue
            _decide(one)

    def _give_up(self, lane: KeptLane) -> None:
        lane.is_over = True
        for one in lane.expected.values():
            _decide(one)

    def _send_again(
        self, lane: KeptLane, relay: str, receiver: Receiver, until: int, *, is_asked: bool = False
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

    def _is_reached(self, lane: KeptLane, relay: str, receiver: Receiver, now: float) -> bool:
        if receiver.publisher is None:
            receiver.publisher = self._publisher_to(lane, relay)
        if _matches(receiver.publisher):
            receiver.unreached_since, receiver.is_confirmed = None, True
            return True
        receiver.unreached_since = receiver.unreached_since or now
        if now - receiver.unreached_since > FORGET_S:
            with lane.lock:
                lane.forget(relay)
            _undeclare(receiver)
        return False

    def _publisher_to(self, lane: KeptLane, relay: str) -> zenoh.Publisher:
        key = f"{lane.key}/{AGAIN_CHUNK}/{relay}"
        return self._session.declare_publisher(key, congestion_control=CongestionControl.BLOCK)


def put_end(session: Session, key: str, source_id: zenoh.EntityGlobalId, marker: EndMarker) -> None:
    """Put the end marker of a key behind its last answer."""
    session.put(
        f"{key}/{END_CHUNK}",
        encode_end(marker),
        congestion_control=CongestionControl.BLOCK,
        source_info=zenoh.SourceInfo(source_id, serial_of(marker.count)),
    )


def _matches(publisher: Any) -> bool:
    return bool(publisher.matching_status.matching)  # the status itself is always true


def _decide(expected: Expected) -> None:
    expected.is_decided = True
    if expected.publisher is not None:
        expected.publisher.undeclare()
        expected.publisher = None


def _undeclare(receiver: Receiver) -> None:
    if receiver.publisher is not None:
        receiver.publisher.undeclare()
        receiver.publisher = None
