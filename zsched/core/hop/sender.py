"""The sending side of a numbered hop: what was sent under which number, and what the receiver has said of it.

Knows: the numbers of one publisher towards one receiver, what is put again and when. Does not know: what a sample is,
how it is put, threads, several receivers (`zsched.core.hop.shared`). The time is passed in (monotonic seconds).

Class ``reliable`` greets its receiver before the first sample: a start marker says the lowest number that may come, and
the receiver's acknowledgement of it says who it is and what it waits for. Only then samples go out (the receiver is
*met*). What a receiver has never been told of it refuses, so nothing is ever sent into the blue: not to a worker that
stands still, has no link or has just begun another life.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

from zsched.core.hop.kept import NOTHING, RESEND_S, Kept, Owed, Sent
from zsched.core.hop.serial import number_near, serial_of
from zsched.core.values.relay_protocol import StreamAck
from zsched.core.values.struct import Struct, field, replace

KEPT_SAMPLES: Final = 2048
KEPT_BYTES: Final = 16 << 20
"""Bounds of what one publisher of class ``reliable`` keeps until it is acknowledged."""
KEPT_BYTES_LATEST: Final = 256 << 10
"""Class ``latest``: this much beside the newest ``keep_last`` samples; large ones cost a radio too much time."""
GREET_S: Final = 0.2
MAX_GREET_S: Final = 1.0
"""An unanswered start marker is put again after this time, and then after twice as long each time; bounds of that."""
MAX_RESEND_S: Final = 10.0
"""The longest wait before unacknowledged samples are put again."""


class Sums(NamedTuple):
    """What a life of the receiver has said, in samples."""

    acknowledged: int
    lost: int
    doubled: int
    reordered: int
    at_most_lost: int = 0
    """It left this many open when another life followed."""


class Sender(Struct, kw_only=True, eq=False):
    """One publisher towards one receiver."""

    is_whole: bool = False
    """Every sample is wanted (class ``reliable``), so the receiver is greeted first."""
    kept_samples: int = KEPT_SAMPLES
    kept_least: int = 1
    kept_limit: int = KEPT_BYTES
    """Bounds of what is kept: samples, those of them whatever they weigh, and bytes."""
    count: int = 0
    """Samples put so far, and the number of the next one."""
    base: int = 0
    """The first number that the receiver's present life answers for."""
    is_met: bool = False
    """This life of the receiver has answered our start marker, so it knows the first number and misses none."""
    is_foreign: bool = False
    """Whoever subscribes here acknowledges nothing."""
    was_foreign: bool = False
    forgiven: int | None = None
    """What this receiver counts as lost of numbers below `base`; ``None``: all of them, if it began before."""
    unmet_since: float = 0.0
    keeps_work: bool = False
    """Keep samples until they are processed, not only until they have arrived: the next owner may have to do them."""
    replay_end: int = 0
    """Numbers below this one may have gone to a receiver that died."""
    greeted_at: float | None = None
    greet_pause_s: float = GREET_S
    ack: StreamAck | None = None
    incarnation: str = ""
    kept: Kept = field(default_factory=Kept)
    spare: list[Sent] = field(default_factory=list)
    """What the newest acknowledgement has let go of: until one that goes further, it may be taken back."""
    resend_from: int | None = None
    question: int | None = None
    """It has been asked how far it is, when this many samples had been put: its next acknowledgement is the answer."""
    is_start_due: bool = False
    """Our start marker goes out again: the receiver believes one that was not ours, or is asked how far it is."""
    moved_at: float = 0.0
    """When something was last sent or newly acknowledged (monotonic seconds)."""
    asked_at: float = 0.0
    """When it was last put again, or the receiver came further: newer samples that go out fill no gap."""
    pause_s: float = RESEND_S
    """How long nothing may move before it is put again: twice what acknowledgements take here, or as long as a put
    takes; doubled each time."""

    # --- what goes out -----------------------------------------------------------------------------------------------

    def note_put(self, sample: Any, stamp: Any, size: int, *, at: float, took_s: float = 0.0) -> Sums | None:
        """A sample was put under the next number: its put returned at a time, after this wait.

        Answers the sums of whoever acknowledged before, when nobody acknowledges this one.
        """
        if self.is_foreign:
            return self.pass_on()
        sent = Sent(self.count, sample, stamp, size, at, took_s)
        self.count += 1
        bound = self.kept_limit + size if self.is_whole else self.kept_limit  # one that is full puts no more
        self.kept.keep(sent, samples=self.kept_samples, least=self.kept_least, size=bound)
        self.moved_at, self.pause_s = at, max(self.pause_s, min(took_s, MAX_RESEND_S))
        return None

    def take_greeting(self, now: float) -> int | None:
        """The lowest number that may come, when the receiver is to be told it now by a start marker."""
        if self.greeted_at is not None:
            if now - self.greeted_at <= self.greet_pause_s:
                return None
            self.greet_pause_s = min(2 * self.greet_pause_s, MAX_GREET_S)
        self.greeted_at = now
        return self.lowest

    @property
    def owes(self) -> bool:
        """Whether something is to be put besides new samples, now or once the receiver is met."""
        return self.resend_from is not None or self.is_start_due

    def take_owed(self) -> Owed:
        """What is to be put now besides new samples; whoever has put it again says so (`resent`)."""
        if not self.may_resend:
            return NOTHING
        start = self.lowest if self.is_start_due else None
        self.is_start_due = False
        if self.resend_from is None:
            return NOTHING if start is None else Owed(start=start)
        owed = self.kept.owed(self.resend_from, self.count, self.resend_from)
        self.resend_from = None
        return owed._replace(start=start)

    def look_after(self, now: float) -> bool:
        """Have put again what is late; ``False``: nothing is.

        Where not everything is wanted, the receiver is asked first how far it is: it drops what is older than what it
        has, but would take old numbers in a row for proof that a stranger made its newest jump.
        """
        if not self.may_resend or not self.is_late(now):
            return False
        self.ask_again(self.arrived, now)
        if not self.is_whole:
            self.resend_from, self.question, self.is_start_due = None, self.count, True
        return True

    def announce(self, count: int) -> int:
        """This many numbers from the next one on will be replays; answers the lowest that may come before them."""
        self.replay_end = self.count + count
        return self.lowest

    def is_late(self, now: float) -> bool:
        """Whether what is not acknowledged should be put again.

        As TCP's retransmission timer (RFC 6298): a slow radio takes its time for every large sample, and sending it
        twice would make it slower.
        """
        return self.arrived < self.count and now - self.moved_at > self.pause_s

    def ask_again(self, start: int, now: float) -> None:
        """Have everything from ``start`` on put again; the next time with twice the patience, while nothing moves."""
        self.resend_from = start
        self.resent(now)
        self.pause_s = min(2 * self.pause_s, MAX_RESEND_S)

    def resent(self, now: float) -> None:
        """What was asked for has been put again."""
        self.moved_at = self.asked_at = now

    # --- what the receiver says --------------------------------------------------------------------------------------

    def hear(self, ack: StreamAck, incarnation: str, now: float) -> Sums | None:
        """Take an acknowledgement; answers the sums of the receiver's life before, when another one has said it."""
        before, ack, ended = self.ack, near(ack, self.count), None
        if not self.acknowledge(ack, incarnation, now):
            ended = self._follow(ack, incarnation, now)
        elif before is None or ack.arrived > before.arrived:
            self.moved_at = self.asked_at = now
        elif self.question == self.count:  # what has been put since makes what is older needless
            self.resend_from = self.arrived
        self.question = None
        self.is_start_due |= self._mishears(ack)
        if self.is_whole:
            self.meet(now)
        is_still = now - self.asked_at > self.pause_s / 3
        if ack.has_gap and (is_still or before is None or not before.has_gap) and self.may_resend:
            self.ask_again(ack.arrived, now)
        return ended

    @property
    def may_resend(self) -> bool:
        """Whether the receiver knows where this stream begins for it."""
        return not self.is_whole or self.is_met

    def _follow(self, ack: StreamAck, incarnation: str, now: float) -> Sums:
        """Another life answers: what the former one left open may be lost; who has not been greeted had nothing."""
        start = self.count if self.is_whole else min(max(ack.first, self.processed), self.count)
        if self.keeps_work and self.kept:
            start = max(self.kept.first(self.count), self.processed)
        ended = self.begin_life(incarnation, start)
        self.acknowledge(ack, incarnation, now)
        if self.is_whole:
            self.part(now)
        return ended

    def acknowledge(self, ack: StreamAck, incarnation: str, now: float) -> bool:
        """Take an acknowledgement (`near` our count); ``False``, and nothing is taken: another life of it sent it."""
        if self.incarnation and incarnation != self.incarnation:
            return False
        if not ack.processed <= ack.arrived <= self.count + 1:
            return True  # of what was never sent (one may be on its way and not counted yet): nobody of ours says so
        self.incarnation, self.is_foreign = incarnation, False
        limit = ack.processed if self.keeps_work else ack.arrived
        self.ack = ack
        self._take_back(limit)
        gone = self.kept.let_go(limit)
        if gone:
            newest, self.spare = gone[-1], gone
            self.pause_s = min(max(2 * (now - newest.at), newest.took_s, RESEND_S), MAX_RESEND_S)
        return True

    def _take_back(self, limit: int) -> None:
        """An acknowledgement that says less than the one before: the worker's own never does, so that was a stranger's.

        Anybody can put one under the worker's key. What it let go of is kept again.
        """
        while self.spare and self.spare[-1].number >= limit:
            self.kept.take_back(self.spare.pop())

    def _mishears(self, ack: StreamAck) -> bool:
        """Whether the receiver believes of this stream what is not so."""
        replays = max(0, self.replay_end - ack.arrived)
        return ack.is_whole is not None and (ack.is_whole != self.is_whole or ack.replays != replays)

    def meet(self, now: float) -> bool:
        """The receiver has said something: whether it answers a start marker, and is met by that."""
        if self.is_met or self.greeted_at is None or self.ack is None or self.ack.arrived < self.base:
            return False
        self.is_met = True
        if self.was_foreign:
            self.was_foreign, self.forgiven = False, self.ack.lost
        if self.arrived < self.count:
            self.ask_again(self.arrived, now)
        return True

    def part(self, now: float) -> None:
        """The receiver is not there (any more), or there is another one: greet it before anything more is sent."""
        self.is_met = self.is_foreign = False
        self.unmet_since, self.greeted_at, self.greet_pause_s = now, None, GREET_S

    def begin_life(self, incarnation: str, start: int, *, is_foreign: bool = False) -> Sums:
        """Another life of the receiver answers from ``start`` on; answers the sums of the former one.

        ``is_foreign``: so far nobody does, and whoever does later may be the former one.
        """
        ended = self.sums()._replace(at_most_lost=max(0, start - self.processed))
        self.incarnation, self.base = incarnation, start
        self.was_foreign, self.forgiven = is_foreign, None
        self.replay_end = self.count if self.keeps_work else 0
        self.ack, self.resend_from = None, None
        self.spare.clear()
        self.kept.let_go(start)
        return ended

    def pass_on(self) -> Sums:
        """A sample went to a subscriber that acknowledges nothing; answers the sums of whoever did before."""
        ended = self.sums()._replace(at_most_lost=self.in_flight)
        self.count += 1
        self.begin_life("", self.count, is_foreign=True)
        return ended

    # --- how far it is -----------------------------------------------------------------------------------------------

    def sums(self) -> Sums:
        """What this life of the receiver has said."""
        doubled, reordered = (0, 0) if self.ack is None else (self.ack.doubled, self.ack.reordered)
        return Sums(self.acknowledged, self.lost, doubled, reordered)

    @property
    def lowest(self) -> int:
        """The lowest number that may still be sent: what a start marker says."""
        first = self.spare[0].number if self.spare else self.kept.first(self.count)
        return max(self.base, first)

    def unprocessed(self) -> list[Sent]:
        """What is kept of the samples that the receiver has not acknowledged as processed."""
        return [sent for sent in self.kept if sent.number >= self.processed]

    @property
    def arrived(self) -> int:
        """Number of the sample the receiver waits for; everything, while it never acknowledged."""
        return self.count if self.ack is None else min(self.ack.arrived, self.count)

    @property
    def processed(self) -> int:
        """Everything below this number is acknowledged, or known to be lost."""
        return self.base if self.ack is None else min(max(self.ack.processed, self.ack.first, self.base), self.count)

    @property
    def in_flight(self) -> int:
        """Samples sent and not processed yet, as far as we know."""
        return self.count - self.processed

    @property
    def lost(self) -> int:
        """What this life of the receiver has not had of that: given up, or before the first number it saw."""
        if self.ack is None:
            return 0
        first = min(self.ack.first, self.count)
        before = max(0, self.base - first) if self.forgiven is None else self.forgiven
        known = max(0, self.ack.lost - before) + max(0, first - self.base)
        return min(known, self.processed - self.base)

    @property
    def acknowledged(self) -> int:
        """What this life of the receiver has processed."""
        return self.processed - self.base - self.lost

    def is_full(self) -> bool:
        """True when nothing more may be sent before an acknowledgement (class ``reliable``)."""
        if self.ack is None:
            return False
        return self.in_flight >= self.kept_samples or self.kept.size >= self.kept_limit


def near(ack: StreamAck, count: int) -> StreamAck:
    """An acknowledgement in numbers around ``count``: the receiver may have heard only their lowest bits."""
    shift = number_near(serial_of(ack.arrived), count) - ack.arrived
    if not shift:
        return ack
    return replace(
        ack,
        first=max(0, ack.first + shift),
        arrived=ack.arrived + shift,
        processed=max(0, ack.processed + shift),
        until=max(0, ack.until + shift) if ack.until else 0,
    )
