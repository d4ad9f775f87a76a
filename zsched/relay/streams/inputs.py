"""Carries one input stream of this node to the task's owner: keeps the last values, warms up, flips.

Knows: which slots are open and which one the stream feeds. Does not know: why or when (the task tells it).

Everything happens under the stream's lock, the sample that just came included: between the kept values that a flip
sends and the first sample behind it there is no gap. A kept value reaches a new owner at least once; it may have
reached the old one too. With ``on_crash: replay`` the same holds for what an owner that died had not acknowledged,
unless its answers prove it done (`zsched.relay.streams.proofs`); and what comes while there is no owner waits for one.
While the data session is opened anew (`InputStream.hold` .. `resume`) what comes waits, and goes out behind the rest.
An owner that is left may stop before it has done all that was on its way to it (an exclusive one does so at once): so
with ``replay`` what comes behind a flip is held until its slot has ended, and goes out behind what it leaves.
"""

from __future__ import annotations

import math
import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Sequence
from typing import Final

import zenoh
from zenoh import Sample, Session, Timestamp

from zsched.core.values.plan import OnCrash, Route, StreamClass, StreamCount
from zsched.core.values.struct import Struct
from zsched.host.clock import monotonic_s
from zsched.link.sessions.send_queue import MAX_BYTES
from zsched.link.weight import weight
from zsched.relay.streams.acks import WorkerAcks
from zsched.relay.streams.answer_times import AnswerTimes
from zsched.relay.streams.counter import StreamCounter
from zsched.relay.streams.outlet import MAX_OWED, QUEUE_DEPTH, Outlet, Unsent
from zsched.relay.streams.pace import Pace
from zsched.relay.streams.places import Places, PublisherId
from zsched.relay.streams.proofs import LeftOpen, Stamps, unproven
from zsched.relay.streams.receive import Receiver
from zsched.relay.streams.tally import Tally

MAX_KEYS: Final = 4096
"""Lines of one stream whose values are kept; the oldest give way."""

HOLD_S: Final = 1.0
"""An owner that was left may take this long to end its slot; nobody waits for one that hangs."""
MAX_PAUSED: Final = QUEUE_DEPTH
"""Samples that wait while the data session is opened anew; a queue must take them behind what it has."""
MAX_HELD: Final = MAX_OWED // 2
"""More samples than that are not held either: the next owner's queue has to take them."""

_Line = tuple[str, int]
"""(key, place of the publisher): what class ``latest`` keeps the newest values of."""
_NO_LINE: Final[_Line] = ("", 0)
_Kept = tuple[int, Sample, Timestamp]
KeptValues = Sequence[tuple[Sample, Timestamp]]
"""The newest values of each line, with their timestamps, in the order in which they came."""


def _never(_stamp: Timestamp) -> bool:
    return False


class _InputSlot(Struct):
    outlet: Outlet
    route: Route
    epoch: int
    acks: WorkerAcks | None
    """Its worker acknowledges what it has processed; ``None``: it does not."""
    said: Tally | None = None
    """The last counts of the outlet, once that is closed and until the next one is there."""
    sent: int = 0
    """Number of the newest sample that went into this slot; kept values above it are still owed."""
    lacks_newest: bool = False
    """Something of it was given up with a data session: the newest value of each key is owed once more."""

    @property
    def is_counted(self) -> bool:
        """Whether its worker acknowledges what it has processed."""
        return self.acks is not None

    def tally(self) -> Tally:
        """The outlet's counts (under the stream's lock)."""
        return self.outlet.counted() if self.said is None else self.said


class InputStream:
    """One input rule on this node; slots are named by their epoch."""

    def __init__(
        self,
        session: Session,
        route: Route,
        own_ids: frozenset[str],
        local: Session | None = None,
        times: AnswerTimes | None = None,
        *,
        kept: KeptValues = (),
    ) -> None:
        """Subscribe on ``local``, the host's own side, if there is one; ``session`` is the fleet's.

        ``kept``: values of these keys that came before, in order.
        """
        self.route = route
        self._times = times
        self._session = session
        side = self._clock = local or session  # the fleet's may be closed for a moment
        self._lock = threading.Lock()
        self._counter = StreamCounter(route.stream)
        self._slots: dict[int, _InputSlot] = {}
        self._active: _InputSlot | None = None
        self._mirror: _InputSlot | None = None
        is_latest = route.settings.stream_class is StreamClass.LATEST
        max_hz = route.settings.max_hz
        self._pace: Pace[tuple[Sample, Timestamp | None, int]] | None = (
            None if max_hz is None else Pace(max_hz, remembers=is_latest)
        )
        self._replays = route.settings.on_crash is OnCrash.REPLAY
        self._owed_bytes = 0
        self._owed: list[LeftOpen] = []
        """What waits for the next owner: an owner that died had not acknowledged it, or there was none."""
        self._next: _InputSlot | None = None
        """Flipped to, and waits until..."""
        self._waits_for: _InputSlot | None = None
        """...this slot, which carried, has ended."""
        self._held: list[Unsent] = []
        self._held_bytes = 0
        self._hold_until = 0.0
        self._is_paused = False
        self._paused: deque[Unsent] = deque()
        """What has come since `hold`; of class ``latest`` the kept values say it."""
        self._paused_bytes = 0
        self._is_patient = route.settings.stream_class is StreamClass.RELIABLE
        self._number = 0
        self._keep_last = route.settings.keep_last if is_latest else 0
        self._kept: OrderedDict[_Line, deque[_Kept]] = OrderedDict()
        self._receiver: Receiver | None = None
        self._places = Places(self._is_there)
        for sample, stamp in kept if self._keep_last else ():
            self._number += 1
            self._keep(self._line(sample), sample, stamp)
        self._closed = Tally()  # what slots that are closed have counted
        self._is_counted = False
        """Some worker has acknowledged what it has processed, or will."""
        self._stamps: Stamps | None = None
        self._loop_ids = own_ids - {str(side.zid())}
        self._has_end = False
        """We are closed."""
        self._receiver = self._subscribe(side)
        self._ending: Receiver | None = None
        """It has unsubscribed, and may still have samples in hand: a full queue holds them up."""

    def _subscribe(self, side: Session) -> Receiver:
        return Receiver(
            side,
            self.route.from_expr,
            self.route.settings,
            self._carry,
            with_history=True,
            give_way=self._give_way,
            origin=zenoh.Locality.ANY,
        )

    def open(self, epoch: int, route: Route, acks: WorkerAcks | None = None, stamps: Stamps | None = None) -> None:
        """Declare the publishers of a slot; it carries nothing yet. With ``acks`` its worker counts what it gets.

        ``stamps`` gets every sample's timestamp: an input of the task is of `OnCrash.REPLAY`.

        Raises:
            ValueError, zenoh.ZError: the route makes no sense (see `Outlet`).
        """
        outlet = Outlet(self._session, route.from_expr, route.to_expr, route.settings, acks, epoch=epoch)
        with self._lock:
            self._is_counted |= acks is not None
            self._stamps = stamps
            self._slots[epoch] = _InputSlot(outlet=outlet, route=route, epoch=epoch, acks=acks)

    def has_slot(self, epoch: int) -> bool:
        """Whether a slot is open."""
        return epoch in self._slots

    def is_matching(self, epoch: int) -> bool:
        """True when somebody subscribes to the slot's keys."""
        slot = self._slots.get(epoch)
        return slot is not None and slot.outlet.is_matching

    def take_returned(self, epoch: int) -> bool:
        """Whether somebody subscribed to the slot's keys after nobody did (`Outlet.take_returned`)."""
        slot = self._slots.get(epoch)
        return slot is not None and slot.outlet.take_returned()

    def warm_up(self, epoch: int) -> int:
        """Send every kept value to a worker that has just become ready (again); answers how many."""
        with self._lock:
            slot = self._slots.get(epoch)
            if slot is None:
                return 0
            slot.sent = 0  # whatever went there before, this worker has not had it
            slot.outlet.name_slot()
            return self._catch_up(slot)

    def is_behind(self, epoch: int) -> bool:
        """True when a kept value has changed since the slot was warmed up: what it made of the old one is stale."""
        with self._lock:
            slot = self._slots.get(epoch)
            return slot is not None and any(
                number > slot.sent for values in self._kept.values() for number, _, _ in values
            )

    def flip(self, epoch: int, *, is_old_dead: bool = False, has_answer: Callable[[Timestamp], bool] = _never) -> int:
        """Feed the slot from now on, behind the kept values it has not had; answers how many those were.

        ``is_old_dead``: the worker of the slot that carried is gone. ``has_answer`` says of the timestamp of a sample
        that such a worker had not acknowledged, whether an answer of this sample and no other one has passed.
        """
        with self._lock:
            slot = self._slots.get(epoch)
            if slot is None or slot is self._active or slot is self._next:
                return 0
            self._end_hold(has_answer)
            if is_old_dead and self._replays:
                self._abandon(self._active)
            if self._replays and self._active is not None:
                said = self._active.outlet.counted()
                if said.in_flight or said.waiting:
                    self._hold(self._active, slot)
                    return 0
            replayed = self._catch_up(slot) + self._replay(slot, has_answer)
            if self.route.settings.mirror:
                self._mirror = self._active
            elif self._active is not None:
                for sample, stamp in self._active.outlet.take_back():
                    self._counter.dropped(*slot.outlet.send(sample, stamp))
            self._active = slot
            return replayed

    def end_slot(self, epoch: int, *, has_answer: Callable[[Timestamp], bool] = _never) -> None:
        """The slot that was left has drained, or its worker is gone: what it has not done goes out before the rest."""
        with self._lock:
            slot = self._slots.get(epoch)
            if self._next is None or slot is None or slot is self._next:
                return
            del self._slots[epoch]
            self._settle(slot)
            self._end_hold_behind(slot, has_answer)

    def send_end(self, epoch: int) -> None:
        """Put the end marker behind the slot's last sample (it must not be the active one); may block on its link."""
        slot = self._slots.get(epoch)
        if slot is not None and slot is not self._active and slot is not self._mirror:
            slot.outlet.send_end(epoch)

    def part(self, epoch: int, *, is_parted: bool) -> None:
        """The token of the slot's worker went, or another one has come."""
        slot = self._slots.get(epoch)
        if slot is not None:
            slot.outlet.part(is_parted=is_parted)

    def has_settled(self, epoch: int) -> bool:
        """True when the slot's worker has acknowledged everything that it was sent."""
        with self._lock:
            slot = self._slots.get(epoch)
            return slot is None or not slot.is_counted or not slot.outlet.counted().in_flight

    def take_left(self, epoch: int) -> int:
        """How many samples the slot's worker left open when it died and restarted in place, since the last time."""
        slot = self._slots.get(epoch)
        return slot.outlet.take_left() if slot is not None and slot.is_counted else 0

    def close_slot(self, epoch: int, *, has_answer: Callable[[Timestamp], bool] = _never) -> int:
        """Forget a slot; answers how many samples its worker had not processed when it was last heard of.

        With `OnCrash.REPLAY` the next owner gets those instead (``has_answer`` as in `flip`).
        """
        with self._lock:
            slot = self._slots.pop(epoch, None)
            if slot is None:
                return 0
            if slot is self._active:
                self._active = None
            if slot is self._mirror:
                self._mirror = None
            if slot is self._next:
                held, self._held, self._held_bytes = self._held, [], 0
                self._next = self._waits_for = None
                self._owe([LeftOpen(*one) for one in held])
            if slot.said is not None:  # between two data sessions: it has been settled
                self._closed.add(slot.said)
                return 0
            if self._replays and slot.is_counted:
                return self._leave(slot, has_answer)
            said = slot.outlet.undeclare()
            self._counter.dropped("closed", said.waiting)
            left = said.in_flight if slot.is_counted else 0
            said.at_most_lost += left
            said.unconfirmed += said.in_flight - left
            said.in_flight = said.waiting = 0
            self._closed.add(said)
            return left

    def finish(self) -> None:
        """Unsubscribe; what waits behind a flip goes out now, and is waited for with the rest (`under_way`)."""
        self.stop()
        with self._lock:
            self._end_hold()

    def stop(self) -> None:
        """Unsubscribe; what a rate has held back goes out now, for nobody looks after it any more."""
        receiver, self._receiver = self._receiver, None
        if receiver is not None:
            self._ending = receiver
            receiver.close()
        with self._lock:
            self._send_passed_over(math.inf)

    def close(self) -> None:
        """Unsubscribe and close every slot; what has come by then is counted when this returns."""
        self.stop()
        with self._lock:
            self._has_end = True
            self._counter.dropped("closed", len(self._paused))
            self._paused.clear()
        for epoch in tuple(self._slots):
            self.close_slot(epoch)
        ending, self._ending = self._ending, None
        if ending is not None:  # it waits at no slow worker any more
            ending.wait()

    # --- another data session ----------------------------------------------------------------------------------------

    def hold(self) -> None:
        """Let what comes wait from now on, and what is under way arrive."""
        with self._lock:
            self._end_hold()
            self._is_paused = True

    def under_way(self) -> int:
        """How many samples have been taken before `hold` and have not arrived, as far as we know."""
        with self._lock:
            tallies = [(slot.tally(), slot.is_counted) for slot in self._slots.values()]
        return sum(said.waiting + (max(0, said.in_flight) if is_counted else 0) for said, is_counted in tallies)

    def leave(self) -> int:
        """Close every slot's publishers, behind `hold`; answers how many samples workers had not acknowledged.

        With `OnCrash.REPLAY` those are sent again, by `resume`. The slots stay.
        """
        left = 0
        with self._lock:
            for slot in self._slots.values():
                if self._replays and slot.is_counted:
                    slot.said, owed = slot.outlet.abandon()
                    self._owe(owed)
                else:
                    waiting = slot.outlet.take_back()
                    if slot is self._active:
                        self._paused.extendleft(reversed(waiting))
                    else:
                        self._counter.dropped("closed", len(waiting))
                    slot.said = slot.outlet.undeclare()
                    self._counter.dropped("closed", slot.said.waiting)
                said = slot.said
                gone = max(0, said.in_flight) if slot.is_counted else 0
                slot.lacks_newest |= bool(gone or said.waiting)
                said.at_most_lost += gone
                said.unconfirmed += max(0, said.in_flight) - gone
                said.in_flight = said.waiting = 0
                left += gone
        return left

    def rejoin(self, session: Session, own_ids: frozenset[str]) -> None:
        """Declare every slot's publishers on another session; nothing goes out before `resume`.

        Raises:
            ValueError, zenoh.ZError: as `open`.
        """
        with self._lock:
            self._session = session
            self._loop_ids = own_ids - {str(self._clock.zid())}
            for slot in self._slots.values():
                route = slot.route
                outlet = Outlet(session, route.from_expr, route.to_expr, route.settings, slot.acks, epoch=slot.epoch)
                if slot.said is not None:
                    self._closed.add(slot.said)
                slot.outlet, slot.said = outlet, None

    def resume(self) -> None:
        """Send what has waited, in order, and carry on."""
        with self._lock:
            if not self._is_paused:
                return
            self._is_paused = False
            if self._active is not None:
                self._catch_up(self._active)
                self._replay(self._active, _never)
            paused, self._paused, self._paused_bytes = self._paused, deque(), 0
            for sample, stamp in paused:
                self._route_on(sample, stamp, weight(sample))

    # --- a crash, with `OnCrash.REPLAY` (under the lock) --------------------------------------------------------------

    def _leave(self, slot: _InputSlot, has_answer: Callable[[Timestamp], bool]) -> int:
        """A slot closes: what its worker has not processed waits for the next owner, or goes to the one there is."""
        left = self._settle(slot)
        self._end_hold_behind(slot, has_answer)
        if self._active is not None:
            self._replay(self._active, has_answer)
        return left

    def _abandon(self, slot: _InputSlot | None) -> None:
        """The worker that carried is gone: its slot counts nothing from here on, and the next one gets what it had."""
        for epoch in [epoch for epoch, one in self._slots.items() if one is slot]:
            self._settle(self._slots.pop(epoch))
        self._active = None

    def _settle(self, slot: _InputSlot) -> int:
        said, owed = slot.outlet.abandon()
        left = max(0, said.in_flight)  # what was not kept: nothing, while bounds hold
        said.at_most_lost += left
        said.in_flight = said.waiting = 0
        self._closed.add(said)
        self._owe(owed)
        return left

    def _owe(self, owed: list[LeftOpen]) -> None:
        for one in owed:
            size = weight(one.sample)
            if len(self._owed) < MAX_OWED and self._owed_bytes + size <= MAX_BYTES:
                self._owed.append(one)
                self._owed_bytes += size
            else:
                self._counter.dropped("overflow")

    def _replay(self, slot: _InputSlot, has_answer: Callable[[Timestamp], bool]) -> int:
        owed, self._owed, self._owed_bytes = self._owed, [], 0
        left = unproven(owed, has_answer)
        self._closed.acknowledged += len(owed) - len(left)
        if left:
            self._counter.replayed += len(left)
            self._counter.dropped("overflow", slot.outlet.replay(left))
        return len(left)

    def _hold(self, left: _InputSlot, slot: _InputSlot) -> None:
        self._active, self._next, self._waits_for = None, slot, left
        self._hold_until = monotonic_s() + HOLD_S
        self._held = left.outlet.take_back()
        self._held_bytes = sum(weight(sample) for sample, _ in self._held)

    def _end_hold_behind(self, slot: _InputSlot, has_answer: Callable[[Timestamp], bool]) -> None:
        """End the wait if it is for this slot's end, and not for a later one's."""
        if slot is self._waits_for:
            self._end_hold(has_answer)

    def _end_hold(self, has_answer: Callable[[Timestamp], bool] = _never) -> None:
        """Feed the slot that waits: first what is owed to it, then what has come since the flip."""
        slot, self._next, self._waits_for = self._next, None, None
        if slot is None:
            return
        self._active = slot
        self._replay(slot, has_answer)
        held, self._held, self._held_bytes = self._held, [], 0
        for sample, stamp in held:
            self._counter.dropped(*slot.outlet.send(sample, stamp))
        slot.sent = self._number

    def kept(self) -> KeptValues:
        """The values of class ``latest`` that the next owner is owed."""
        with self._lock:
            values = [one for line in self._kept.values() for one in line]
        return [(sample, stamp) for _, sample, stamp in sorted(values, key=lambda one: one[0])]

    @property
    def is_still(self) -> bool:
        """Whether no sample has come for a while (`StreamCounter.is_still`)."""
        return self._counter.is_still

    def look_after(self) -> None:
        """Have sent (again) what workers have not acknowledged in time, or a rate held back; call it now and then."""
        with self._lock:
            if self._next is not None and monotonic_s() > self._hold_until:
                self._end_hold()
            if not self._is_paused:  # else `resume` sends it, behind what came before
                self._send_passed_over(monotonic_s())
        for slot in tuple(self._slots.values()):
            slot.outlet.look_after()

    def _send_passed_over(self, now: float) -> None:
        """Send the newest values that the rate has held back till now (under the lock)."""
        if self._pace is not None and self._keep_last and self._active is not None:
            for sample, stamp, place in self._pace.overdue(now):
                self._counter.repeated += 1  # it has been counted as thinned
                self._send(sample, stamp, place=place)

    def count(self) -> StreamCount:
        """The counters now."""
        with self._lock:
            total = Tally()
            total.add(self._closed)
            total.waiting += len(self._owed) + len(self._held) + len(self._paused)
            for slot in self._slots.values():
                total.add(slot.tally())
            return self._counter.value(total, has_acks=self._is_counted)

    # --- one sample --------------------------------------------------------------------------------------------------

    def _carry(self, sample: Sample) -> None:
        active, size = self._active, weight(sample)
        if active is not None and self._is_patient and not self._is_paused:
            active.outlet.wait_for_room(size)
        with self._lock:
            self._counter.seen(len(sample.payload))
            if self._loop_ids and _is_own(sample, self._loop_ids):
                self._counter.dropped("loop")
                return
            self._number += 1
            pace = self._pace
            line = self._line(sample) if self._keep_last or pace is not None else _NO_LINE
            stamp = self._keep(line, sample, sample.timestamp) if self._keep_last else self._stamp(sample)
            if self._stamps is not None and (known := stamp or sample.timestamp) is not None:
                self._stamps.note(known)
            if pace is not None and not pace.passes(line, (sample, stamp, line[1]), monotonic_s()):
                self._counter.dropped("thinned")
            elif not self._is_paused:
                self._route_on(sample, stamp, size, place=line[1])
            elif self._keep_last:
                self._counter.unsent += 1
            elif len(self._paused) < MAX_PAUSED and self._paused_bytes + size <= MAX_BYTES // 2:
                self._paused.append((sample, stamp))
                self._paused_bytes += size
            else:
                self._counter.dropped("overflow")

    def _is_there(self, publisher: PublisherId) -> bool | None:
        return None if self._receiver is None else self._receiver.is_there(publisher)

    def _line(self, sample: Sample) -> _Line:
        return str(sample.key_expr), self._places.of(sample) if self._keep_last else 0

    def _route_on(self, sample: Sample, stamp: Timestamp | None, size: int, *, place: int = 0) -> None:
        if self._active is not None:
            self._active.sent = self._number
            self._send(sample, stamp, size, place=place)
        elif self._next is not None:
            self._held.append((sample, stamp))
            self._held_bytes += size
            if len(self._held) >= MAX_HELD or self._held_bytes >= MAX_BYTES // 2:
                self._end_hold()
        elif self._replays:
            self._owe([LeftOpen(sample, stamp)])
        elif not self._keep_last:
            self._counter.dropped("closed" if self._has_end else "no_route")
        else:
            self._counter.unsent += 1

    def _give_way(self, sample: Sample) -> None:
        """A sample that newer ones overtook before it was carried."""
        with self._lock:
            self._counter.seen(len(sample.payload))
            self._counter.dropped("overflow")

    def _send(self, sample: Sample, stamp: Timestamp | None, size: int | None = None, *, place: int = 0) -> None:
        if self._active is not None:
            if self._times is not None:
                self._times.sent(stamp or sample.timestamp)
            reason, dropped = self._active.outlet.send(sample, stamp, size, place)
            if dropped:
                self._counter.dropped(reason, dropped)
        if self._mirror is not None:
            self._counter.repeated += 1
            self._counter.dropped(*self._mirror.outlet.send(sample, stamp, size, place))

    def _stamp(self, sample: Sample) -> Timestamp | None:
        """With `OnCrash.REPLAY` every sample has a timestamp, by which its answers are known."""
        return sample.timestamp or self._clock.new_timestamp() if self._replays else None

    def _keep(self, line: _Line, sample: Sample, stamp: Timestamp | None) -> Timestamp:
        """Keep a value, with a timestamp of ours where it has none: outputs made of it inherit that, for the gate."""
        stamp = stamp or self._clock.new_timestamp()
        values = self._kept.get(line)
        if values is None:
            values = self._kept[line] = deque(maxlen=self._keep_last)
            if len(self._kept) > MAX_KEYS:
                self._kept.popitem(last=False)
        else:
            self._kept.move_to_end(line)  # who gives way is who has rested longest
        values.append((self._number, sample, stamp))
        return stamp

    def _catch_up(self, slot: _InputSlot) -> int:
        owed = [
            (kept, place)
            for (_, place), values in self._kept.items()
            for kept in values
            if kept[0] > slot.sent or (slot.lacks_newest and kept is values[-1])
        ]
        for (_, sample, stamp), place in sorted(owed, key=lambda one: one[0][0]):
            if self._times is not None:
                self._times.sent(stamp)
            self._counter.dropped(*slot.outlet.send(sample, stamp, place=place))
        slot.sent, slot.lacks_newest = self._number, False
        self._counter.replayed += len(owed)
        self._counter.repeated += len(owed)
        return len(owed)


def _is_own(sample: Sample, own_ids: frozenset[str]) -> bool:
    """True when another session of this process put the sample: a loop from one of our sides to the other.

    What the same session put is another task's output: a chain of tasks (rules whose relays feed each other in a circle
    are refused when the fleet file is loaded).
    """
    source: zenoh.SourceInfo | None = sample.source_info
    return source is not None and str(source.source_id.zid) in own_ids
