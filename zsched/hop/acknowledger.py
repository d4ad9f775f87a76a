"""The receiving side of a numbered hop: what came, what is missing, and telling each sender how far it is.

Knows: numbers per publisher, when an acknowledgement is due. Does not know: what a sample is, roles, zenoh sessions.

Workers use it for their inputs, relays for the workers' answers. A publisher that waits for its receivers (congestion
control BLOCK: classes ``latest`` and ``reliable``) keeps what is not acknowledged. Where everything is wanted, a number
that is out of turn has to wait and the missing ones are asked for, at most for `GIVE_UP_S`: then what is missing is
lost and the stream goes on. Who wants only the newest takes any newer one. Numbers that came before are dropped and
counted either way.

Where everything is wanted a source begins with number 0, or with what its start marker says (`Acknowledger.skip`): what
came first is no proof that nothing was before it. What a start marker says of its stream may be a stranger's: it is
told in acknowledgements, and the publisher says what is true (`Acknowledger.note_start`). Only the lowest 32 bits of a
number travel (`zsched.core.hop.serial`).
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Final

from zsched.clock import monotonic_s
from zsched.core.hop.serial import number_near, serial_of
from zsched.core.relay_protocol import StreamAck, StreamAcks
from zsched.guard import guarded

ACK_S: Final = 0.05
"""Acknowledgements leave so often while anything changes (20 Hz)..."""
ACK_SAMPLES: Final = 256
ACK_BYTES: Final = 1 << 20
"""...or when so much was processed."""
GIVE_UP_S: Final = 1.0
MAX_MISSING: Final = 256
MAX_SOURCES: Final = 8192
MAX_PER_FRAME: Final = 500
MAX_AHEAD: Final = 1 << 30
"""No source is so far ahead: at 1 kHz that is a cut of twelve days. Of what is further nobody knows which way it is."""
RETURN: Final = 3
"""So many numbers in a row take a jump back that nothing has followed; so many start markers what one has said."""
MAX_REPLAYED: Final = 1 << 13
"""No start marker speaks of more replays: a relay keeps fewer."""

SourceName = tuple[str, str, int]
"""(key, session id, entity id) of a publisher as zenoh names it."""

_log = logging.getLogger("zsched.streams")


@dataclass(slots=True)
class Jump:
    """The newest jump over numbers that have not come: where it began and ended, what has come of them since.

    Anybody can put one number. So a jump stands once something newer follows; when `RETURN` numbers in a row go on
    where it began instead, it was nobody of ours who made it.
    """

    at: int
    to: int
    lost: int = 0
    """What was lost before it."""
    count: int = 0

    def is_back(self, number: int, newest: int) -> bool:
        """Whether the source goes on where the jump began, with ``number``; ``newest`` is the highest that has come."""
        if newest > self.to or number != self.at + self.count:
            return False
        self.count += 1
        return self.count >= RETURN


@dataclass(slots=True)
class _Source:
    first: int
    arrived: int
    processed: int
    lost: int = 0
    doubled: int = 0
    reordered: int = 0
    gap_since: float | None = None
    until: int = 0
    is_ended: bool = False
    has_left: bool = False
    jump: Jump | None = None
    """The newest jump, until it is confirmed."""
    is_whole: bool | None = None
    """What a start marker has said of its class."""
    replay_end: int = 0
    """Numbers below this one went to an earlier owner, by a start marker."""
    doubts: int = 0
    """Start markers in a row that say less."""
    gaps: deque[tuple[int, int]] = field(default_factory=lambda: deque(maxlen=MAX_MISSING))
    """Jumps (from, to) that were made while something before them was not processed yet."""
    missing: deque[int] = field(default_factory=lambda: deque(maxlen=MAX_MISSING))
    """The newest of the numbers given up, to tell a late sample from a double one."""

    def ack(self, eid: int) -> StreamAck:
        return StreamAck(
            eid=eid,
            first=self.first,
            arrived=self.arrived,
            processed=self.processed,
            lost=self.lost,
            doubled=self.doubled,
            reordered=self.reordered,
            has_gap=self.gap_since is not None,
            until=self.until if self.gap_since is not None else 0,
            is_ended=self.is_ended,
            has_left=self.has_left,
            is_whole=self.is_whole,
            replays=max(0, self.replay_end - self.arrived),
        )


class Acknowledger:
    """The numbers of every publisher heard, and a thread that sends what changed: ``send(session id, frame)``."""

    def __init__(self, send: Callable[[str, StreamAcks], None], *, born_at: float | None = None) -> None:
        """``send`` puts a frame for the session with that zenoh id; it must not block long."""
        self._send = send
        self.born_at = monotonic_s() if born_at is None else born_at
        """When this process began to listen."""
        self._sources: dict[SourceName, _Source] = {}
        self._dirty: set[SourceName] = set()
        self._wake = threading.Condition()
        self._sending = threading.Lock()
        """Frames leave in the order in which they were made: one that says less than the one before is a stranger's."""
        self._samples = 0
        self._bytes = 0
        self._is_closed = False
        self._thread = guarded(self._run, name="zsched acks")
        self._thread.start()

    def close(self) -> None:
        """Send what changed, then end."""
        with self._wake:
            self._is_closed = True
            self._wake.notify()

    def admit(self, name: SourceName, serial: int, *, in_turn: bool) -> int | None:
        """A sample came; answers its number, ``None``: drop it. ``in_turn``: nothing may be missing before it."""
        with self._wake:
            source = self._sources.get(name) or self._add(name, 0 if in_turn else serial)
            number = number_near(serial, source.arrived)
            is_admitted = self._judge(source, number, in_turn=in_turn)
            if not is_admitted:
                self._mark(name)
            return number if is_admitted else None

    def number(self, name: SourceName, serial: int) -> int:
        """The number that a serial of a source stands for."""
        with self._wake:
            source = self._sources.get(name)
            return serial if source is None else number_near(serial, source.arrived)

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
            if source is None or serial_of(serial) != serial_of(source.arrived):
                return False
            source.arrived = source.processed = source.arrived + 1
            source.gap_since = None
            self._samples += 1
            self._bytes += size
            self._mark(name)
            return True

    def ask_for(self, name: SourceName, until: int) -> float:
        """Everything below ``until`` is missing; answers for how long nothing has come of it, in seconds."""
        with self._wake:
            source = self._sources.get(name) or self._add(name, until)
            source.gap_since = source.gap_since or monotonic_s()
            source.until = until
            self._mark(name)
            return monotonic_s() - source.gap_since

    def skip(self, name: SourceName, number: int) -> int:
        """Nothing below ``number`` will come any more; answers how many are lost by that. It is always answered."""
        with self._wake:
            source = self._sources.get(name)
            if source is None:
                source = self._add(name, number)
            number = number_near(serial_of(number), source.arrived)
            self._mark(name)
            if not 0 < number - source.arrived <= MAX_AHEAD:
                return 0
            is_first = source.arrived == source.first  # nothing has come: the stream begins later for us
            before = source.lost
            self._jump(source, number)
            if is_first:
                source.first, source.lost = number, before
            return source.lost - before

    def note_start(self, name: SourceName, number: int, *, is_whole: bool, replayed: int) -> None:
        """A start marker (behind its `skip`): whether everything is wanted, how many from ``number`` on are replays.

        Anybody can put one. More is believed at once, for it only costs time; less when `RETURN` say so in a row.
        Either is told in the next acknowledgement, and the publisher corrects what is not so.
        """
        with self._wake:
            source = self._sources.get(name)
            if source is None:
                return
            first = number_near(serial_of(number), source.arrived)
            end = first + replayed if first <= source.arrived and replayed <= MAX_REPLAYED else 0
            end, before = (one if one > source.arrived else 0 for one in (end, source.replay_end))
            is_less = end < before or (source.is_whole is True and not is_whole)
            source.doubts = source.doubts + 1 if is_less else 0
            if is_less and source.doubts < RETURN:
                is_whole, end = is_whole or source.is_whole is True, max(end, before)
            else:
                source.doubts = 0
            source.is_whole, source.replay_end = is_whole, end

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

    def arrived(self, name: SourceName) -> int:
        """The number that the source comes to next."""
        source = self._sources.get(name)
        return 0 if source is None else source.arrived

    def processed(self, name: SourceName, number: int, size: int) -> None:
        """A sample is done, or it gave way to a newer one that is; not one whose jump was taken back meanwhile."""
        with self._wake:
            source = self._sources.get(name)
            if source is None or not source.processed <= number < source.arrived:
                return
            source.processed = number + 1
            while source.gaps and source.gaps[0][0] <= source.processed:
                source.processed = max(source.processed, source.gaps.popleft()[1])
            self._samples += 1
            self._bytes += size
            self._mark(name)

    def flush(self) -> None:
        """Send what changed at once (the caller's thread)."""
        with self._sending:
            with self._wake:
                frames = self._frames()
            self._send_all(frames)

    # --- numbers -----------------------------------------------------------------------------------------------------

    def _add(self, name: SourceName, number: int) -> _Source:
        source = self._sources[name] = _Source(first=number, arrived=number, processed=number)
        if len(self._sources) > MAX_SOURCES:
            self._sources.pop(next(iter(self._sources)))
        return source

    def _judge(self, source: _Source, number: int, *, in_turn: bool) -> bool:
        if number == source.arrived:
            source.arrived += 1
            source.gap_since = None
            return True
        if number < source.arrived:
            if self._is_back(source, number):
                return True
            if number in source.missing:
                source.reordered += 1
            else:
                source.doubled += 1
            return False
        if number - source.arrived > MAX_AHEAD or (in_turn and not self._is_given_up(source)):
            return False
        self._jump(source, number)
        source.arrived += 1
        return True

    def _is_given_up(self, source: _Source) -> bool:
        now = monotonic_s()
        source.gap_since = source.gap_since or now
        return now - source.gap_since > GIVE_UP_S

    def _jump(self, source: _Source, number: int) -> None:
        if source.processed == source.arrived:  # nothing is in work
            source.processed = number
        else:
            source.gaps.append((source.arrived, number))
        source.jump = Jump(at=source.arrived, to=number, lost=source.lost)
        source.lost += number - source.arrived
        source.missing.extend(range(max(source.arrived, number - MAX_MISSING), number))
        source.arrived = number
        source.gap_since = None

    def _is_back(self, source: _Source, number: int) -> bool:
        """Whether the source goes on where the newest jump began, so that the jump is taken back."""
        jump = source.jump
        if jump is None or not jump.is_back(number, source.arrived - 1):
            return False
        source.lost = jump.lost + jump.count - 1
        source.first = min(source.first, jump.at)
        if source.gaps and source.gaps[-1] == (jump.at, jump.to):  # what was in work before it still is
            source.gaps[-1] = jump.at, number
        else:
            source.processed = number
        source.arrived, source.jump = number + 1, None
        source.missing.clear()
        return True

    # --- the thread --------------------------------------------------------------------------------------------------

    def _mark(self, name: SourceName) -> None:
        is_first = not self._dirty
        self._dirty.add(name)
        if is_first or self._is_urgent():
            self._wake.notify()

    def _is_urgent(self) -> bool:
        return self._samples >= ACK_SAMPLES or self._bytes >= ACK_BYTES

    def _frames(self) -> list[tuple[str, StreamAcks]]:
        changed: dict[str, list[StreamAck]] = {}
        for name in self._dirty:
            source = self._sources.get(name)
            if source is not None:
                changed.setdefault(name[1], []).append(source.ack(name[2]))
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
                    self._wake.wait()
                rest = due - monotonic_s()
                if rest > 0 and not self._is_closed and not self._is_urgent():
                    self._wake.wait(rest)
                is_last = self._is_closed
            self.flush()
            if is_last:
                return
            due = monotonic_s() + ACK_S
