"""One queue and one thread for all inputs of a worker: order, shedding, and the end of an epoch's inputs.

Knows: which samples wait, which sources are open, which have ended. Does not know: zenoh sessions, roles, outputs.

An end marker travels behind the data on the same link but enters through another subscriber, so it may be seen first.
It carries its source and how many samples that source put before it: it takes effect when the last of them has been
processed, or, should some have been dropped on the way, a grace time after it came.

What was processed while the worker was not the owner is processed again when it is (`zsched.worker.backlog`), before
anything newer is answered; not what its robot has given up meanwhile, by its own word or for its age.
"""

from __future__ import annotations

import logging
import math
import threading
from collections import deque
from collections.abc import Callable
from time import monotonic
from typing import Final

import zenoh

from zsched.core.hop.receiver import GIVE_UP_S, MAX_SOURCES, SourceName
from zsched.core.hop.serial import number_near, serial_of
from zsched.host.clock import monotonic_s
from zsched.host.guard import call_plain, guarded
from zsched.link.acknowledger import Acknowledger
from zsched.worker.backlog import Done, StandbyInputs
from zsched.worker.jobs import JobBook
from zsched.worker.keep import Debts, Held, KeptLane
from zsched.worker.samples import Input, Marker, OpenSource, Received, Waiting
from zsched.worker.troubles import Troubles

END_GRACE_S: Final = 0.1
JOIN_S: Final = 0.2
NAME_S: Final = 0.2
"""The first sample of a source waits this long for the marker that names its slot. That was put before it, but comes in
another thread of zenoh's."""
NAME_SHARE: Final = 0.1
"""Sources that name none, which anybody can be, cost no more than this share of the time..."""
NAME_BURST: Final = 5
"""...but for so many at once."""
MAX_WAITING: Final = 1 << 17
"""Samples of all inputs that wait; then the oldest give way. Fifty robots' relays send fewer before the first is done,
but anybody can put under ever new keys."""
MAX_DEAD: Final = 1024
"""So many samples that gave way keep their place in the queue; when more than half are such, they are taken out."""

_log = logging.getLogger("zsched.worker")


class Dispatcher:
    """The worker's own thread. ``on_ended(epoch)`` is called in it when every input seen in the epoch has ended."""

    def __init__(
        self,
        on_ended: Callable[[int], None],
        acks: Acknowledger,
        troubles: Troubles,
        debts: Debts,
        jobs: JobBook,
        has_ended: Callable[[str], bool] = lambda _session: False,
    ) -> None:
        """``has_ended``: whether nothing more comes of the session with that zenoh id, not even an end marker."""
        self._on_ended = on_ended
        self._has_ended = has_ended
        self._jobs = jobs
        self._timer = self._jobs.timer()
        """Its counts of what waits are guarded by `_wake`."""
        self._troubles = troubles
        self._acks = acks
        self._debts = debts
        self._owed: dict[KeptLane, int] = {}
        """What the callback in hand has answered: {where: the number of the next answer} (the dispatch thread's)."""
        self._stamp: zenoh.Timestamp | None = None
        self._newest_stamp: zenoh.Timestamp | None = None
        self._in_hand: int | None = None
        self._wake = threading.Condition()
        self._queue: deque[Waiting] = deque()
        self._dead = 0
        """Of `_queue`, what gave way or was given up."""
        self._markers: list[Marker] = []
        self._asked: set[int] = set()
        """Epochs whose end is to be told again if they are over."""
        self._open: dict[SourceName, OpenSource] = {}
        """What has not ended, the one that was heard last at the end."""
        self._waits_at = 0.0
        """All waits for sources that have not named their slot are made up for then."""
        self._slots: dict[SourceName, int] = {}
        """The epochs of sources that have named theirs, the oldest first."""
        self._given_up: dict[SourceName, tuple[float, int]] = {}
        """Sources of which nothing may be done any more, the oldest first: (when we heard, how much that took)."""
        self._epoch = 0
        self._begun = 0
        self._is_begin_due = False
        self._turn = 0
        self._turn_in_hand = 0
        self._is_whole = False
        """Of the input in hand everything is wanted; of any other the gates drop what comes too late."""
        self._has_withheld = False
        self._backlog = StandbyInputs[Input]()
        self._is_standby: Callable[[], bool] = _never
        self._came_at = monotonic_s()
        """When a sample came last."""
        self._is_busy = False
        self._is_closed = False
        self._is_held = False
        self._first: Callable[[], bool] | None = None
        self._thread = guarded(self._run, name="zsched dispatch")

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def close(self) -> None:
        """End the thread behind the sample it has in hand."""
        with self._wake:
            self._is_closed = True
            self._wake.notify()
        self._jobs.close()
        if self._thread is not threading.current_thread():
            self._thread.join(JOIN_S)

    def put(self, source: Input, sample: zenoh.Sample) -> None:
        """Queue a sample (zenoh's thread)."""
        key = str(sample.key_expr)
        waiting = Waiting(source, sample, came_s=monotonic())
        info = sample.source_info
        if info is not None:
            waiting.name = (key, str(info.source_id.zid), info.source_id.eid)
            if waiting.name in self._given_up and not self._is_taken_back(waiting.name):
                return
            waiting.is_whole = self._acks.is_whole(waiting.name)
            in_turn = waiting.is_wanted and sample.congestion_control == zenoh.CongestionControl.BLOCK
            number = self._acks.admit(waiting.name, info.source_sn, in_turn=in_turn)
            if number is None:
                return
            waiting.number = number
            waiting.replayed = number < self._acks.replay_end(waiting.name)
        waiting.line = waiting.name or key
        with self._wake:
            self._came_at = monotonic_s()
            self._timer.waiting += 1
            line = source.waiting.setdefault(waiting.line, deque())
            line.append(waiting)
            limit = source.newest(is_whole=waiting.is_whole) or source.depth
            while len(line) > limit:  # more than one where its class was told wrongly
                self._shed(source, line.popleft())
            self._queue.append(waiting)
            while len(self._queue) - self._dead > MAX_WAITING:
                self._shed_oldest()
            self._wake.notify()
        self._jobs.wake()

    def _shed_oldest(self) -> None:
        """The oldest sample of all gives way."""
        oldest = self._queue.popleft()
        if oldest.sample is None:
            self._dead -= 1
            return
        oldest.source.take_out(oldest)
        self._lose(oldest.source, oldest, is_newest=oldest.line not in oldest.source.waiting)

    def _shed(self, source: Input, oldest: Waiting) -> None:
        self._lose(source, oldest)
        self._note_dead(1)

    def _lose(self, source: Input, oldest: Waiting, *, is_newest: bool = False) -> None:
        """``is_newest``: nothing newer of its key takes its place."""
        oldest.sample = None
        source.shed += 1
        self._timer.skipped += 1
        self._timer.waiting -= 1
        if (oldest.is_wanted or is_newest) and oldest.name is not None:
            self._acks.shed(oldest.name)

    def _note_dead(self, count: int) -> None:
        """Samples of the queue are gone (under the lock): behind a callback that hangs their places do not pile up."""
        self._dead += count
        if self._dead > max(MAX_DEAD, len(self._queue) // 2):
            self._queue = deque(one for one in self._queue if one.sample is not None)
            self._dead = 0

    def put_marker(self, marker: Marker) -> None:
        """Queue an end marker (zenoh's thread)."""
        if marker.end.epoch == 0:  # it ends nothing: what is below its number was given up by the relay
            if marker.end.is_given_up:
                self._give_up(marker.name, marker.came_at)
                return
            end = marker.end
            if end.slot:
                self._note_slot(marker)
                if not end.is_whole:
                    return
            self._acks.skip(marker.name, end.count)
            self._acks.note_start(marker.name, end.count, is_whole=end.is_whole, replayed=end.replayed)
            return
        with self._wake:
            if len(self._markers) < MAX_SOURCES:  # more of them are a stranger's
                self._markers.append(marker)
                self._wake.notify()

    def _note_slot(self, marker: Marker) -> None:
        """A publisher feeds one slot for all its life: two words that differ count as none, one is a stranger's."""
        with self._wake:
            if self._slots.setdefault(marker.name, marker.end.slot) != marker.end.slot:
                self._slots[marker.name] = 0
            state = self._open.get(marker.name)
            if state is not None and state.in_turn:  # it was heard before its name was
                state.epoch = self._slots[marker.name] or state.epoch
            if len(self._slots) > MAX_SOURCES:
                self._slots.pop(next(iter(self._slots)))
            self._wake.notify()

    def _give_up(self, name: SourceName, at: float) -> None:
        """Do nothing of a source any more, and acknowledge nothing: its relay counts that, or has counted it."""
        with self._wake:
            if name in self._given_up:
                return
            self._given_up[name] = at, 0
            if len(self._given_up) > MAX_SOURCES:
                self._given_up.pop(next(iter(self._given_up)))
            waiting = [one for one in self._queue if one.name == name and one.sample is not None]
            for one in waiting:
                one.source.take_out(one)
                one.sample = None
            self._timer.waiting -= len(waiting)
            self._note_dead(len(waiting))
            count = len(waiting) + self._backlog.forget(name)
            self._given_up[name] = at, count
            self._open.pop(name, None)
            self._markers = [marker for marker in self._markers if marker.name != name]
        self._debts.forget(name)
        if count:
            _log.info("%s: %d samples are not done any more: their robot has given them up", name[0], count)

    def _abandon(self, name: SourceName | None) -> None:
        """A sample without an answer was in hand when its source was given up: it goes where the rest has gone."""
        if name is None:
            return
        self._debts.forget(name)  # it may have been held back since
        with self._wake:
            if name in self._given_up:
                at, count = self._given_up[name]
                self._given_up[name] = at, count + 1
                return
        self._acks.shed(name)

    def _is_taken_back(self, name: SourceName) -> bool:
        """A sample has come of a source that was given up.

        A relay sends nothing behind that word, which can overtake what was before it by a moment only. Later ones show
        that it was a stranger's; then what it took is lost.
        """
        with self._wake:
            at, count = self._given_up[name]
            if monotonic_s() - at <= GIVE_UP_S:
                return False
            del self._given_up[name]
        for _ in range(count):
            self._acks.shed(name)
        return True

    def _is_given_up(self, name: SourceName | None, again: Done[Input] | None) -> bool:
        """What was acknowledged is not meant: it is processed again for a state that takes the place of ours."""
        return name in self._given_up and (again is None or again.quiet_at is None)

    def epoch_in_hand(self) -> int | None:
        """In the dispatch thread: the epoch in which the source of the input in hand was first heard."""
        return self._in_hand if threading.current_thread() is self._thread else None

    def must_wait(self, epoch: int) -> bool:
        """In the dispatch thread: what is made of the input in hand must not go out yet, though the role allows it.

        The role of ``epoch`` has come and `begin` not yet; or another output of this input was withheld, or an older
        one is still to be answered and nothing may be skipped: then it is processed again in its turn.
        """
        if threading.current_thread() is not self._thread:
            return False
        is_early = self._is_begin_due or self._epoch != epoch
        is_late = self._is_whole and self._backlog.is_before(self._turn_in_hand)
        is_behind = self._in_hand is not None and (self._has_withheld or is_late)
        return is_early or is_behind

    def owe(self, lane: KeptLane, number: int) -> None:
        """An answer is put (any thread; in ours it belongs to the input in hand, which is not done without it)."""
        if threading.current_thread() is self._thread:
            self._owed[lane] = number + 1

    def stamp(self) -> zenoh.Timestamp | None:
        """The timestamp for an output: of the input in hand (in the dispatch thread), else of the newest processed."""
        return self._stamp if threading.current_thread() is self._thread else self._newest_stamp

    def remember(self, is_standby: Callable[[], bool]) -> None:
        """Keep every sample that is processed while ``is_standby``: a predecessor's state may take over from ours."""
        self._is_standby = is_standby

    def expect_begin(self, *, is_due: bool) -> None:
        """A role comes that `begin` follows, and until then outputs are withheld; or one that takes that back."""
        with self._wake:
            self._is_begin_due = is_due
            self._wake.notify()

    def begin(self, epoch: int) -> None:
        """This worker is the owner from now on: sources heard first from here on belong to ``epoch``.

        Those that have not named theirs.
        """
        with self._wake:
            stale = self._backlog.stale(epoch, monotonic_s())
        for name in stale:
            self._give_up(name, math.inf)
        with self._wake:
            self._epoch = epoch
            self._is_begin_due = False
            self._begun += 1
            self._backlog.begin(is_settled=not self._is_held and self._first is None)
            self._wake.notify()

    def forget(self, epoch: int) -> None:
        """The epoch is over for this worker: what has not ended will not."""
        with self._wake:
            self._open = {name: state for name, state in self._open.items() if state.epoch > epoch}

    def hold(self) -> None:
        """Process no input until `release`: a predecessor's state comes first."""
        with self._wake:
            self._is_held = True

    def release(self, first: Callable[[], bool]) -> None:
        """Call ``first`` in the dispatch thread, then process what has come; it answers whether our state changed."""
        with self._wake:
            self._is_held, self._first = False, first
            self._wake.notify()

    def has_waiting(self, epoch: int) -> bool:
        """Whether an input of the epoch, or an older one, has come and is not processed."""
        with self._wake:
            heard = {name for name, state in self._open.items() if state.epoch <= epoch}
            is_queued = any(waiting.sample is not None and waiting.name in heard for waiting in self._queue)
            return is_queued or (self._in_hand is not None and self._in_hand <= epoch) or self._backlog.owes(epoch)

    def has_ended(self, epoch: int) -> bool:
        """Whether every input that was heard in the epoch, or an older one, has ended."""
        with self._wake:
            return self._oldest_open() > epoch

    def is_still(self, quiet_s: float) -> bool:
        """Whether all that has come is processed, and nothing has come for so long."""
        with self._wake:
            is_free = not self._is_busy and not self._has_work()
            return is_free and monotonic_s() - self._came_at >= quiet_s

    def has_begun(self, epoch: int) -> bool:
        """Whether `begin` has come for the epoch, or a newer one."""
        return self._epoch >= epoch

    def look_for_end(self, epoch: int) -> None:
        """Call ``on_ended`` once more if the epoch is over, behind what was withheld."""
        with self._wake:
            self._asked.add(epoch)
            self._wake.notify()

    def note_withheld(self) -> None:
        """An output went nowhere because this worker is not the owner (any thread; ours means: of this sample)."""
        if threading.current_thread() is self._thread:
            self._has_withheld = True

    # --- the thread --------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        while True:
            with self._wake:
                if not self._has_work() and not self._is_closed:
                    self._wake.wait(END_GRACE_S / 2 if self._markers else None)
                if self._is_closed:
                    return
                first, self._first = self._first, None
                claimed = None if self._is_held or first is not None else self._claim()
                self._is_busy = first is not None or claimed is not None
            if first is not None:
                is_restored = first()
                with self._wake:
                    self._backlog.settle(is_restored=is_restored, now=monotonic_s())
            if claimed is not None:
                self._process(claimed)
            self._is_busy = False
            if (self._markers or self._asked) and not self._owes_withheld():
                self._settle()

    def _owes_withheld(self) -> bool:
        """Whether something withheld is answered before any end: when `begin` comes, or now that it has come."""
        return self._is_begin_due or self._backlog.is_due

    def _has_work(self) -> bool:
        is_asked = bool(self._asked) and not self._owes_withheld()
        is_to_do = bool(self._queue) or self._backlog.is_due
        return self._first is not None or is_asked or (not self._is_held and is_to_do)

    def _claim(self) -> Waiting | None:
        """Take the next sample out of its key's line (under the lock): from here on nothing sheds it."""
        if (done := self._backlog.take()) is not None:
            return Waiting(done.source, done.sample, replayed=done.replayed, is_whole=done.is_whole, again=done)
        waiting = self._queue.popleft() if self._queue else None
        if waiting is None:
            return None
        if waiting.sample is None:
            self._dead -= 1
            return None
        waiting.source.take_out(waiting)
        self._timer.waiting -= 1
        self._timer.least = min(self._timer.least, self._timer.waiting)
        return waiting

    def _process(self, waiting: Waiting) -> None:
        source, sample = waiting.source, waiting.sample
        name = waiting.name if waiting.again is None else waiting.again.name
        if sample is None:
            return
        if self._is_given_up(name, waiting.again):
            self._abandon(name)
            return
        began_at = monotonic_s()
        self._has_withheld = False
        self._owed.clear()
        begun, was_standby, again = self._begun, self._is_standby(), waiting.again
        if again is None:
            self._turn = self._turn_in_hand = self._turn + 1
            epoch = self._hear(waiting.name, sample) if waiting.name is not None else self._epoch
        else:
            self._turn_in_hand, epoch = again.turn, again.epoch
        self._in_hand, self._is_whole = epoch, waiting.is_wanted
        self._dispatch(source, sample, waiting.came_s if again is None else None, replayed=waiting.replayed)
        self._in_hand = None
        if self._is_given_up(name, waiting.again):
            if self._has_withheld:
                self._abandon(name)
            return
        held = None if again is None else again.held
        if waiting.name is not None:
            held = self._note(waiting, waiting.name, sample)
        if held is not None and not self._has_withheld:
            self._debts.answered(held, self._owed, monotonic_s())
            held = None
        if not self._has_withheld and not was_standby:
            return
        quiet_at = None if self._has_withheld else monotonic_s()
        done = Done(
            source,
            sample,
            self._turn_in_hand,
            epoch,
            quiet_at,
            waiting.replayed,
            name,
            waiting.is_whole,
            held,
            slot=0 if name is None else self._slots.get(name, 0),
            at=began_at if again is None else again.at,
        )
        crowded_out: list[Done[Input]] = []
        with self._wake:
            is_given_up = self._is_given_up(name, again)
            if not is_given_up and self._begun != begun:  # it became the owner meanwhile
                self._backlog.put_back(done)
            elif not is_given_up:
                crowded_out = self._backlog.keep(done)
        if is_given_up and self._has_withheld:
            self._abandon(name)
        for lost in crowded_out:
            if lost.name is not None:
                self._acks.shed(lost.name)
            if lost.held is not None:
                self._debts.answered(lost.held, {}, monotonic_s())

    def _dispatch(self, source: Input, sample: zenoh.Sample, came_s: float | None, *, replayed: bool) -> None:
        key = str(sample.key_expr)
        received = Received(
            key=key,
            payload=sample.payload,
            attachment=sample.attachment,
            encoding=str(sample.encoding),
            deleted=sample.kind == zenoh.SampleKind.DELETE,
            replayed=replayed,
        )
        self._stamp = sample.timestamp
        self._timer.begin()
        try:
            call_plain(source.on_sample, received)
        except BaseException as error:  # noqa: BLE001 - the worker's own bug must not end its dispatch
            self._troubles.note(key, error)
        self._timer.end(came_s)
        newest = self._newest_stamp
        if self._stamp is not None and (newest is None or newest < self._stamp):  # type: ignore[operator] # zenoh's stubs
            self._newest_stamp = self._stamp

    def _hear(self, name: SourceName, sample: zenoh.Sample) -> int:
        """The epoch that a source belongs to: the one that it has named, else the one in which it is first heard."""
        with self._wake:
            state = self._open.pop(name, None)
            if state is None:
                in_turn = sample.congestion_control == zenoh.CongestionControl.BLOCK
                if in_turn and self._epoch:  # a standby's answers are withheld, whatever the epoch
                    self._await_name(name)
                state = OpenSource(epoch=self._slots.get(name) or self._epoch, in_turn=in_turn)
            if name not in self._given_up:
                self._open[name] = state
                if len(self._open) > MAX_SOURCES:  # a stranger's, or one that has not said a word for long
                    self._open.pop(next(iter(self._open)))
            return state.epoch

    def _await_name(self, name: SourceName) -> None:
        """Wait for the marker that names a source's slot (under the lock)."""
        pause_s = NAME_S / NAME_SHARE
        if monotonic_s() < self._waits_at - NAME_BURST * pause_s:
            return
        if not self._wake.wait_for(lambda: name in self._slots or self._is_closed, NAME_S):
            self._waits_at = max(self._waits_at, monotonic_s()) + pause_s

    def _note(self, waiting: Waiting, name: SourceName, sample: zenoh.Sample) -> Held | None:
        """A numbered sample is processed; where it must not be lost, when its answers have reached the robots.

        Answers what waits until it has been processed again, where an answer was withheld.
        """
        number = waiting.number
        with self._wake:
            state = self._open.get(name)
            if state is not None:
                state.number = max(state.number, number)
                if self._has_ended(name[1]):  # nobody ends it: this may have been its last sample
                    self._asked.add(state.epoch)
        if waiting.is_wanted and sample.congestion_control == zenoh.CongestionControl.BLOCK:
            is_unanswered = self._has_withheld and waiting.is_whole
            size = len(sample.payload)
            held = self._debts.processed(name, number, size, self._owed, is_unanswered=is_unanswered)
            return held if is_unanswered else None
        self._acks.processed(name, number, len(sample.payload))
        return None

    def _settle(self) -> None:
        """Let every marker take effect whose samples are processed, then tell which epochs are over."""
        now = monotonic_s()
        with self._wake:
            done, self._markers = self._parted(now)
            for marker in done:
                self._open.pop(marker.name, None)
                self._acks.skip(marker.name, marker.end.count)  # what has not come by now is lost, and is said to be
            ended = {marker.end.epoch for marker in done} | self._asked
            self._asked.clear()
            oldest = self._oldest_open() if ended else 0
            over = sorted(epoch for epoch in ended if epoch < oldest)
        if over:
            self._acks.flush()  # so that what is processed is known to be when the ends arrive
        for epoch in over:
            self._on_ended(epoch)

    def _parted(self, now: float) -> tuple[list[Marker], list[Marker]]:
        """The markers that take effect now, and those that wait."""
        parts: tuple[list[Marker], list[Marker]] = ([], [])
        for marker in self._markers:
            parts[not self._is_due(marker, now)].append(marker)
        return parts

    def _is_due(self, marker: Marker, now: float) -> bool:
        state = self._open.get(marker.name)
        number = state.number if state is not None else -1
        if number + 1 >= number_near(serial_of(marker.end.count), number + 1):
            return True
        grace_s = GIVE_UP_S if state is not None and state.in_turn else END_GRACE_S
        return not self._queue and now - marker.came_at > grace_s

    def _oldest_open(self) -> float:
        """The oldest epoch in which an input was heard that has not ended (under the lock); infinite: all have.

        One that nobody is there to end any more has ended when all that has come of it is processed.
        """
        waiting = {one.name for one in self._queue if one.sample is not None}
        opened = self._open.items()
        left = (state.epoch for name, state in opened if name in waiting or not self._has_ended(name[1]))
        return min(left, default=math.inf)


def _never() -> bool:
    return False
