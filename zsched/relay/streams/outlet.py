"""Puts a stream's samples on under their new key: the publishers of one stream towards one place.

Knows: zenoh publishers, the three classes, what is sent again. Does not know: slots, epochs, when to switch.

Payloads are passed on as they came (reference counted, never turned into ``bytes``), with encoding, attachment,
timestamp, kind, priority and express. The source info becomes the publisher's own, numbered from 0 without a gap: that
number is what the next hop checks and acknowledges.

``best_effort`` is put at once and dropped where it would wait. ``latest`` and ``reliable`` have a queue and a thread
(`zsched.link.sessions.send_queue`) and wait there, so that only this target waits when its receiver stalls.

Where the receiver is `zsched.worker`, samples are kept until it acknowledges them. A number that did not come, or no
progress for a while (`Lane.is_late`), and they are put again under the numbers they had; the worker drops what it has
already. Class ``reliable`` sends nothing before its receiver has said where it begins
(`zsched.relay.streams.greetings`).
"""

from __future__ import annotations

import contextlib
import logging
import threading
from collections import Counter
from typing import Any, Final

import zenoh
from zenoh import Priority, Sample, Session, Timestamp

from zsched.core.hop.kept import NOTHING, Owed
from zsched.core.hop.sender import KEPT_BYTES, KEPT_BYTES_LATEST, KEPT_SAMPLES
from zsched.core.route.wildcards import Rewriting
from zsched.core.values.plan import OnCrash, StreamClass, StreamSettings
from zsched.core.values.relay_protocol import EndMarker, StreamAck, mark_of
from zsched.host.clock import monotonic_s
from zsched.host.guard import tolerant
from zsched.link.sessions.matching import is_matched
from zsched.link.sessions.send_queue import SendQueue
from zsched.link.weight import weight
from zsched.relay.streams.acks import WorkerAcks
from zsched.relay.streams.crowd import Crowd
from zsched.relay.streams.greetings import Greetings
from zsched.relay.streams.lanes import Lane, declare_publisher, put_marker
from zsched.relay.streams.proofs import LeftOpen
from zsched.relay.streams.receive import undeclare
from zsched.relay.streams.tally import Tally

QUEUE_DEPTH: Final = 1024
"""A reliable outlet's queue holds at least this many samples, whatever its depth says."""
MAX_LANES: Final = 4096
"""Publishers of one wildcard stream towards one place: keys come from the applications, memory is ours."""
REST_S: Final = 10.0
"""A key that has carried nothing for so long, and of which all has arrived, gives way to a new one: they may change
over the weeks."""
ROOM_SHARE: Final = 16
"""From this share of `MAX_LANES` below it on there is room made, and for as many at a time..."""
ROOM_EVERY_S: Final = 0.1
"""...this often at most: all keys are looked at."""
MAX_OWED: Final = 4096
"""Samples that wait for the next owner after a crash (`OnCrash.REPLAY`), or for an application that has stopped: a
queue has room for them besides its own."""
SKIP_EPOCH: Final = 0
"""Epoch of a marker that ends nothing: no number below its count will come any more."""

MAX_PATIENT: Final = 3
"""Streams that may wait for room at one time: each holds one of zenoh's receive threads (six by default)."""

_log = logging.getLogger("zsched.relay")
_patient = threading.BoundedSemaphore(MAX_PATIENT)

Unsent = tuple[Sample, Timestamp | None]
"""A sample that waits to be sent, with its timestamp."""

_ALL_WENT: Final = ("", 0)
_DATA: Final = Priority.DATA


class Outlet:
    """The way of one stream to one place; `send` is used by one thread at a time (its stream's lock)."""

    def __init__(
        self,
        session: Session,
        from_expr: str,
        to_expr: str,
        settings: StreamSettings,
        acks: WorkerAcks | None = None,
        *,
        has_crowd: bool = False,
        epoch: int = 0,
    ) -> None:
        """Declare the publishers. With ``acks`` the receiver is `zsched.worker`, which says what it has processed.

        ``has_crowd``: the receivers are applications, as many as like to. ``epoch`` is that of the slot it belongs to,
        which its worker hears.

        Raises:
            ValueError: ``to_expr`` cannot be filled from ``from_expr``.
            zenoh.ZError: an expression is none.
            RuntimeError: no thread is to be had; nothing is declared.
        """
        self._session = session
        self._settings = settings
        self._acks = acks
        self._stalled: contextlib.AbstractContextManager[None] = acks.stalled if acks else contextlib.nullcontext()
        self._rewriting = Rewriting(from_expr, to_expr)
        self._is_reliable = settings.stream_class is StreamClass.RELIABLE
        self._to = to_expr
        self._epoch = epoch
        self._lock = threading.Lock()
        self._lanes: dict[tuple[str, str, int], Lane] = {}
        """By key, how it is put, and place of the publisher (`Places`)."""
        self._full: dict[int, Lane] = {}
        """By entity id, lanes that were full when they were last put to or heard of (our lock)..."""
        self._due: dict[int, Lane] = {}
        """...and those that something may have to be put again for: no sample, no word looks at all lanes."""
        self._room_at = 0.0
        """When keys may be looked at again for room."""
        self._has_put_ends = False
        self.tally = Tally()
        self._handed = 0
        """Samples taken and not dropped (the stream's lock guards it)..."""
        self._left = 0
        """...and those of them that have left the queue, or could not (our lock)."""
        """When a put that its giver had claimed has waited for its link."""
        self._left_told = 0
        """How much of the tally's `at_most_lost` has been taken."""
        self._replays = settings.on_crash is OnCrash.REPLAY and acks is not None
        holds = self._is_reliable and acks is not None
        self._greetings = Greetings(self._lock, self._put_start) if holds else None
        self._probe = session.declare_publisher(to_expr)
        self._is_parted = self._has_returned = False
        """Nobody subscribes; and somebody did again, since that was asked last (of a worker that shows no token)."""
        if acks is None and not has_crowd and settings.stream_class is StreamClass.LATEST:
            seen = zenoh.handlers.Callback(tolerant(self._matched, "matching"), indirect=False)
            self._watch = self._probe.declare_matching_listener(seen)
        self._main = None if self._rewriting.is_wild else self._declare(to_expr, Priority.DATA, is_express=False)
        try:
            self._queue = self._make_queue(waits_long=has_crowd or self._replays)
        except RuntimeError:
            self._undeclare()
            raise
        self._crowd = self._make_crowd() if has_crowd else None
        self._makes_up = False
        """What the crowd is owed goes out behind what waits in the queue."""

    def _make_crowd(self) -> Crowd | None:
        if (queue := self._queue) is None:
            return None  # class `best_effort` waits for nobody
        is_latest = self._settings.stream_class is StreamClass.LATEST
        return Crowd(self._session, self._to, lambda: queue.is_pressed, queue.has_room, is_latest=is_latest)

    def _make_queue(self, *, waits_long: bool) -> SendQueue | None:
        stream_class, depth = self._settings.stream_class, self._settings.depth
        if stream_class is StreamClass.BEST_EFFORT:
            return None
        is_reliable = stream_class is StreamClass.RELIABLE
        return SendQueue(
            f"to {self._to}",
            depth=max(depth, QUEUE_DEPTH) + (MAX_OWED if waits_long else 0) if is_reliable else depth,
            sheds=not is_reliable,
            keep_last=self._settings.keep_last,
            is_open=self._is_open if is_reliable and self._acks is not None else None,
            at_kick=self._look if self._acks is not None else None,
        )

    @property
    def is_matching(self) -> bool:
        """True when somebody subscribes to where this outlet leads (it may be a zombie or a recorder)."""
        return is_matched(self._probe)

    def _matched(self, status: Any) -> None:
        """Somebody subscribes to where this outlet leads, or nobody does any more (zenoh's thread)."""
        self._has_returned |= self._is_parted and status.matching
        self._is_parted = not status.matching

    def take_returned(self) -> bool:
        """Whether somebody subscribed after nobody did, since the last time: who does now is another life.

        Not before: what is sent while nobody subscribes reaches nobody. Zenoh looks a moment after each change, so an
        absence of less than some milliseconds may not be seen; a program takes longer to start.
        """
        returned, self._has_returned = self._has_returned, False
        return returned

    def also_from(self, from_expr: str) -> None:
        """Take samples of another owner, too: its ``from`` captures what fills the wildcards of ``to``.

        Raises:
            ValueError: ``to`` cannot be filled from it.
        """
        self._rewriting.also_from(from_expr)

    def send(
        self, sample: Sample, stamp: Timestamp | None = None, size: int | None = None, place: int = 0
    ) -> tuple[str, int]:
        """Put one sample; answers (why something was dropped, how much of it), with 0 when nothing was.

        ``stamp`` stands in for the timestamp that the sample lacks; ``size`` is its `weight`, where it is known;
        ``place`` that of its publisher: of class ``latest`` each goes on by a publisher, with a cache, of its own.
        """
        lane = self._lane(sample, place)
        if lane is None:
            return ("no_key" if len(self._lanes) < MAX_LANES else "too_many_keys"), 1
        stamp = sample.timestamp or stamp
        if self._queue is None:
            try:
                lane.put(sample, stamp)
            except zenoh.ZError:
                return "error", 1
            lane.count += 1  # by one thread at a time, that of the stream's lock
            if self._acks is None:
                self._leave_unconfirmed(lane)
            return _ALL_WENT
        size = weight(sample) if size is None else size
        action = lambda: self._put(lane, sample, stamp, size)  # noqa: E731 - named for the line's length
        dropped = self._queue.send(lane, action, size, (sample, stamp))
        self._handed += 1 - dropped
        return ("overflow", dropped) if dropped else _ALL_WENT

    def wait_for_room(self, size: int) -> None:
        """Class ``reliable``: wait while the queue is full and its receiver takes something now and then.

        That stops the feeder of this stream, the application's link in the end; so only `MAX_PATIENT` streams of this
        process do so at one time, and none for a stalled receiver. Never under a lock that a flip needs.
        """
        if self._queue is None or not self._is_reliable or self._queue.has_room(size):
            return
        if _patient.acquire(blocking=False):
            try:
                self._queue.wait_for_room(size)
            finally:
                _patient.release()

    def take_back(self) -> list[Unsent]:
        """What class ``reliable`` still holds in its queue, never sent: it may go to another owner instead."""
        taken = self._queue.take_back() if self._queue is not None and self._is_reliable else []
        self._handed -= len(taken)
        return taken

    def key_of(self, sample: Sample) -> str:
        """The key that a sample goes on under (``""``: it does not fit)."""
        return self._rewriting.key(str(sample.key_expr)) or "" if self._rewriting.is_wild else self._to

    def send_end(self, epoch: int) -> None:
        """Put the end marker behind the last sample of every key; ``best_effort`` blocks while the link is full."""
        if self._queue is None:
            self._put_ends(epoch)
        else:
            self._queue.then(lambda: self._put_ends(epoch))

    def replay(self, owed: list[LeftOpen]) -> int:
        """Send what an owner that died left open, behind a marker that says so; answers how many were dropped."""
        if self._queue is None:
            return len(owed)
        counts = Counter(id(lane) for one in owed if (lane := self._lane(one.sample)) is not None)
        lanes = [(lane, counts[id(lane)]) for lane in tuple(self._lanes.values()) if counts[id(lane)]]
        self._queue.then(lambda: self._announce(lanes))
        return sum(self.send(one.sample, one.stamp)[1] for one in owed)

    def _announce(self, lanes: list[tuple[Lane, int]]) -> None:
        """The marker may be seen before samples that were put before it: what may still come is not skipped by it."""
        for lane, count in lanes:
            with self._lock:
                lowest = lane.announce(count)
            self._put_start(lane, lowest)

    def abandon(self) -> tuple[Tally, list[LeftOpen]]:
        """The receiver died: the last counts, and what it has not processed, in order; nobody else counts that."""
        waiting = self.take_back()
        said = self.undeclare()
        with self._lock:
            kept = sorted(
                ((sent, lane.eid) for lane in self._lanes.values() for sent in lane.unprocessed()),
                key=lambda one: one[0].at,
            )
            owed = [LeftOpen(sent.sample, sent.stamp, eid) for sent, eid in kept]
            if self._queue is not None and self._handed > self._left:  # its put has not ended, or not begun
                owed.append(LeftOpen(*self._queue.in_hand))
        said.in_flight -= len(owed)
        return said, owed + [LeftOpen(*one) for one in waiting]

    def undeclare(self) -> Tally:
        """Give the publishers back (a queue's thread its own); answers the last counts: what waits will not go out."""
        for lane in tuple(self._lanes.values()):
            if self._acks is not None:
                self._acks.forget(lane.eid)
        if self._queue is None:
            self._leave()
            return self.counted()
        left = self._queue.close(self._leave)
        if self._crowd is not None:
            self._crowd.close()
            return Tally(waiting=left)
        with self._lock:
            said = self._sum()
            in_hand = max(0, said.waiting - left)  # nobody will hear whether it still goes out
            said.waiting, said.in_flight = said.waiting - in_hand, said.in_flight + in_hand
            return said

    def look_after(self) -> None:
        """Have sent again what was not acknowledged in time, and greet silent workers; call it now and then."""
        if self._crowd is not None:
            self._look_after_crowd(self._crowd)
            return
        is_matching = self.is_matching
        greetings = self._greetings
        is_there = greetings.is_there(self._lanes, is_matching=is_matching) if greetings is not None else is_matching
        if self._queue is None or self._acks is None or self._queue.is_busy or not is_there:
            return  # what a put waits for now, one more would wait for behind it
        now = monotonic_s()
        with self._lock:
            late = {lane.eid: lane for lane in self._lanes.values() if lane.look_after(now)}
            self._due |= late
        if late or self._awaits_answers:
            self._queue.kick()

    def part(self, *, is_parted: bool) -> None:
        """The worker's token went: send nothing until (``is_parted`` false) another one has come."""
        if self._greetings is not None and self._queue is not None:
            self._greetings.part(is_parted=is_parted)
            self._queue.kick()

    def _look_after_crowd(self, crowd: Crowd) -> None:
        crowd.look_after()
        if self._queue is not None and not self._makes_up and crowd.owes:
            self._makes_up = True
            self._queue.then(lambda: self._make_up(crowd))

    def take_missed(self) -> int:
        """How many samples single slow receivers may have missed since the last time."""
        return 0 if self._crowd is None else self._crowd.take_missed()

    def take_left(self) -> int:
        """How many samples workers left open that another life has followed, since the last time (by one thread)."""
        before, self._left_told = self._left_told, self.tally.at_most_lost
        return self._left_told - before

    def counted(self) -> Tally:
        """What this outlet has taken and sent, and what is known of it (under the stream's lock)."""
        with self._lock:
            return self._sum()

    def _sum(self) -> Tally:
        total = self.tally.plus(self._lanes.values())
        total.waiting += self._handed - self._left
        return total

    # --- lanes -------------------------------------------------------------------------------------------------------

    def _lane(self, sample: Sample, place: int = 0) -> Lane | None:
        priority, is_express = sample.priority, sample.express
        if self._main is not None and not is_express and priority == _DATA and not place:
            return self._main
        key = self._rewriting.key(str(sample.key_expr))
        if key is None:
            return None
        name = (key, f"{priority}{is_express}", place)
        lane, now = self._lanes.get(name), monotonic_s()
        if lane is None:
            if len(self._lanes) >= MAX_LANES - MAX_LANES // ROOM_SHARE and now >= self._room_at:
                self._room_at = now + ROOM_EVERY_S
                self._make_room(now)
            if len(self._lanes) >= MAX_LANES:
                return None
            lane = self._declare(key, priority, is_express=is_express, place=place)
            if self._queue is not None and self._greetings is None and self._acks is not None:
                self._queue.then(lambda: self._put_names((lane,)))
        lane.used_at = now
        return lane

    def _make_room(self, now: float) -> None:
        """Give back the keys that have rested longest (under the stream's lock).

        Nothing of them waits here, and of what their receiver acknowledges it has all; else they stay. What it has
        said of them stays counted. A key that comes again is another publisher, which begins with number 0.
        """
        if self._queue is not None and not self._queue.is_empty:
            return
        with self._lock:
            at_rest = [name for name, lane in self._lanes.items() if self._may_leave(lane, now)]
            at_rest.sort(key=lambda name: self._lanes[name].used_at)
            left = [self._forget(name) for name in at_rest[: max(1, MAX_LANES // ROOM_SHARE)]]
        self._leave_behind(left)

    def keep_first(self) -> None:
        """Of each key give back what second and further publishers of it have put (under the stream's lock)."""
        with self._lock:
            left = [self._forget(name) for name in tuple(self._lanes) if name[2]]
        self._leave_behind(left)

    def _forget(self, name: tuple[str, str, int]) -> Lane:
        lane = self._lanes.pop(name)
        self._full.pop(lane.eid, None)
        self._due.pop(lane.eid, None)
        if self._greetings is not None:
            self._greetings.forget(lane)
        lane.is_left = True
        self.tally.unconfirmed += 0 if self._acks is None else lane.in_flight
        self.tally.take(lane.sums())
        return lane

    def _leave_behind(self, left: list[Lane]) -> None:
        for lane in left:
            if self._acks is not None:
                self._acks.forget(lane.eid)
        if left and self._queue is not None:
            self._queue.then(lambda: self._give_back(left))
        elif left:
            self._give_back(left)

    def _may_leave(self, lane: Lane, now: float) -> bool:
        is_at_rest = lane is not self._main and now - lane.used_at >= REST_S
        is_awaited = self._acks is not None and self._queue is not None and lane.in_flight > 0
        return is_at_rest and not is_awaited

    def _give_back(self, lanes: list[Lane]) -> None:
        """A worker, which waits for the end of all that it has heard, is told that nothing comes of them any more."""
        try:
            for lane in lanes:
                if self._acks is not None and lane.count:
                    self._put_left(lane)
                if self._crowd is not None:
                    self._crowd.forget(lane)
                undeclare(lane.publisher)
        except zenoh.ZError:
            _log.debug("%s: the session closed first", self._to)

    def _put_left(self, lane: Lane) -> None:
        marker = EndMarker(epoch=SKIP_EPOCH, count=lane.count, slot=self._epoch, is_given_up=True)
        priority, waits = lane.publisher.priority, self._queue is not None
        with self._stalled:
            put_marker(self._session, lane.key, lane.source_id, priority, marker, waits=waits)

    def _declare(self, key: str, priority: Priority, *, is_express: bool, place: int = 0) -> Lane:
        settings, is_reliable = self._settings, self._is_reliable
        publisher = declare_publisher(self._session, key, settings, priority, is_express=is_express)
        lane = Lane(
            key=key,
            publisher=publisher,
            source_id=publisher.id,
            eid=publisher.id.eid,
            is_whole=self._greetings is not None,
            keeps_work=self._replays,
            kept_samples=KEPT_SAMPLES if is_reliable else max(settings.depth, settings.keep_last),
            kept_least=1 if is_reliable else settings.keep_last,
            kept_limit=KEPT_BYTES if is_reliable else KEPT_BYTES_LATEST,
        )
        with self._lock:
            self._lanes[key, f"{priority}{is_express}", place] = lane
            if self._greetings is not None:
                self._greetings.add(lane)
        if self._acks is not None:
            self._acks.expect(lane.eid, lambda ack, incarnation: self._acknowledged(lane, ack, incarnation))
        return lane

    def _put_ends(self, epoch: int) -> None:
        self._has_put_ends = True
        for lane in tuple(self._lanes.values()):
            self._put_marker(lane, epoch, lane.count)

    def _put_start(self, lane: Lane, lowest: int) -> None:
        self._put_marker(lane, SKIP_EPOCH, lowest)

    def _put_marker(self, lane: Lane, epoch: int, count: int) -> None:
        replayed = max(0, lane.replay_end - count)
        is_start = epoch == SKIP_EPOCH
        marker = EndMarker(
            epoch=epoch,
            count=count,
            replayed=replayed,
            is_whole=self._is_reliable and is_start,
            slot=self._epoch if is_start and self._is_reliable else 0,
        )
        with self._stalled:
            put_marker(self._session, lane.key, lane.source_id, lane.publisher.priority, marker)

    def name_slot(self) -> None:
        """Tell a worker of class ``latest`` that has just become ready which slot it is fed from, before any value."""
        if self._queue is not None and self._greetings is None and self._acks is not None:
            self._queue.then(lambda: self._put_names(tuple(self._lanes.values())))

    def _put_names(self, lanes: tuple[Lane, ...]) -> None:
        for lane in lanes:
            marker = EndMarker(epoch=SKIP_EPOCH, count=0, slot=self._epoch)
            with self._stalled:
                put_marker(self._session, lane.key, lane.source_id, lane.publisher.priority, marker)

    def _leave(self) -> None:
        """The last words to a worker: it must not do any more what it still has, for that has been counted.

        A lane of which it has done all, and that has not ended, is left for good, too: for the worker's end, which
        waits for the end of all that it has heard, nothing comes of it any more (`reopen` of the data session, a
        changed stream, a relay that ends).
        """
        with self._lock:
            lanes = tuple(self._lanes.values())
            is_left = self._acks is not None and not self._has_put_ends
            open_lanes = [
                one for one in lanes if (is_left and one.count) or (self._greetings is not None and one.in_flight)
            ]
        try:
            for lane in open_lanes:
                self._put_left(lane)
        except zenoh.ZError:
            _log.debug("%s: the session closed first", self._to)
        self._undeclare()

    def _undeclare(self) -> None:
        try:
            for lane in tuple(self._lanes.values()):
                undeclare(lane.publisher)
            undeclare(self._probe)
        except zenoh.ZError:
            _log.debug("%s: the session closed first", self._to)

    # --- the queue's thread ------------------------------------------------------------------------------------------

    def _put(self, lane: Lane, sample: Sample, stamp: Timestamp | None, size: int) -> None:
        if self._crowd is not None:  # of an output nobody asks what became of it
            self._crowd.put(lane, sample, stamp, size)
            lane.count += 1
            return
        began = monotonic_s()
        try:
            with self._stalled:
                lane.put(sample, stamp)
        except zenoh.ZError:
            with self._lock:
                self.tally.errors += 1
                self._left += 1
            raise
        except BaseException:  # Ctrl-C in its giver's thread: it may have gone, and then its number is taken
            self._note_put(lane, sample, stamp, size, began)
            raise
        self._note_put(lane, sample, stamp, size, began)

    def _make_up(self, crowd: Crowd) -> None:
        """Put again what somebody has missed: here, where nothing that is newer waits before it."""
        self._makes_up = False
        for lane, sample, stamp in crowd.take_owed():
            self._put(lane, sample, stamp, weight(sample))

    def _note_put(self, lane: Lane, sample: Sample, stamp: Timestamp | None, size: int, began: float) -> None:
        with self._lock:
            self._left += 1
            if self._acks is None:
                lane.count += 1
                self._leave_unconfirmed(lane)
                return
            now = monotonic_s()
            ended = lane.note_put(sample, stamp, size, at=now, took_s=now - began)
            if lane.is_full():
                self._full[lane.eid] = lane
            if ended is not None:
                self.tally.take(ended)
                self.tally.uncounted += 1

    def _leave_unconfirmed(self, lane: Lane) -> None:
        """What was just put is in flight no more: its receiver will say nothing of it."""
        lane.base = lane.count
        self.tally.unconfirmed += 1

    def _is_open(self, *, greets: bool = True) -> bool:
        """Class ``reliable``: nothing goes out to a worker that was not greeted, and no more than can be sent again.

        ``greets``: in the queue's thread, which may put a marker.
        """
        if not self._is_reliable or self._acks is None:
            return True
        greetings = self._greetings
        if greetings is not None:
            if not greetings.is_there(self._lanes, is_matching=self.is_matching):
                return False
            if greetings.is_waiting and not (greets and greetings.greet(len(self._lanes))):
                return False
        if not self._full:  # the usual case, asked before every sample
            return True
        with self._lock:
            self._full = {eid: lane for eid, lane in self._full.items() if lane.is_full()}
            return not self._full

    @property
    def _awaits_answers(self) -> bool:
        return self._greetings is not None and self._greetings.is_waiting

    def _look(self) -> None:
        greetings = self._greetings
        is_awaited = greetings is not None and greetings.is_waiting
        if greetings is not None and is_awaited and greetings.is_there(self._lanes, is_matching=self.is_matching):
            greetings.greet(len(self._lanes))
        self._resend()

    def _resend(self) -> None:
        while self._due:
            with self._lock:
                lane = self._due.pop(next(iter(self._due)))
                owed = lane.take_owed()
            if owed is not NOTHING:
                self._put_owed(lane, owed)

    def _put_owed(self, lane: Lane, owed: Owed) -> None:
        for lowest in (owed.start, owed.skip):
            if lowest is not None:
                self._put_start(lane, lowest)
        for sent in owed.again:
            with self._stalled:
                lane.put_again(self._session, sent)
        if owed.again or owed.skip is not None:
            with self._lock:
                lane.resent(monotonic_s())
                self.tally.resent += len(owed.again)

    # --- acknowledgements (their thread) -----------------------------------------------------------------------------

    def _acknowledged(self, lane: Lane, ack: StreamAck, incarnation: str) -> None:
        if ack.of not in (0, mark_of(lane.key)):
            return  # a member has named our publisher under a key of its own
        now = monotonic_s()
        is_new = incarnation != lane.incarnation
        if is_new and (self._acks is None or not self._acks.has_token(incarnation)):
            return  # a stranger's; or a life that has just begun, which is greeted when its token comes
        with self._lock:
            if lane.is_left:
                return
            was_awaited = self._awaits_answers
            ended = lane.hear(ack, incarnation, now)
            if ended is not None:
                self.tally.take(ended)
            if lane.is_full():
                self._full[lane.eid] = lane
            if lane.owes:
                self._due[lane.eid] = lane
            if self._greetings is not None:
                self._greetings.heard(lane)
            has_work = was_awaited or self._awaits_answers or self._full or self._due
        if self._queue is not None and has_work:  # of a hundred keys each says something, and mostly nothing new
            self._queue.kick()
