"""Keeps a worker's answers until the robots' relays have acknowledged them, and sends again what one has missed.

Knows: frames of acknowledgements, how answers are put again. Does not know: epochs, roles, what is in an answer, which
relay is owed what (`zsched.core.hop.shared`).

A link that closes (a freeze, a cut) takes with it what was on it, and a put says nothing about that. So every answer of
class ``reliable`` is kept, at most ``limit`` of an output and `SHARED_BYTES`, of ``latest`` the newest. A relay that
sees a gap asks at once; one that makes no progress for `RESEND_S`, longer each time, is sent what it lacks once its
link is there again (of ``latest`` it is asked first how far it is). Both go to that relay alone, under `AGAIN_CHUNK`:
other robots' radios carry nothing twice. One that cannot be reached for `FORGET_S` is forgotten. A plain subscriber
never acknowledges; for it nothing is kept longer than that.

Anybody can put under the key of acknowledgements. What is too large to be one, or comes while too many wait, is dropped
and counted; what is dropped of a relay's is mended by its next one.
"""

from __future__ import annotations

import logging
import queue
import threading
from typing import Final

import zenoh
from zenoh import CongestionControl, Sample, Session

from zsched.clock import monotonic_s
from zsched.core.hop.serial import serial_of
from zsched.core.hop.shared import TICK_S, SharedSender
from zsched.core.relay_protocol import SKIP_ENCODING, EndMarker, StreamAck, StreamAcks
from zsched.errors import WireError
from zsched.guard import guarded, tolerant
from zsched.ipc.pipe import encode_end
from zsched.sessions.stalled_links import StalledLinks
from zsched.wire import codec as wire
from zsched.wire.keyspace import END_CHUNK, parse
from zsched.worker.debts import Debts
from zsched.worker.lanes import KeptLane

MAX_FRAME_BYTES: Final = 1 << 17
"""Of one frame of acknowledgements: ours have at most `zsched.hop.acknowledger.MAX_PER_FRAME`, and take less."""
MAX_FRAMES: Final = 256
"""Frames that wait for the thread."""
BESIDE: Final = " (application)"
"""Behind a robot's name (no name has such characters): its application that has its streams itself."""

_log = logging.getLogger("zsched.worker")


class _Bell(threading.Event):
    """Set while something is kept; its setter also wakes a thread that waits for a frame."""

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

    def lane(self, key: str, source_id: zenoh.EntityGlobalId, limit: int, *, is_whole: bool = True) -> KeptLane:
        """The lane of a new publisher; ``is_whole``: of class ``reliable``."""
        state = SharedSender(limit=max(1, limit), is_whole=is_whole)
        lane = KeptLane(key=key, source_id=source_id, wake=self._wake, state=state)
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
                        due = self._look_after()
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
        node = f"{key.owner}{BESIDE}" if frame.is_application else key.owner
        for ack in frame.acks:
            lane = self._lanes.get(ack.eid)
            if lane is not None:
                self._acknowledged(lane, key.rest[0], node, ack)

    def _acknowledged(self, lane: KeptLane, relay: str, node: str, ack: StreamAck) -> None:
        lane.hear(relay, node, ack, monotonic_s())
        self._put_owed(lane)
        lane.close_ways()

    def _look_after(self) -> float:
        """Answers when to do so again."""
        now = monotonic_s()
        with self._lock:
            lanes = tuple(self._lanes.items())
        deadlines = []
        for eid, lane in lanes:
            lane.look_after(self._session, now)
            self._put_owed(lane)
            lane.close_ways()
            deadline = lane.next_deadline(now)
            if deadline is not None:
                deadlines.append(deadline)
            elif lane.is_closed:
                lane.give_up()
                with self._lock:
                    self._lanes.pop(eid, None)
        self._debts.settle(now)
        if self._debts.is_waiting:
            deadlines.append(now + TICK_S)
        if not deadlines:
            self._wake.clear()
            if any(lane.state.kept for _, lane in lanes):  # one that came just now
                self._wake.set()
        return min(deadlines, default=now + TICK_S)

    def _put_owed(self, lane: KeptLane) -> None:
        for way, owed, skip in lane.take_owed(self._session):
            if skip is not None:
                source = zenoh.SourceInfo(lane.source_id, serial_of(skip.count))
                way.put(encode_end(skip), encoding=SKIP_ENCODING, source_info=source)
            for one in owed.again:
                payload, attachment, encoding = one.sample
                source = zenoh.SourceInfo(lane.source_id, serial_of(one.number))
                way.put(payload, attachment=attachment, encoding=encoding, timestamp=one.stamp, source_info=source)
            if owed.end is not None:
                put_end(self._session, lane.key, lane.source_id, owed.end)


def put_end(session: Session, key: str, source_id: zenoh.EntityGlobalId, marker: EndMarker) -> None:
    """Put the end marker of a key behind its last answer."""
    session.put(
        f"{key}/{END_CHUNK}",
        encode_end(marker),
        congestion_control=CongestionControl.BLOCK,
        source_info=zenoh.SourceInfo(source_id, serial_of(marker.count)),
    )
