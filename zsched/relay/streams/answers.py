"""Puts the answers of one output slot in order: numbers that came early wait for those that are sent again.

Knows: `zsched.worker`'s numbers and what it keeps of its answers, the acknowledger. Does not know: gates, outlets.

A link that breaks loses what was on it; the worker keeps its answers until this relay has acknowledged them, and puts
what is missing once more, for this relay alone. Meanwhile newer answers wait here, bounded. What the worker has no more
is skipped at its word, what never comes after `GIVE_UP_S`. Both count as lost, once: where the next one passes
(`zsched.relay.streams.slots`), or when the slot closes. Where only the newest is wanted (class ``latest``) nothing
waits. The stream's lock guards it.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Mapping
from typing import Final

import zenoh
from zenoh import Sample

from zsched.core.hop.receiver import GIVE_UP_S, MAX_SOURCES, SourceName
from zsched.core.hop.serial import serial_of
from zsched.core.values.relay_protocol import SKIP_ENCODING, EndMarker
from zsched.core.values.struct import Struct, field
from zsched.link.acknowledger import Acknowledger
from zsched.link.pipe.frames import decode_end
from zsched.link.weight import weight
from zsched.relay.streams.counter import StreamCounter
from zsched.relay.streams.given import under

MAX_WAITING: Final = 4096
MAX_WAITING_BYTES: Final = 32 << 20
"""Early answers of one publisher that wait; further ones are dropped here, and come again."""
MAX_EARLY: Final = 4096
"""Publishers of which answers wait..."""
MAX_EARLY_BYTES: Final = 2 * MAX_WAITING_BYTES
"""...and what they may weigh together: anybody can put under a name of his own what is early for ever."""


class _Total(Struct, eq=False):
    """What waits of all publishers, in bytes."""

    size: int = 0


class _Early(Struct):
    total: _Total
    samples: dict[int, Sample] = field(default_factory=dict)
    size: int = 0

    def put(self, number: int, sample: Sample) -> bool:
        """Let a sample wait; ``False`` when there is no room."""
        if number not in self.samples:
            self.samples[number] = sample
            self._weigh(weight(sample))
        has_room = len(self.samples) <= MAX_WAITING and self.size <= MAX_WAITING_BYTES
        return has_room and self.total.size <= MAX_EARLY_BYTES

    def pop(self, number: int) -> Sample | None:
        """Take one out, if it is there."""
        sample = self.samples.pop(number, None)
        self._weigh(-weight(sample) if sample is not None else 0)
        return sample

    def _weigh(self, size: int) -> None:
        self.size += size
        self.total.size += size

    def forget(self, number: int) -> None:
        """Let go of everything below a number."""
        for old in [one for one in self.samples if one < number]:
            self.pop(old)


class Answers:
    """The numbered answers of one slot's workers: usually one, two when it restarts in place."""

    def __init__(
        self,
        acks: Acknowledger,
        counter: StreamCounter,
        *,
        is_from_start: bool,
        in_turn: bool,
        heard: Mapping[SourceName, int],
    ) -> None:
        """``is_from_start``: this slot was open before its owner could answer, number 0 is wanted too.

        ``heard``: what `close` answered when a slot of the same owner and epoch closed; it goes on from there.
        """
        self._acks = acks
        self._counter = counter
        self._is_from_start = is_from_start
        self._in_turn = in_turn
        self._early: dict[SourceName, _Early] = {}
        """Of whom something waits: never empty."""
        self._total = _Total()
        self._names: dict[str, set[SourceName]] = {}
        """{key: whose samples of it are known}..."""
        self._known: dict[SourceName, None] = {}
        """...and all of them, the oldest first."""
        self._starts = dict(heard)
        self._forgotten: OrderedDict[SourceName, int] = OrderedDict()
        """{source: the number it comes to next}, the oldest first."""
        for name, number in heard.items():
            self._know(name)
            acks.expect(name, number)
            acks.skip(name, number)  # it says that we are back

    def take(self, name: SourceName, serial: int, sample: Sample, *, is_again: bool = False) -> tuple[Sample, ...]:
        """A sample came; answers those that go on now, in order."""
        self._know(name)
        if name not in self._early and self._acks.take(name, serial, len(sample.payload)):
            return (sample,)
        number = self._acks.number(name, serial)
        start = self._start_of(name) if self._in_turn else None
        expected = self._acks.expect(name, number if start is None else start)
        if number < expected:
            if self._acks.admit(name, serial_of(number), in_turn=True) is not None:  # a jump is taken back
                self._acks.processed(name, number, len(sample.payload))
                self._drop_early(name)
                return (sample,)
            # else it is dropped, and acknowledged once more
            if not is_again and self._in_turn:
                self._counter.doubled += 1
            return ()
        if number > expected:
            return self._wait_for(name, number, sample)
        self._acks.take(name, number, len(sample.payload))
        return (sample, *self._next_ones(name))

    def take_again(self, key: str, sample: Sample) -> tuple[tuple[SourceName, Sample], ...]:
        """Something of ``key`` came once more, for us alone: ``(publisher, sample)`` of what goes on now."""
        info: zenoh.SourceInfo | None = sample.source_info
        if info is None:
            return ()
        name = (key, str(info.source_id.zid), info.source_id.eid)
        if str(sample.encoding) == SKIP_ENCODING:
            marker = decode_end(sample.payload.to_bytes())
            ready = () if marker is None else self._begin_later(name, marker)
        else:
            ready = self.take(name, info.source_sn, under(key, sample), is_again=True)
        return tuple((name, one) for one in ready)

    def ended(self, name: SourceName) -> None:
        """The source's end marker came."""
        self._know(name)
        self._acks.end(name)

    def reopen(self, name: SourceName) -> None:
        """What came as the source's end was none: the real one is wanted."""
        self._acks.reopen(name)

    def ask_for(self, name: SourceName, until: int) -> bool:
        """Ask for everything below a number; ``False`` when that has been in vain for too long."""
        self._acks.expect(name, 0 if self._is_from_start else until)
        return self._acks.ask_for(name, until) <= GIVE_UP_S

    def missing(self, key: str, passed: Mapping[SourceName, int], ends: Mapping[SourceName, int]) -> int:
        """How many numbers have not gone on, of the sources of a key that we should have had whole.

        ``passed``: behind the last one of each that went on; ``ends``: behind the last one of all, where that is known.
        """
        return sum(self._missing_of(one, passed.get(one, 0), ends.get(one, 0)) for one in self._names.get(key, ()))

    def _missing_of(self, name: SourceName, passed: int, end: int) -> int:
        start, early = self._start_of(name), self._early.get(name)
        told = 0 if early is None else max(early.samples) + 1
        return 0 if start is None else max(0, max(end, told, self._acks.arrived(name)) - max(start, passed))

    def first_of(self, name: SourceName) -> int | None:
        """The first number that counts as lost when it does not come; ``None``: the first one that comes."""
        return self._start_of(name) if self._in_turn else None

    def _start_of(self, name: SourceName) -> int | None:
        """The first number that we had to get; ``None``: we came when the stream had begun."""
        return self._starts.get(name, 0 if self._is_from_start else None)

    def has_come(self, name: SourceName, until: int) -> bool:
        """Whether everything of a source below a number has come, or is given up."""
        return self._acks.arrived(name) >= until

    def is_waiting(self, key: str) -> bool:
        """Whether something of a key came early and waits."""
        return any(name in self._early for name in self._names.get(key, ()))

    def has_early(self, name: SourceName) -> bool:
        """Whether something of a source came early and waits."""
        return name in self._early

    def forget(self, key: str) -> None:
        """Keep of a key only how far its sources are: should it come again, what was before is not lost."""
        for name in tuple(self._names.get(key, ())):
            self._forget(name)

    def leave(self, name: SourceName, passed: int) -> int:
        """Forget one source likewise; answers how many numbers of it have not gone on (``passed``: as `missing`)."""
        missing = self._missing_of(name, passed, 0) if name in self._known else 0
        self._forget(name)
        return missing

    def _forget(self, name: SourceName) -> None:
        if name not in self._known:
            return
        del self._known[name]
        names = self._names[name[0]]
        names.discard(name)
        if not names:
            del self._names[name[0]]
        self._forgotten[name] = self._acks.arrived(name)
        self._starts.pop(name, None)
        if len(self._forgotten) > MAX_SOURCES:
            self._forgotten.popitem(last=False)

    def _know(self, name: SourceName) -> None:
        """Something came of a source."""
        if name in self._known:
            return
        self._known[name] = None
        self._names.setdefault(name[0], set()).add(name)
        if (number := self._forgotten.pop(name, None)) is not None:
            self._starts[name] = number
        if len(self._known) > MAX_SOURCES:
            self._forget(next(iter(self._known)))

    def overdue(self) -> Iterator[tuple[SourceName, Sample]]:
        """What goes on now because the missing ones before it never came."""
        for name, early in tuple(self._early.items()):
            first = min(early.samples, default=None)
            if first is not None and self._acks.ask_for(name, first) > GIVE_UP_S:
                yield from ((name, sample) for sample in self._skip(name, first))

    def close(self) -> dict[SourceName, int]:
        """The slot is closed: its workers hear once more how far it came; answers the number each comes to next."""
        heard = {**self._forgotten, **{name: self._acks.arrived(name) for name in self._known}}
        self._acks.leave(heard)
        self._names.clear()
        self._known.clear()
        self._forgotten.clear()
        self._early.clear()
        return heard

    # --- out of turn -------------------------------------------------------------------------------------------------

    def _wait_for(self, name: SourceName, number: int, sample: Sample) -> tuple[Sample, ...]:
        if not self._in_turn:
            self._acks.skip(name, number)
            self._acks.take(name, number, len(sample.payload))
            return (sample,)
        early = self._early.get(name)
        is_far = number - self._acks.arrived(name) > MAX_WAITING  # more than is ever sent again: it need not wait
        if early is None and not is_far and len(self._early) < MAX_EARLY:
            early = self._early[name] = _Early(self._total)
        if early is not None and (is_far or not early.put(number, sample)):
            early.pop(number)
            self._end_wait(name, early)
        first = number if early is None else min(early.samples, default=number)
        if self._acks.ask_for(name, first) > GIVE_UP_S:
            return self._skip(name, first)
        return ()

    def _begin_later(self, name: SourceName, marker: EndMarker) -> tuple[Sample, ...]:
        """The worker's word: nothing below the marker comes.

        What an earlier life of this relay had is not lost, nor is, where it had none, a beginning before its time.
        """
        self._know(name)
        number = self._acks.number(name, serial_of(marker.count))
        if self._start_of(name) == 0 == self._acks.arrived(name):
            is_late = marker.age_s is not None and self._acks.clock() - marker.age_s < self._acks.born_at
            before = number if is_late else 0
            self._starts[name] = min(before if marker.had is None else marker.had, number)
        return self._skip(name, number)

    def _skip(self, name: SourceName, number: int) -> tuple[Sample, ...]:
        self._acks.skip(name, number)
        early = self._early.get(name)
        if early is not None:
            early.forget(self._acks.arrived(name))
        return self._next_ones(name)

    def _end_wait(self, name: SourceName, early: _Early) -> None:
        if not early.samples:
            self._early.pop(name, None)

    def _drop_early(self, name: SourceName) -> None:
        early = self._early.pop(name, None)
        self._total.size -= 0 if early is None else early.size

    def _next_ones(self, name: SourceName) -> tuple[Sample, ...]:
        """What has waited for the number that has just come."""
        early = self._early.get(name)
        if early is None:
            return ()
        ready = []
        number = self._acks.arrived(name)
        while (sample := early.pop(number)) is not None:
            self._acks.take(name, number, len(sample.payload))
            ready.append(sample)
            number += 1
        if early.samples:
            self._acks.ask_for(name, min(early.samples))
        self._end_wait(name, early)
        return tuple(ready)
