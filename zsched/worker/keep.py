"""A worker's answers until the robots have them: kept, sent again to the relay that has missed one, owed by an input.

Knows: frames of acknowledgements, how answers are put again, which lock guards what. Does not know: epochs, roles, what
is in an answer, which relay is owed what (`zsched.core.hop.shared`), which input waits for which answers
(`zsched.core.hop.held`), how an input is acknowledged (`zsched.link.acknowledger`).

A link that closes (a freeze, a cut) takes with it what was on it, and a put says nothing about that. So every answer of
class ``reliable`` is kept, at most ``limit`` of an output and `SHARED_BYTES`, of ``latest`` the newest. A relay that
sees a gap asks at once; one that makes no progress for `RESEND_S`, longer each time, is sent what it lacks once its
link is there again (of ``latest`` it is asked first how far it is). Both go to that relay alone, under `AGAIN_CHUNK`:
other robots' radios carry nothing twice. One that cannot be reached for `FORGET_S` is forgotten. A plain subscriber
never acknowledges; for it nothing is kept longer than that.

Anybody can put under the key of acknowledgements. What is too large to be one, or comes while too many wait, is dropped
and counted; what is dropped of a relay's is mended by its next one.

An acknowledgement overtakes the answers: on a full link it would call an input done whose answer is lost with the
machine that holds it. So an input of class ``reliable`` *owes* the answers of class ``reliable`` that its callback has
put, and counts as processed when all robots for which it waits have them (`KeptLane.settled`). A callback that puts
nothing owes nothing, and so does one whose answers another thread puts. Where an answer was withheld, since the worker
was not the owner, its input waits until it has been processed again.
"""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final

import zenoh
from zenoh import CongestionControl, Sample, Session

from zsched.core.hop.held import Held as HeldOf
from zsched.core.hop.held import HeldInputs
from zsched.core.hop.kept import Owed
from zsched.core.hop.receiver import SourceName
from zsched.core.hop.serial import serial_of
from zsched.core.hop.shared import MAX_RECEIVERS, TICK_S, SharedSender, spoken_for
from zsched.core.values import codec as wire
from zsched.core.values.errors import WireError
from zsched.core.values.relay_protocol import SKIP_ENCODING, EndMarker, StreamAck, StreamAcks, mark_of
from zsched.core.values.struct import Struct, field
from zsched.host.clock import monotonic_s
from zsched.host.guard import guarded, tolerant
from zsched.link.acknowledger import Acknowledger
from zsched.link.keyspace import AGAIN_CHUNK, END_CHUNK, parse
from zsched.link.pipe.frames import encode_end
from zsched.link.sessions.matching import is_matched
from zsched.link.sessions.stalled_links import StalledLinks

MAX_FRAME_BYTES: Final = 1 << 17
"""Of one frame of acknowledgements: ours have at most `zsched.link.acknowledger.MAX_PER_FRAME`, and take less."""
MAX_FRAMES: Final = 256
"""Frames that wait for the thread."""

_log = logging.getLogger("zsched.worker")

Answer = tuple[Any, Any, Any]
"""(payload, attachment, encoding)."""


class KeptLane(Struct, kw_only=True, eq=False):
    """One publisher's answers; its lock guards `state`.

    `keep`, `note_end` and `settled` may be called from any thread, the rest is the keeper's.
    """

    key: str
    source_id: zenoh.EntityGlobalId
    wake: threading.Event
    state: SharedSender
    lock: threading.Lock = field(default_factory=threading.Lock)
    ways: dict[str, zenoh.Publisher] = field(default_factory=dict)
    """{relay: the publisher of what it alone is sent again}; there while that is owed, or a relay is looked for."""
    is_closed: bool = False
    """Nothing more is put."""
    is_awake: bool = True
    """The keeper looks after it: of thousands of keys most are at rest."""

    def keep(self, answer: Answer, stamp: Any, size: int) -> int:
        """Keep what is about to be put; answers its number."""
        with self.lock:
            number = self.state.note_put(answer, stamp, size, monotonic_s())
            self.is_awake = True
        if not self.wake.is_set():
            self.wake.set()
        return number

    def note_end(self, marker: EndMarker) -> None:
        """The end marker was put behind the last answer."""
        with self.lock:
            self.state.note_end(marker, monotonic_s())
            self.is_awake = True
        self.wake.set()

    def close(self) -> None:
        """Nothing more is put: once its answers have arrived, the keeper forgets it."""
        with self.lock:
            self.is_closed = self.is_awake = True

    def settled(self, name: str, now: float, /) -> int:
        """`SharedSender.settled`."""
        with self.lock:
            self.is_awake = True  # an input waits: who is expected has to be looked for
            return self.state.settled(name, now)

    # --- the keeper's thread -----------------------------------------------------------------------------------------

    def hear(self, relay: str, node: str, ack: StreamAck, now: float) -> None:
        """Take a relay's word."""
        with self.lock:
            before, spoken_for = self.state.crowded_out, self.state.contradicted
            self.state.hear(relay, node, ack, now)
            self.is_awake = True
            is_first = before < self.state.crowded_out == 1
            is_contradicted = spoken_for < self.state.contradicted == 1
        if is_contradicted:
            _log.warning("%s: %s acknowledges answers as a relay that another node speaks for", self.key, node)
        if is_first:
            _log.warning("%s: more than %d relays acknowledge answers: some are strangers", self.key, MAX_RECEIVERS)

    def take_owed(self, session: Session) -> Iterator[tuple[zenoh.Publisher, Owed, EndMarker | None]]:
        """What single relays are to be put now: (the way to one, what is owed to it, the marker of its skip)."""
        with self.lock:
            relays = self.state.owing()
        for relay in relays:
            is_reached, now = is_matched(self._way(session, relay)), monotonic_s()
            with self.lock:
                owed = self.state.take_owed(relay, now, is_reached=is_reached)
                skip = None if owed.skip is None else self.state.skip_marker(relay, owed.skip, now)
            yield self.ways[relay], owed, skip

    def look_after(self, session: Session, now: float) -> None:
        """Note what is late; find out which relays that have said nothing subscribe to the answers."""
        with self.lock:
            self.state.look_after(now)
            in_doubt = self.state.in_doubt(now)
        for relay in in_doubt:
            if relay not in self.ways:
                self._way(session, relay)  # it is known at the next tick whether it matches
                continue
            is_there = is_matched(self.ways[relay])
            with self.lock:
                self.state.decide(relay, now, is_there=is_there)

    def next_deadline(self, now: float) -> float | None:
        """When to look after it again; ``None``: there is nothing left to do, and it is at rest."""
        with self.lock:
            deadline = self.state.next_deadline(now)
            self.is_awake = deadline is not None
            return deadline

    def give_up(self) -> None:
        """Nobody looks after it any more."""
        with self.lock:
            self.state.give_up()
        for relay in tuple(self.ways):
            self._close_way(relay)

    def close_ways(self) -> None:
        """Give back the publishers to relays that nothing is owed any more."""
        if self.ways:
            with self.lock:
                unused = [relay for relay in self.ways if not self.state.needs_way(relay)]
            for relay in unused:
                self._close_way(relay)

    def _way(self, session: Session, relay: str) -> zenoh.Publisher:
        way = self.ways.get(relay)
        if way is None:
            key = f"{self.key}/{AGAIN_CHUNK}/{spoken_for(relay)}"
            way = self.ways[relay] = session.declare_publisher(key, congestion_control=CongestionControl.BLOCK)
        return way

    def _close_way(self, relay: str) -> None:
        self.ways.pop(relay).undeclare()


Held = HeldOf[KeptLane]


class Debts:
    """The inputs whose answers are on their way. Its lock is held around lanes' locks, and around nothing else."""

    def __init__(self, acks: Acknowledger) -> None:
        """``acks`` hears what is processed, in the order of each source."""
        self._acks = acks
        self._lock = threading.Lock()
        self._held = HeldInputs[KeptLane]()

    @property
    def is_waiting(self) -> bool:
        """Whether an input is held back."""
        return bool(self._held.lines)

    def processed(
        self, name: SourceName, number: int, size: int, owed: Mapping[KeptLane, int], *, is_unanswered: bool = False
    ) -> Held | None:
        """A callback has returned (dispatch thread); ``owed`` are the answers that it has put.

        ``is_unanswered``: an answer was withheld; what is given back is for `answered`.
        """
        with self._lock:
            held = self._held.hold(name, number, size, owed, is_unanswered=is_unanswered)
        if held is None:
            self._acks.processed(name, number, size)
        _wake(owed)
        return held

    def answered(self, held: Held, owed: Mapping[KeptLane, int], now: float) -> None:
        """An input whose answer was withheld has been processed again, or was given up."""
        with self._lock:
            held.unanswered -= 1
            held.owe(owed)
        _wake(owed)
        if not owed:
            self.settle(now)

    def forget(self, name: SourceName) -> None:
        """Nobody waits for this source's inputs any more."""
        with self._lock:
            self._held.forget(name)

    def settle(self, now: float) -> None:
        """Tell of every input whose answers are where they should be (any thread; the keeper's when it has heard)."""
        with self._lock:
            done = self._held.settle(now)
        for one in done:
            self._acks.processed(one.name, one.number, one.size)


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
            if self._subscriber is None:
                self._start()
            self._lanes[source_id.eid] = lane
        return lane

    def _start(self) -> None:
        subscriber = self._session.declare_subscriber(self._acks_key, tolerant(self._hear, "acknowledgements"))
        try:
            guarded(self._run, name="zsched keeper").start()
        except RuntimeError:  # no thread is to be had: the next lane tries again
            subscriber.undeclare()
            raise
        self._subscriber = subscriber

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
        for ack in frame.acks:
            lane = self._lanes.get(ack.eid)
            if lane is not None and ack.of in (0, mark_of(lane.key)):  # else an owner has named ours under its own key
                self._acknowledged(lane, key.rest[0], key.owner, ack)

    def _acknowledged(self, lane: KeptLane, relay: str, node: str, ack: StreamAck) -> None:
        lane.hear(relay, node, ack, monotonic_s())
        self._put_owed(lane)
        lane.close_ways()

    def _look_after(self) -> float:
        """Answers when to do so again."""
        now = monotonic_s()
        deadlines = []
        for lane in self._awake():
            lane.look_after(self._session, now)
            self._put_owed(lane)
            lane.close_ways()
            deadline = lane.next_deadline(now)
            if deadline is not None:
                deadlines.append(deadline)
            elif lane.is_closed:
                lane.give_up()
                with self._lock:
                    self._lanes.pop(lane.source_id.eid, None)
        self._debts.settle(now)
        if self._debts.is_waiting:
            deadlines.append(now + TICK_S)
        if not deadlines:
            self._wake.clear()
            if self._has_work(now):  # it came while the bell was still set, maybe in a lane of its own
                self._wake.set()
        return min(deadlines, default=now + TICK_S)

    def _has_work(self, now: float) -> bool:
        return self._debts.is_waiting or any(lane.next_deadline(now) is not None for lane in self._awake())

    def _awake(self) -> list[KeptLane]:
        with self._lock:
            return [lane for lane in self._lanes.values() if lane.is_awake]

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


def _wake(lanes: Iterable[KeptLane]) -> None:
    for lane in lanes:
        if not lane.wake.is_set():
            lane.wake.set()  # the keeper may have been at rest since the answer was put
