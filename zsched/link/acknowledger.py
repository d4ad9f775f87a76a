"""Acknowledges what a process hears on a numbered hop: tells each sender how far it is.

Knows: when an acknowledgement is due, which publishers there are. Does not know: what the numbers of one mean
(`zsched.core.hop.receiver`), what a sample is, roles, zenoh sessions.

Workers use it for their inputs, relays for the workers' answers. A publisher that waits for its receivers (congestion
control BLOCK: classes ``latest`` and ``reliable``) keeps what is not acknowledged.
"""

from __future__ import annotations

import logging
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable
from typing import Final

from zsched.core.hop.receiver import MAX_SOURCES, RunningTime, Source, SourceName
from zsched.core.values.relay_protocol import StreamAck, StreamAcks
from zsched.host.clock import monotonic_s
from zsched.host.guard import guarded

ACK_S: Final = 0.05
"""Acknowledgements leave this often while anything changes (20 Hz)..."""
ACK_SAMPLES: Final = 256
ACK_BYTES: Final = 1 << 20
"""...or when this much was processed."""
MAX_PER_FRAME: Final = 500

_log = logging.getLogger("zsched.streams")


class Acknowledger:
    """The numbers of every publisher heard, and a thread that sends what changed: ``send(session id, frame)``."""

    def __init__(
        self,
        send: Callable[[str, StreamAcks], None],
        *,
        born_at: float | None = None,
        clock: Callable[[], float] | None = None,
    ) -> None:
        """``send`` puts a frame for the session with that zenoh id; it must not block long.

        With a ``clock`` of the caller's there is no thread: the caller looks at the gaps and flushes every `ACK_S`.
        """
        self._send = send
        self.clock = clock or monotonic_s
        """Monotonic seconds."""
        self.born_at = self.clock() if born_at is None else born_at
        """When this process began to listen."""
        self._sources: OrderedDict[SourceName, Source] = OrderedDict()
        self._used: set[SourceName] = set()
        """Those that have a second chance when room is wanted: something has come of them since they had their last."""
        self._dirty: set[SourceName] = set()
        self._time = RunningTime()
        self._gaps: dict[SourceName, Source] = {}
        """Where something is missing and waited for: the time is looked at meanwhile."""
        self._wake = threading.Condition()
        self._sending = threading.Lock()
        """Frames leave in the order in which they were made: one that says less than the one before is a stranger's."""
        self._samples = 0
        self._bytes = 0
        self._is_closed = False
        if clock is None:
            guarded(self._run, name="zsched acks").start()

    def close(self) -> None:
        """Send what changed, then end."""
        with self._wake:
            self._is_closed = True
            self._wake.notify()

    def admit(self, name: SourceName, serial: int, *, in_turn: bool) -> int | None:
        """A sample came; answers its number, ``None``: drop it. ``in_turn``: nothing may be missing before it."""
        with self._wake:
            source = self._sources.get(name) or self._add(name, 0 if in_turn else serial)
            number = source.number(serial)
            if source.admit(number, self._time.at(self.clock()), in_turn=in_turn):
                return number
            self._note_gap(name, source)
            self._mark(name)
            return None

    def number(self, name: SourceName, serial: int) -> int:
        """The number that a serial of a source stands for."""
        with self._wake:
            source = self._sources.get(name)
            return serial if source is None else source.number(serial)

    def shed(self, name: SourceName) -> None:
        """A sample that was wanted gives way for want of room: lost, although newer ones are processed."""
        with self._wake:
            source = self._sources.get(name)
            if source is not None:
                source.lost += 1
                self._mark(name)

    def expect(self, name: SourceName, number: int) -> int:
        """The number that the source comes to next; ``number`` when nothing of it is known yet."""
        with self._wake:
            return (self._sources.get(name) or self._add(name, number)).arrived

    def take(self, name: SourceName, serial: int, size: int) -> bool:
        """The sample that is next came and is processed already; ``False``: it is not that one, nothing happens.

        ``serial`` may be its whole number, too.
        """
        with self._wake:
            source = self._sources.get(name)
            if source is None or not source.take(serial):
                return False
            self._note_done(name, size)
            return True

    def ask_for(self, name: SourceName, until: int) -> float:
        """Everything below ``until`` is missing; answers for how long nothing has come of it, in seconds."""
        with self._wake:
            source = self._sources.get(name) or self._add(name, until)
            source.until = until
            self._mark(name)
            waits_s = source.waits_s(self._time.at(self.clock()))
            self._note_gap(name, source)
            return waits_s

    def skip(self, name: SourceName, number: int) -> int:
        """Nothing below ``number`` will come any more; answers how many are lost by that. It is always answered."""
        with self._wake:
            source = self._sources.get(name) or self._add(name, number)
            self._mark(name)
            return source.skip(number)

    def note_start(self, name: SourceName, number: int, *, is_whole: bool, replayed: int) -> None:
        """A start marker, behind its `skip` (`Source.note_start`)."""
        with self._wake:
            source = self._sources.get(name)
            if source is not None:
                source.note_start(number, is_whole=is_whole, replayed=replayed)

    def is_whole(self, name: SourceName) -> bool:
        """Whether everything of a source is wanted, by its start marker."""
        source = self._sources.get(name)
        return source is not None and source.is_whole is True

    def replay_end(self, name: SourceName) -> int:
        """The numbers of a source below this one may have gone to an earlier owner."""
        source = self._sources.get(name)
        return 0 if source is None else source.replay_end

    def end(self, name: SourceName) -> None:
        """The source's end marker came."""
        with self._wake:
            (self._sources.get(name) or self._add(name, 0)).is_ended = True
            self._mark(name)

    def reopen(self, name: SourceName) -> None:
        """It was no end."""
        with self._wake:
            source = self._sources.get(name)
            if source is not None and source.is_ended:
                source.is_ended = False
                self._mark(name)

    def leave(self, names: Iterable[SourceName]) -> None:
        """Tell how far these are, that nothing more of them is wanted, and then nothing more."""
        with self._wake:
            for name in names:
                source = self._sources.get(name)
                if source is not None:
                    source.has_left = True
                    self._dirty.add(name)
        self.flush()
        with self._wake:
            for name in names:
                self._sources.pop(name, None)
                self._used.discard(name)

    def arrived(self, name: SourceName) -> int:
        """The number that the source comes to next."""
        source = self._sources.get(name)
        return 0 if source is None else source.arrived

    def processed(self, name: SourceName, number: int, size: int) -> None:
        """A sample is done, or it gave way to a newer one that is; not one whose jump was taken back meanwhile."""
        with self._wake:
            source = self._sources.get(name)
            if source is not None and source.done(number):
                self._note_done(name, size)

    def say_again(self) -> None:
        """Send everything once more, soon: who listens may not have heard of it."""
        with self._wake:
            self._dirty.update(self._sources)
            self._wake.notify()

    def flush(self) -> None:
        """Send what changed at once (the caller's thread)."""
        with self._sending:
            with self._wake:
                frames = self._frames()
            self._send_all(frames)

    def _add(self, name: SourceName, number: int) -> Source:
        source = self._sources[name] = Source.at(number)
        if len(self._sources) > MAX_SOURCES:
            self._make_room(name)
        return source

    def _make_room(self, newest: SourceName) -> None:
        """Forget the oldest of which nothing has come since it was looked at last: a live stream may be the oldest."""
        while (oldest := next(iter(self._sources))) in self._used or oldest == newest:
            self._used.discard(oldest)
            self._sources.move_to_end(oldest)  # in one step: who reads without the lock misses none
        del self._sources[oldest]

    # --- the thread --------------------------------------------------------------------------------------------------

    def _note_gap(self, name: SourceName, source: Source) -> None:
        if source.gap_since is not None and name not in self._gaps:
            self._gaps[name] = source
            self._wake.notify()

    def look_at_gaps(self) -> None:
        """Look at the clock while something is missing and waited for (under the lock, where there is a thread)."""
        if self._gaps:
            now = self._time.at(self.clock())
            self._gaps = {name: source for name, source in self._gaps.items() if source.is_waiting(now)}

    def _note_done(self, name: SourceName, size: int) -> None:
        self._samples += 1
        self._bytes += size
        self._mark(name)

    def _mark(self, name: SourceName) -> None:
        is_first = not self._dirty
        self._dirty.add(name)
        self._used.add(name)
        if is_first or self._is_urgent():
            self._wake.notify()

    def _is_urgent(self) -> bool:
        return self._samples >= ACK_SAMPLES or self._bytes >= ACK_BYTES

    def _frames(self) -> list[tuple[str, StreamAcks]]:
        changed: dict[str, list[StreamAck]] = {}
        for name in self._dirty:
            source = self._sources.get(name)
            if source is not None:
                changed.setdefault(name[1], []).append(source.ack(name[2], name[0]))
        self._dirty.clear()
        self._samples = self._bytes = 0
        return [
            (session, StreamAcks(acks=tuple(acks[at : at + MAX_PER_FRAME])))
            for session, acks in changed.items()
            for at in range(0, len(acks), MAX_PER_FRAME)
        ]

    def _send_all(self, frames: list[tuple[str, StreamAcks]]) -> None:
        for session, frame in frames:
            try:
                self._send(session, frame)
            except Exception as error:  # noqa: BLE001 - the session closes, or one frame is wrong: the next one goes on
                _log.debug("an acknowledgement was not sent (%s)", error)

    def _run(self) -> None:
        due = 0.0
        while True:
            with self._wake:
                while not self._dirty and not self._is_closed:
                    self._wake.wait(ACK_S if self._gaps else None)
                    self.look_at_gaps()
                rest = due - self.clock()
                if rest > 0 and not self._is_closed and not self._is_urgent():
                    self._wake.wait(rest)
                is_last = self._is_closed
            self.flush()
            if is_last:
                return
            due = self.clock() + ACK_S
