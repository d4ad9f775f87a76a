"""What an output stream knows of each of its slots: the subscription, the keys, the samples that wait, the ends.

Knows: end markers, how long what is missing before one may take. Does not know: gates, who feeds a slot.

Anybody can put an end marker. One that says less than its publisher has put is none, nor is one of a publisher that is
not heard while another one is; and one ends nothing any more when something comes from behind it. And anybody can put
samples, under any key and as any publisher: of both so many are known, and what has rested longest gives way.
"""

from __future__ import annotations

from collections import deque
from typing import Final

from zenoh import Sample

from zsched.core.hop.receiver import GIVE_UP_S, MAX_SOURCES, Source, SourceName
from zsched.core.hop.serial import number_near, serial_of
from zsched.core.route import keyexpr
from zsched.core.values.relay_protocol import EndMarker
from zsched.core.values.struct import Struct, field, replace
from zsched.host.clock import monotonic_s
from zsched.relay.streams.answers import Answers
from zsched.relay.streams.counter import StreamCounter
from zsched.relay.streams.receive import Receiver

END_GRACE_S: Final = 0.1
"""A marker travels behind its data on one link; what is still missing this long after it was dropped on the way."""
MAX_KEYS: Final = 4096
"""Concrete keys of a slot that are known: they may change over the weeks."""
MAX_ENDED: Final = 4096
"""...and so many more that have an end, or wait for something."""
MAX_PUBLISHERS: Final = MAX_SOURCES
"""Publishers of a slot that are known, over all its keys: a worker that is restarted in place is another one."""
FORGET_SHARE: Final = 16
"""This share of them is forgotten at a time: all are looked at for it."""
QUIET_S: Final = 1.0
"""A worker that has put nothing here (it was restarted) may end others' slots when nothing has come for this long."""


class Numbers(Source):
    """One publisher of a key."""

    heard_at: float = 0.0


class KeyState(Struct):
    """What came on one concrete key of a slot, and what its end marker said."""

    name: str = ""
    received: int = 0
    heard_at: float = 0.0
    end: EndMarker | None = None
    end_at: float = 0.0
    end_of: tuple[str, int] | None = None
    """The publisher whose end it is."""
    ender: SourceName | None = None
    """The publisher whose end it is, where it keeps what we have not acknowledged."""
    last_number: int = -1
    sources: dict[tuple[str, int], Numbers] = field(default_factory=dict)
    """{publisher: its numbers, as they passed here}; a worker that restarted in place is another publisher."""

    def take(self, publisher: tuple[str, int], serial: int, answers: Answers | None, counter: StreamCounter) -> bool:
        """Whether a sample passes; counts once what is lost, double or late by the numbers of its publisher.

        An old one does not pass, unless a jump is taken back by it; ``answers`` have seen to that already.
        """
        source = self.sources.get(publisher)
        if source is not None and source.take(serial):  # the usual case
            source.heard_at = self.heard_at
            self.last_number = source.arrived - 1
            return True
        if source is None:
            first = None if answers is None else answers.first_of((self.name, *publisher))
            at = serial if first is None else first
            source = self.sources[publisher] = Numbers(first=at, arrived=at, processed=at)
        source.heard_at = self.heard_at
        return self._admit(source, source.number(serial), counter, in_order=answers is not None)

    def _admit(self, source: Source, number: int, counter: StreamCounter, *, in_order: bool) -> bool:
        before = source.lost, source.doubled, source.reordered
        is_next = (in_order and number < source.arrived and source.go_back(number)) or source.admit(
            number, 0.0, in_turn=False
        )
        if is_next:
            source.done(number)
        counter.lost += source.lost - before[0]
        counter.doubled += source.doubled - before[1]
        is_far = not is_next and number > source.arrived
        counter.reordered += source.reordered - before[2] + is_far
        self.last_number = source.arrived - 1
        return is_next

    def take_end(self, marker: EndMarker, publisher: tuple[str, int], now: float) -> bool:
        """An end marker of a publisher came; ``False``: it is none."""
        source = self.sources.get(publisher)
        if self.sources and source is None and now - self.heard_at < QUIET_S:
            return False
        serial = serial_of(marker.count)
        count = number_near(serial, self.last_number + 1) if source is None else source.number(serial)
        if source is not None and count < source.proven:
            return False
        if self.end is None or (self.end.count, self.end_of) != (count, publisher):
            self.end, self.end_at, self.end_of = replace(marker, count=count), now, publisher
        return True

    def is_past_end(self, publisher: tuple[str, int]) -> bool:
        """Whether the newest sample, ``publisher``'s, came from behind its end."""
        return self.end is not None and self.end_of == publisher and self.last_number >= self.end.count

    def reopen(self) -> None:
        """What came as its end was none."""
        self.end = self.end_of = self.ender = None

    def is_ended(self, now: float, answers: Answers | None) -> bool:
        """True when everything up to the end marker has come, or will not come any more."""
        if self.end is None:
            return False
        is_complete = self._is_complete(self.end, answers)
        if is_complete or now - self.end_at <= END_GRACE_S:
            return is_complete
        return answers is None or self.ender is None or not answers.ask_for(self.ender, self.end.count)

    def _is_complete(self, end: EndMarker, answers: Answers | None) -> bool:
        """Whether everything before the end has come, of the publisher whose end it is: others say nothing of that."""
        if (source := self._ending) is not None:
            return source.arrived >= end.count
        if self.sources:
            return not end.count
        is_forgotten = answers is not None and self.ender is not None and answers.has_come(self.ender, end.count)
        return is_forgotten or self.received >= end.count or self.last_number + 1 >= end.count

    def is_over(self, now: float) -> bool:
        """Whether an end marker came, and what was before it has come or was waited for."""
        return self.end is not None and (
            self._is_complete(self.end, None) or now - self.end_at > END_GRACE_S + GIVE_UP_S
        )

    def forget(self, publisher: tuple[str, int], answers: Answers | None) -> int:
        """Forget a publisher; answers how many of its samples have not come, for nobody else counts them."""
        source = self.sources.pop(publisher)
        return 0 if answers is None else answers.leave((self.name, *publisher), source.arrived)

    @property
    def _ending(self) -> Source | None:
        """The numbers of the publisher whose end it is."""
        return None if self.end_of is None else self.sources.get(self.end_of)

    def missing(self, answers: Answers | None) -> int:
        """How many samples behind the last one that passed have not come, as far as anybody has said that they are."""
        ends = {} if self.end is None or self.ender is None else {self.ender: self.end.count}
        if answers is not None and (ends or self.end is None):
            passed = {(self.name, *publisher): source.arrived for publisher, source in self.sources.items()}
            return answers.missing(self.name, passed, ends)
        source = self._ending
        newest = self.last_number if source is None else source.arrived - 1
        if self.end is None or newest < 0:
            return 0
        return max(0, self.end.count - newest - 1)


class Feed(Struct, eq=False):
    """A subscription to an owner's output and the slot it feeds."""

    slot: OutputSlot
    receiver: Receiver | None = None
    again: Receiver | None = None
    """What our relay alone is sent once more."""

    def close(self) -> None:
        """Unsubscribe."""
        for receiver in (self.receiver, self.again):
            if receiver is not None:
                receiver.close()


class OutputSlot(Struct, eq=False):
    """One owner's epoch: what feeds it, what waits in it, how far its handover is."""

    epoch: int
    expr: str
    answers: Answers | None = None
    """``None``: its worker keeps nothing for us (a foreign one)."""
    feed: Feed | None = None
    """``None`` while an older slot of the same owner and key has the subscription."""
    keys: dict[str, KeyState] = field(default_factory=dict)
    held: deque[Sample] = field(default_factory=deque)
    held_bytes: int = 0
    is_flipped: bool = False
    is_closed: bool = False
    lost: int = 0
    """Missing of keys and publishers that are forgotten, and not counted yet."""
    publishers: int = 0
    """Publishers that are known, of all keys."""
    crowded_at: int = 0
    """With so many keys some are forgotten again, if they can be."""

    def missing(self) -> int:
        """How many samples its owner has put out that did not come (as far as it has said how many there are)."""
        return sum(key.missing(self.answers) for key in self.keys.values())

    def key(self, name: str) -> KeyState | None:
        """What has come on a concrete key; ``None`` when it is none of this slot's."""
        state = self.keys.get(name)
        if state is None and keyexpr.intersects(self.expr, name):
            if len(self.keys) >= max(MAX_KEYS, self.crowded_at):
                self._make_room()
            state = self.keys[name] = KeyState(name=name)
        return state

    def note_publisher(self) -> None:
        """One more comes to be known."""
        if self.publishers >= MAX_PUBLISHERS:
            self._forget_publishers()
        self.publishers += 1

    def _make_room(self) -> None:
        """Forget the keys that have rested longest; what is missing of them is said to be, for nobody else counts it.

        Not those of which something waits, or has yet to come before an end marker, unless there are very many.
        """
        answers, share = self.answers, max(1, MAX_KEYS // FORGET_SHARE)
        at_rest = [
            key
            for key in self.keys.values()
            if key.end is None and (answers is None or not answers.is_waiting(key.name))
        ]
        at_rest.sort(key=lambda key: key.heard_at)
        for key in at_rest[:share]:
            self._forget(key)
        if len(self.keys) >= MAX_KEYS + MAX_ENDED:
            now = monotonic_s()
            for key in sorted(self.keys.values(), key=lambda key: (not key.is_over(now), key.heard_at))[:share]:
                self._forget(key)
        self.crowded_at = len(self.keys) + share

    def _forget(self, key: KeyState) -> None:
        self.lost += key.missing(self.answers)
        if self.answers is not None:
            self.answers.forget(key.name)
        self.publishers -= len(key.sources)
        del self.keys[key.name]

    def _forget_publishers(self) -> None:
        """Forget those that have rested longest, as keys are forgotten; not the one whose end a key has."""
        answers = self.answers
        known = [
            (source.heard_at, key.name, publisher)
            for key in self.keys.values()
            for publisher, source in key.sources.items()
            if publisher != key.end_of and (answers is None or not answers.has_early((key.name, *publisher)))
        ]
        known.sort()
        leaving = known[: max(1, MAX_PUBLISHERS // FORGET_SHARE)]
        for _, name, publisher in leaving:
            self.lost += self.keys[name].forget(publisher, answers)
        self.publishers -= len(leaving)

    def take_lost(self) -> int:
        """What was missing of keys and publishers that were forgotten since the last time."""
        lost, self.lost = self.lost, 0
        return lost
