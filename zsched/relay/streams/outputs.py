"""Gates one output stream of this node: which owner's samples reach the applications, in which order.

Knows: the slots of the stream (one subscription per epoch), the end markers that came. Does not know: why a handover
happens, or when it is over for the task.

A slot is *prepared* (its samples wait), *next* (flipped to, the old one still carries) or the *carrier*. With
``handover: latest`` the next slot's first sample makes it the carrier at once; with ``all`` its samples wait, bounded,
until the old slot has ended. The publisher outlives every slot: applications see one source.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import Final

import zenoh
from zenoh import CongestionControl, Sample, Session, Timestamp

from zsched.core.hop.receiver import SourceName
from zsched.core.values.plan import HandoverRule, Route, StreamClass, StreamCount
from zsched.core.values.struct import replace
from zsched.host.clock import monotonic_s
from zsched.host.guard import tolerant
from zsched.link.acknowledger import Acknowledger
from zsched.link.keyspace import AGAIN_CHUNK, END_CHUNK
from zsched.link.pipe.frames import decode_end
from zsched.link.weight import weight
from zsched.relay.streams.acks import WorkerAcks
from zsched.relay.streams.answer_times import AnswerTimes
from zsched.relay.streams.answers import Answers
from zsched.relay.streams.counter import StreamCounter
from zsched.relay.streams.crowd import note_feeder
from zsched.relay.streams.fence import Fence
from zsched.relay.streams.outlet import Outlet
from zsched.relay.streams.pace import Pace
from zsched.relay.streams.places import Places, PublisherId
from zsched.relay.streams.receive import Receiver, undeclare
from zsched.relay.streams.slots import Feed, KeyState, OutputSlot
from zsched.relay.streams.tally import Tally

HOLD_SAMPLES: Final = 10_000
HOLD_BYTES: Final = 64 << 20
MAX_STAMPS: Final = 8192
UNNUMBERED: Final = -1
LATE_S: Final = 1.0
"""Samples that still come of a slot that was cut are counted for so long."""
HEARD_SLOTS: Final = 4
"""Closed slots of which is known how far they came: an owner may be left and come back in one epoch (isolation)."""
LEFT_SLOTS: Final = 4
"""Closed slots whose answers wait for their turn (`HandoverRule.ALL`), each within the bounds of an open slot."""


_Publisher = tuple[str, int]
"""(session id, entity id)."""
_BLOCK: Final = CongestionControl.BLOCK
_NOBODY: Final[_Publisher] = ("", 0)


class OutputStream:
    """One output rule on this node; slots are named by their epoch."""

    def __init__(
        self,
        session: Session,
        route: Route,
        own_ids: frozenset[str],
        wake: Callable[[], None],
        local: Session | None = None,
        times: AnswerTimes | None = None,
    ) -> None:
        """Declare the publisher, on ``local``, the host's own side, if there is one; ``session`` is the fleet's.

        ``wake`` is called (from any thread) when an end marker has come.

        Raises:
            ValueError, zenoh.ZError: the route makes no sense (see `Outlet`).
        """
        self.route = route
        self._times = times
        self._session = session
        self._own_ids = own_ids
        self._wake = wake
        self._lock = threading.Lock()
        self._counter = StreamCounter(route.stream)
        self._outlet = Outlet(local or session, route.from_expr, route.to_expr, route.settings, has_crowd=True)
        self._slots: dict[int, OutputSlot] = {}
        self._ends: dict[str, zenoh.Subscriber[None]] = {}
        self._carrier: OutputSlot | None = None
        self._left: list[OutputSlot] = []
        """Closed before their turn came: what their owners had answered still goes out in it."""
        self._acks: Acknowledger | None = None
        self._fence = Fence()
        self._heard: OrderedDict[tuple[int, str], dict[SourceName, int]] = OrderedDict()  # {(epoch, from): numbers}
        self._late: list[tuple[float, Feed]] = []
        """(until when, what feeds a slot that was cut)."""
        self._notes_stamps = False
        self._stamps: OrderedDict[Timestamp, None] = OrderedDict()
        self._is_latest = route.settings.stream_class is StreamClass.LATEST
        max_hz = route.settings.max_hz
        self._places = Places(self._is_there)
        self._owner = ""
        """Whose answers have passed last, by the expression that they come under."""
        self._pace: Pace[tuple[Sample, int]] | None = (
            None if max_hz is None else Pace(max_hz, remembers=self._is_latest)
        )

    def open(self, epoch: int, route: Route, acks: WorkerAcks | None = None, *, is_from_start: bool = False) -> None:
        """Subscribe to an owner's output; nothing passes yet.

        With ``acks`` its worker keeps its answers until we have acknowledged them; ``is_from_start``: the owner cannot
        have answered yet, so that its first answer is number 0.

        Raises:
            zenoh.ZError: ``from`` is no key expression.
            RuntimeError: no thread is to be had; the slot is not open.
        """
        self._end_late(route.from_expr)
        has_epoch = str(epoch) in route.from_expr.split("/")
        slot = OutputSlot(epoch=epoch, expr=route.from_expr)
        stream_class = route.settings.stream_class
        if acks is not None and stream_class is not StreamClass.BEST_EFFORT:
            self._acks = self._acks or acks.answers()
            slot.answers = Answers(
                self._acks,
                self._counter,
                is_from_start=is_from_start and has_epoch,
                in_turn=stream_class is StreamClass.RELIABLE,
                heard=self._heard.pop((epoch, route.from_expr), {}),
            )
        with self._lock:
            self._slots[epoch] = slot
            if any(other.expr == slot.expr for other in self._slots.values() if other is not slot):
                return  # the same owner once more, without {epoch}: what comes cannot belong to both
        feed = slot.feed = Feed(slot=slot)
        try:
            self._subscribe(feed, epoch, has_history=has_epoch)
        except RuntimeError:
            self.close_slot(epoch)
            raise

    def _subscribe(self, feed: Feed, epoch: int, *, has_history: bool) -> None:
        route_from, settings = feed.slot.expr, self.route.settings
        self._listen_for_ends(epoch, route_from)
        listen_to = _with_epoch(route_from, epoch, f"$*{epoch}")
        feed.receiver = Receiver(
            self._session,
            listen_to,
            settings,
            lambda sample: self._carry(feed, sample),
            with_history=has_history,
            give_way=self._give_way,
        )
        if feed.slot.answers is not None:
            feed.again = Receiver(
                self._session,
                f"{listen_to}/{AGAIN_CHUNK}/{self._session.zid()}",
                replace(settings, stream_class=StreamClass.RELIABLE),
                lambda sample: self._carry_again(feed, sample),
                with_history=False,
                give_way=self._give_way,
            )

    def leave(self) -> None:
        """Unsubscribe from every owner; slots, and how far they came, stay for `rejoin`."""
        self._end_late()
        for slot in tuple(self._slots.values()):
            if slot.feed is not None:
                slot.feed.close()
        for ends in self._ends.values():
            undeclare(ends)
        self._ends.clear()

    def rejoin(self, session: Session, own_ids: frozenset[str]) -> None:
        """Subscribe on another session; workers send what we have not had once they hear of us (`say_again`).

        Raises:
            zenoh.ZError: the session is closed.
        """
        with self._lock:
            self._session, self._own_ids = session, own_ids
            slots = tuple(self._slots.values())
        for slot in slots:
            if slot.feed is not None:
                self._subscribe(slot.feed, slot.epoch, has_history=False)

    def say_again(self) -> None:
        """Tell every worker how far we are: by that it knows a session that is new."""
        if self._acks is not None:
            self._acks.say_again()

    def _listen_for_ends(self, epoch: int, from_expr: str) -> None:
        """One subscription for all epochs of an owner: they are few, and told apart by what is in them."""
        expr = _with_epoch(from_expr, epoch, "*")
        if expr not in self._ends:
            self._ends[expr] = self._session.declare_subscriber(
                f"{expr}/{END_CHUNK}", tolerant(self._end, "marker"), allowed_origin=zenoh.Locality.REMOTE
            )

    def know(self, from_expr: str, *, notes_stamps: bool = False) -> None:
        """Hear of another owner's ``from`` before a slot opens on it: its captures fill the wildcards of ``to``.

        ``notes_stamps``: `has_passed` will be asked.

        Raises:
            ValueError: ``to`` cannot be filled from it.
        """
        with self._lock:
            self._outlet.also_from(from_expr)
            self._notes_stamps = notes_stamps

    def has_slot(self, epoch: int) -> bool:
        """Whether a slot is open."""
        return epoch in self._slots

    def has_passed(self, stamp: Timestamp) -> bool:
        """Whether an answer with this timestamp, its input's, has passed; of the newest `MAX_STAMPS`."""
        with self._lock:
            return stamp in self._stamps

    def flip(self, epoch: int, *, drops_held: bool) -> None:
        """Let the slot's samples through, by the stream's handover rule.

        ``drops_held``: what it made of warm-up values is older than what the carrier has let through meanwhile. A
        ``reliable`` output drops nothing: its answers may be to other robots' samples, and are acknowledged.
        """
        with self._lock:
            slot = self._slots.get(epoch)
            if slot is None or slot.is_flipped:
                return
            if drops_held and self.route.settings.stream_class is not StreamClass.RELIABLE:
                self._counter.dropped("superseded", len(slot.held))
                slot.held.clear()
                slot.held_bytes = 0
            slot.is_flipped = True
            if self._carrier is None or (slot.held and self.route.settings.handover is HandoverRule.LATEST):
                self._take_over(slot)

    def has_ended(self, epoch: int) -> bool:
        """True when everything of the slot has come (end markers), it was cut, or it is not there."""
        with self._lock:
            slot = self._slots.get(epoch)
            if slot is None or self._is_cut(slot):
                return True
            now = monotonic_s()
            heirs = [other for other in self._slots.values() if other.expr == slot.expr and other.feed is None]
            if any(heir.is_flipped for heir in heirs):
                return True  # the same owner goes on under the same key
            return bool(slot.keys) and all(key.is_ended(now, slot.answers) for key in slot.keys.values())

    def close_slot(self, epoch: int) -> None:
        """Unsubscribe from a slot; if it carried the stream, the flipped one takes over with what it held.

        What is on its way from one that was cut is counted before its subscription ends. What waits behind the carrier
        in one that was flipped (`HandoverRule.ALL`) has been acknowledged to its owner: it goes out in its turn.
        """
        with self._lock:
            slot = self._slots.pop(epoch, None)
            if slot is None:
                return
            slot.is_closed = True
            feed = self._hand_on(slot)
            is_cut = self._is_cut(slot)
            if slot is self._carrier:  # of any other nothing more was wanted
                self._counter.lost += slot.missing() + slot.take_lost() if feed is not None else 0
                self._carrier = None
                self._promote()
            elif slot.is_flipped and slot.held:
                self._keep_left(slot, is_cut=is_cut)
            if slot.answers is not None:
                self._heard[slot.epoch, slot.expr] = slot.answers.close()
                while len(self._heard) > HEARD_SLOTS:
                    self._heard.popitem(last=False)
        if feed is not None and is_cut:
            self._late.append((monotonic_s() + LATE_S, feed))
        elif feed is not None:
            feed.close()

    def _keep_left(self, slot: OutputSlot, *, is_cut: bool) -> None:
        is_wanted = self.route.settings.handover is HandoverRule.ALL and not is_cut
        if is_wanted and len(self._left) < LEFT_SLOTS:
            self._left.append(slot)
        else:
            self._counter.dropped("closed", len(slot.held))

    def _is_cut(self, slot: OutputSlot) -> bool:
        return self._carrier is not None and slot.epoch < self._carrier.epoch

    def _end_late(self, from_expr: str | None = None) -> None:
        """End what still listens to slots that were cut: to ``from_expr``, to all (``None``)."""
        ended = [one for one in self._late if from_expr is None or one[1].slot.expr == from_expr]
        self._late = [one for one in self._late if one not in ended]
        for _, feed in ended:
            feed.close()

    def _hand_on(self, slot: OutputSlot) -> Feed | None:
        """Give a closing slot's subscription to the one that waits for it; answers it when nobody does."""
        feed, slot.feed = slot.feed, None
        heirs = [other for other in self._slots.values() if other.expr == slot.expr and other.feed is None]
        if feed is None or not heirs:
            return feed
        feed.slot = heirs[0]
        heirs[0].feed = feed
        heirs[0].keys, heirs[0].publishers = slot.keys, slot.publishers
        heirs[0].lost += slot.take_lost()
        heirs[0].answers, slot.answers = slot.answers, heirs[0].answers
        for key in heirs[0].keys.values():
            key.reopen()
        return None

    def close(self) -> None:
        """Close every slot and give the publisher back; what has come and not gone out is counted."""
        with self._lock:
            held = sum(len(slot.held) for slot in (*self._left, *self._slots.values()) if slot.is_flipped)
            self._counter.dropped("closed", held)
            self._left.clear()
            for slot in self._slots.values():
                slot.held.clear()
            # Those that were cut first, or one of them would carry again while the carrier closes.
            order = sorted(self._slots.values(), key=lambda slot: (not self._is_cut(slot), -slot.epoch))
        for slot in order:
            self.close_slot(slot.epoch)
        self._end_late()
        for ends in self._ends.values():
            undeclare(ends)
        self._ends.clear()
        said = self._outlet.undeclare()
        if isinstance(said, Tally):
            with self._lock:
                self._counter.dropped("closed", said.waiting)
        if self._acks is not None:
            self._acks.close()

    @property
    def is_still(self) -> bool:
        """Whether no sample has come for a while (`StreamCounter.is_still`)."""
        return self._counter.is_still

    def look_after(self) -> None:
        """Let through what waits for answers that never come, or for a highest rate; call it now and then."""
        self._outlet.look_after()
        while self._late and self._late[0][0] <= monotonic_s():
            self._late.pop(0)[1].close()
        with self._lock:
            for slot in tuple(self._slots.values()):
                self._counter.lost += slot.take_lost() if slot is self._carrier else 0
                for (name, zid, eid), sample in slot.answers.overdue() if slot.answers is not None else ():
                    self._pass(slot, slot.keys.setdefault(name, KeyState(name=name)), (zid, eid), sample)
            if self._pace is None or not self._is_latest:
                return
            for sample, place in self._pace.overdue(monotonic_s()):
                self._note_passed(monotonic_s())
                self._counter.dropped(*self._outlet.send(sample, place=place))

    def count(self) -> StreamCount:
        """The counters now."""
        with self._lock:
            self._counter.dropped("slow_reader", self._outlet.take_missed())
            return self._counter.value()

    # --- one sample --------------------------------------------------------------------------------------------------

    def _carry(self, feed: Feed, sample: Sample) -> None:
        with self._lock:
            slot = feed.slot  # which an heir may just have become
            publisher, number = _publisher_of(sample)
            if publisher[0] in self._own_ids:
                self._counter.seen(len(sample.payload))
                self._counter.dropped("loop")
                return
            if slot.is_closed:  # a count of it would begin again, from 0
                self._counter.seen(len(sample.payload))
                self._counter.dropped("cut" if self._is_cut(slot) else "stale_epoch")
                return
            name = str(sample.key_expr)
            key = slot.keys.get(name) or slot.key(name)
            if key is None:
                return
            answers = slot.answers
            if number == UNNUMBERED or answers is None or sample.congestion_control != _BLOCK:
                self._pass(slot, key, publisher, sample, number)
                return
            ready = answers.take((name, *publisher), number, sample)
            if len(ready) == 1 and ready[0] is sample:  # the usual case: nothing was missing
                self._pass(slot, key, publisher, sample, number)
                return
            for one in ready:
                self._pass(slot, key, publisher, one)

    def _carry_again(self, feed: Feed, sample: Sample) -> None:
        with self._lock:
            slot = feed.slot
            if slot.answers is None or slot.is_closed:
                return
            name = str(sample.key_expr).rsplit(f"/{AGAIN_CHUNK}/", 1)[0]
            key = slot.key(name)
            if key is None:
                return
            for (_, zid, eid), ready in slot.answers.take_again(name, sample):
                self._pass(slot, key, (zid, eid), ready)

    def _give_way(self, sample: Sample) -> None:
        """An answer that newer ones overtook; one with a number is missed by that, and counted as lost."""
        if _publisher_of(sample)[1] == UNNUMBERED:
            with self._lock:
                self._counter.seen(len(sample.payload))
                self._counter.dropped("overflow")

    def _pass(
        self, slot: OutputSlot, key: KeyState, publisher: _Publisher, sample: Sample, number: int | None = None
    ) -> None:
        """``number``: the sample's on the hop where that is known, `UNNUMBERED` for a foreign worker's."""
        number = _publisher_of(sample)[1] if number is None else number
        size = weight(sample)
        self._counter.seen(len(sample.payload))
        key.received += 1
        key.heard_at = monotonic_s()
        if number != UNNUMBERED and publisher not in key.sources:
            note_feeder(publisher[0])
            slot.note_publisher()
        if number == UNNUMBERED or key.take(publisher, number, slot.answers, self._counter):
            if key.end is not None and key.is_past_end(publisher):
                self._reopen(slot, key)
            self._gate(slot, sample, size)

    def _reopen(self, slot: OutputSlot, key: KeyState) -> None:
        if slot.answers is not None and key.ender is not None:
            slot.answers.reopen(key.ender)
        key.reopen()

    def _gate(self, slot: OutputSlot, sample: Sample, size: int) -> None:
        if slot is self._carrier:
            self._forward(sample, size)
        elif self._is_cut(slot):
            self._counter.dropped("cut")
        elif slot.is_flipped and self.route.settings.handover is HandoverRule.LATEST:
            self._take_over(slot)
            self._forward(sample)
        else:
            self._hold(slot, sample)

    def _hold(self, slot: OutputSlot, sample: Sample) -> None:
        slot.held.append(sample)
        slot.held_bytes += weight(sample)
        while len(slot.held) > HOLD_SAMPLES or (slot.held_bytes > HOLD_BYTES and len(slot.held) > 1):
            slot.held_bytes -= weight(slot.held.popleft())
            self._counter.dropped("overflow")

    def _promote(self) -> None:
        choose = min if self.route.settings.handover is HandoverRule.ALL else max  # with `ALL` each has its turn
        while flipped := [slot for slot in (*self._left, *self._slots.values()) if slot.is_flipped]:
            slot = choose(flipped, key=lambda slot: slot.epoch)
            self._take_over(slot)
            if slot not in self._left:
                return
            self._left.remove(slot)
            self._carrier = None

    def _take_over(self, slot: OutputSlot) -> None:
        self._fence.begin(is_first=self._carrier is None)
        self._carrier = slot
        self._release(slot)

    def _release(self, slot: OutputSlot) -> None:
        while slot.held:
            sample = slot.held.popleft()
            slot.held_bytes -= weight(sample)
            self._forward(sample)

    def _forward(self, sample: Sample, size: int | None = None) -> None:
        answer = None if self._times is None else self._times.answered(sample.timestamp, self._counter.stream)
        if answer is not None:
            self._counter.answered(answer[0], is_paired=answer[1])
        place = 0
        if self._is_latest:
            stamp = sample.timestamp
            if stamp is not None and not self._fence.passes(self._outlet.key_of(sample), stamp):
                self._counter.dropped("superseded")
                return
            place = self._place(sample)
        # by the applications' key: under that a new owner's value takes the place of an old one's
        if self._pace is not None:
            line = (self._outlet.key_of(sample), place)
            if not self._pace.passes(line, (sample, place), monotonic_s()):
                self._counter.dropped("thinned")
                return
        if self._notes_stamps and sample.timestamp is not None:
            self._stamps[sample.timestamp] = None
            if len(self._stamps) > MAX_STAMPS:
                self._stamps.popitem(last=False)
        self._note_passed(monotonic_s() if size is None else self._counter.last_seen)
        reason, dropped = self._outlet.send(sample, None, size, place)
        if dropped:
            self._counter.dropped(reason, dropped)

    def _place(self, sample: Sample) -> int:
        """The place of its publisher among the owner's: an owner's first values take the place of another owner's."""
        if self._carrier is not None and self._carrier.expr != self._owner:
            self._owner = self._carrier.expr
            self._places.clear()
            self._outlet.keep_first()
        return self._places.of(sample)

    def _is_there(self, publisher: PublisherId) -> bool | None:
        receivers = [slot.feed.receiver for slot in self._slots.values() if slot.feed is not None]
        told = [one.is_there(publisher) for one in receivers if one is not None]
        return None if all(one is None for one in told) else any(told)

    def _note_passed(self, now: float) -> None:
        if self._carrier is not None:
            self._counter.passed(self._carrier.epoch, now)

    def _end(self, sample: Sample) -> None:
        """An end marker came (zenoh's callback thread: note it, wake the task, nothing else)."""
        marker = decode_end(sample.payload.to_bytes())
        if marker is None:
            return
        name = str(sample.key_expr).removesuffix(f"/{END_CHUNK}")
        with self._lock:
            slot = self._slots.get(marker.epoch)
            key = None if slot is None else slot.key(name)
            if slot is None or key is None:
                return
            source = sample.source_info
            publisher = _NOBODY if source is None else (str(source.source_id.zid), source.source_id.eid)
            if source is None or not key.take_end(marker, publisher, monotonic_s()):
                return
            if slot.answers is not None:
                key.ender = (name, *publisher)
                slot.answers.ended(key.ender)
        self._wake()


def _publisher_of(sample: Sample) -> tuple[_Publisher, int]:
    """Who put a sample, and the number it has; asked once for every sample."""
    source: zenoh.SourceInfo | None = sample.source_info
    if source is None:
        return _NOBODY, UNNUMBERED
    identity = source.source_id
    return (str(identity.zid), identity.eid), source.source_sn


def _with_epoch(expr: str, epoch: int, chunk: str) -> str:
    """``expr`` with ``chunk`` where its epoch was.

    For every key that is new, zenoh 1.10 keeps 1.6 KB until the link closes, of the part before the first wildcard (its
    issue 1518). ``$*7`` for ``7`` lets that part be the same in every epoch; what else matches is dropped here.
    """
    return "/".join(chunk if one == str(epoch) else one for one in expr.split("/"))
