"""The receiving side of a numbered hop: what has come of one publisher, what is missing, what is lost.

Knows: the numbers of one publisher. Does not know: what a sample is, who sends it, threads, when an acknowledgement
leaves (`zsched.link.acknowledger`). The time is passed in (monotonic seconds).

Where everything is wanted, a number that is out of turn has to wait and the missing ones are asked for, at most for
`GIVE_UP_S`: then what is missing is lost and the stream goes on. Who wants only the newest takes any newer one. Numbers
that came before are dropped and counted either way.

Where everything is wanted a source begins with number 0, or with what its start marker says (`Source.skip`): what came
first is no proof that nothing was before it. What a start marker says of its stream may be a stranger's: it is told in
acknowledgements, and the publisher says what is true (`Source.note_start`). Only the lowest 32 bits of a number travel
(`zsched.core.hop.serial`).
"""

from __future__ import annotations

from collections import deque
from typing import Final

from zsched.core.hop.serial import number_near, serial_of
from zsched.core.values.relay_protocol import StreamAck, mark_of
from zsched.core.values.struct import Struct, field

SourceName = tuple[str, str, int]
"""(key, session id, entity id) of a publisher as zenoh names it."""

GIVE_UP_S: Final = 1.0
"""Missing numbers are lost after this wait, and the stream goes on."""
MAX_MISSING: Final = 256
MAX_AHEAD: Final = 1 << 30
"""A number further ahead could also lie behind. At 1 kHz this is a cut of twelve days."""
RETURN: Final = 3
"""This many numbers in a row take a jump back that nothing has followed; this many start markers take one back."""
MAX_SOURCES: Final = 8192
"""Publishers that a process remembers on the receiving side."""
MAX_REPLAYED: Final = 1 << 13
"""No start marker speaks of more replays: a relay keeps fewer."""


STEP_S: Final = 0.25
"""A longer pause between two looks means that the process stood still; it does not count as waiting."""


class RunningTime:
    """The time in which a process runs: while it is stopped nothing can come, so nothing is given up for that.

    It is asked at least every `STEP_S` while something is waited for.
    """

    def __init__(self) -> None:
        self._asked_at: float | None = None
        self._stood_s = 0.0

    def at(self, now: float) -> float:
        """The time that has run by ``now`` (monotonic seconds, never less than before)."""
        if self._asked_at is not None:
            self._stood_s += max(0.0, now - self._asked_at - STEP_S)
        self._asked_at = now
        return now - self._stood_s


class Jump(Struct):
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


class Source(Struct):
    """One publisher, as it has been heard."""

    first: int
    """The first number that has come, or should have."""
    arrived: int
    """The number that it comes to next."""
    processed: int
    """Everything below this number is done."""
    lost: int = 0
    doubled: int = 0
    reordered: int = 0
    gap_since: float | None = None
    """Since when something newer than `arrived` waits for it."""
    until: int = 0
    """Up to where it is missing."""
    is_ended: bool = False
    has_left: bool = False
    is_whole: bool | None = None
    """What a start marker has said of its class."""
    replay_end: int = 0
    """Numbers below this one went to an earlier owner, by a start marker."""
    _jump: Jump | None = None
    """The newest jump, until it is confirmed."""
    _doubts: int = 0
    """Start markers in a row that say less."""
    _gaps: deque[tuple[int, int]] = field(default_factory=lambda: deque(maxlen=MAX_MISSING))
    """Jumps (from, to) that were made while something before them was not processed yet."""
    _missing: deque[int] = field(default_factory=lambda: deque(maxlen=MAX_MISSING))
    """The newest of the numbers given up, to tell a late sample from a double one."""

    @classmethod
    def at(cls, number: int) -> Source:
        """A source that begins with ``number``."""
        return cls(first=number, arrived=number, processed=number)

    def number(self, serial: int) -> int:
        """The number that a serial stands for."""
        return number_near(serial, self.arrived)

    def ack(self, eid: int, key: str = "") -> StreamAck:
        """How far it is; ``eid`` is what its sender calls it, ``key`` where it was heard."""
        return StreamAck(
            eid=eid,
            of=mark_of(key) if key else 0,
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

    # --- samples -----------------------------------------------------------------------------------------------------

    def admit(self, number: int, now: float, *, in_turn: bool) -> bool:
        """Whether a sample that came is taken; else drop it. ``in_turn``: nothing may be missing before it.

        ``now`` is `RunningTime`, here and in `waits_s`.
        """
        if number == self.arrived:
            self.arrived += 1
            self.gap_since = None
            return True
        if number < self.arrived:
            if self._is_back(number):
                return True
            if number in self._missing:
                self.reordered += 1
            else:
                self.doubled += 1
            return False
        if number - self.arrived > MAX_AHEAD or (in_turn and not self._is_given_up(now)):
            return False
        self._jump_to(number)
        self.arrived += 1
        return True

    def _is_given_up(self, now: float) -> bool:
        return self.waits_s(now) > GIVE_UP_S

    def is_waiting(self, now: float) -> bool:
        """Whether something is missing that is not given up yet."""
        return self.gap_since is not None and now - self.gap_since <= GIVE_UP_S

    def waits_s(self, now: float) -> float:
        """For how long something newer waits, from now on at the latest (seconds)."""
        self.gap_since = self.gap_since or now
        return now - self.gap_since

    def take(self, serial: int) -> bool:
        """The sample that is next came and is processed already; ``False``: it is not that one, nothing happens."""
        if serial_of(serial) != serial_of(self.arrived):
            return False
        self.arrived = self.processed = self.arrived + 1
        self.gap_since = None
        return True

    @property
    def proven(self) -> int:
        """`arrived`, but before the newest jump while nothing has followed it: anybody can have made that."""
        jump = self._jump
        return jump.at if jump is not None and jump.to + 1 == self.arrived else self.arrived

    def done(self, number: int) -> bool:
        """A sample is done, or gave way to a newer one that is; not one whose jump was taken back meanwhile."""
        if not self.processed <= number < self.arrived:
            return False
        self.processed = number + 1
        while self._gaps and self._gaps[0][0] <= self.processed:
            self.processed = max(self.processed, self._gaps.popleft()[1])
        return True

    # --- markers -----------------------------------------------------------------------------------------------------

    def skip(self, number: int) -> int:
        """Nothing below ``number`` will come any more; answers how many are lost by that."""
        number = self.number(serial_of(number))
        if not 0 < number - self.arrived <= MAX_AHEAD:
            return 0
        is_first = self.arrived == self.first  # nothing has come: the stream begins later for us
        before = self.lost
        self._jump_to(number)
        if is_first:
            self.first, self.lost = number, before
        return self.lost - before

    def note_start(self, number: int, *, is_whole: bool, replayed: int) -> None:
        """A start marker (behind its `skip`): whether everything is wanted, how many from ``number`` on are replays.

        Anybody can put one. More is believed at once, for it only costs time; less when `RETURN` say so in a row.
        Either is told in the next acknowledgement, and the publisher corrects what is not so.
        """
        first = self.number(serial_of(number))
        end = first + replayed if first <= self.arrived and replayed <= MAX_REPLAYED else 0
        end, before = (one if one > self.arrived else 0 for one in (end, self.replay_end))
        is_less = end < before or (self.is_whole is True and not is_whole)
        if is_less and self._doubts + 1 < RETURN:
            self._doubts += 1
            is_whole, end = is_whole or self.is_whole is True, max(end, before)
        else:
            self._doubts = 0
        self.is_whole, self.replay_end = is_whole, end

    # --- jumps -------------------------------------------------------------------------------------------------------

    def _jump_to(self, number: int) -> None:
        if self.processed == self.arrived:  # nothing is in work
            self.processed = number
        else:
            self._gaps.append((self.arrived, number))
        self._jump = Jump(at=self.arrived, to=number, lost=self.lost)
        self.lost += number - self.arrived
        self._missing.extend(range(max(self.arrived, number - MAX_MISSING), number))
        self.arrived = number
        self.gap_since = None

    def _is_back(self, number: int) -> bool:
        """Whether the source goes on where the newest jump began, so that the jump is taken back."""
        jump = self._jump
        return jump is not None and jump.is_back(number, self.arrived - 1) and self.go_back(number)

    def go_back(self, number: int) -> bool:
        """Take the newest jump back: the source goes on with ``number``; ``False``: that is not within the jump."""
        jump = self._jump
        if jump is None or number < jump.at or self.arrived - 1 > jump.to:
            return False
        self.lost = jump.lost + number - jump.at
        self.first = min(self.first, jump.at)
        if self._gaps and self._gaps[-1] == (jump.at, jump.to):  # what was in work before it still is
            self._gaps[-1] = jump.at, number
        else:
            self.processed = number
        self.arrived, self._jump = number + 1, None
        self._missing.clear()
        return True
