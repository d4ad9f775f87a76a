"""The sending side of a numbered hop with several receivers: what is kept, how far each of them is, what each is owed.

Knows: the numbers of one publisher, the receivers that acknowledge, since when one of them stands still. Does not know:
what a sample is, how it is put or whether a receiver can be reached (it is told), threads. The time is passed in
(monotonic seconds). With one receiver that is greeted before the first sample, a hop has a
`zsched.core.hop.sender.Sender`; what both keep, and how they put it again, is in `zsched.core.hop.kept`.

Every sample goes to everybody at once. What one receiver lacks goes to that one alone, when it asks or when it has made
no progress for a while. Nobody is greeted: a receiver is known by its first acknowledgement. One that comes late
begins with number 0, so the first samples are kept for `NEWCOMERS_S`. Losses are counted by each receiver, not here.

Anybody can acknowledge under any receiver's name. So at most `MAX_RECEIVERS` are remembered. The node is the one that
the word's key is bound to (in a secured fleet by its certificate), the receiver's name is its own word. So what two
nodes say of one name is kept apart: neither lets go of what the other lacks.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

from zsched.core.hop.kept import NOTHING, RESEND_S, Kept, Owed, Sent
from zsched.core.hop.sender import near
from zsched.core.values.relay_protocol import EndMarker, StreamAck
from zsched.core.values.struct import Struct, field

SHARED_BYTES: Final = 32 << 20
"""One publisher keeps at most this much beside the newest sample."""
MAX_PAUSE_S: Final = 2.0
"""A receiver without progress is sent what it lacks after `RESEND_S`, then after twice as long, at most after this."""
ASKED_S: Final = 0.1
"""A receiver that asks for the same once more within this time has it on its way."""
FORGET_S: Final = 10.0
"""A receiver that cannot be reached for this time is forgotten; so is what nobody has acknowledged."""
MAX_RECEIVERS: Final = 256
"""Receivers that a publisher remembers; beyond, the longest silent one goes, first of those that were never reached."""
NEWCOMERS_S: Final = 3.0
"""For this time behind the first sample a receiver may begin with it: one that learnt of it late, or had no link."""
STALLED_S: Final = 1.0
"""A receiver that lacks something and has not come further for this time is stalled: nothing waits for it."""
BESIDE: Final = " by "
"""Between a receiver's name, which has no blanks, and the node that speaks for it beside another one."""
BATCH: Final = 512
BATCH_BYTES: Final = 4 << 20
"""At most this much is put again at one time; progress brings the next."""
LOOK_S: Final = 0.1
"""A receiver that is expected and has said nothing for this time: it is looked whether it subscribes at all."""
TICK_S: Final = 0.1
"""A worker looks after kept answers this often: a way to a receiver does not say when it comes to match."""


def spoken_for(name: str) -> str:
    """The receiver that is meant by a name of `SharedSender.receivers`, whichever node speaks for it.

    >>> spoken_for("a1"), spoken_for("a1 by robot2")
    ('a1', 'a1')
    """
    return name.partition(BESIDE)[0]


class Wanted(NamedTuple):
    """What a receiver is to be put again: everything that it lacks below a number."""

    until: int
    is_asked: bool = False
    """It has said itself that this is missing, so it must hear what is kept no more."""
    is_question: bool = False
    """It is only asked how far it is, by a skip of what it has; its answer says what is put again."""


class Receiver(Struct, eq=False):
    """One that acknowledges: ``arrived`` is the number it comes to next."""

    node: str
    beside: str = ""
    """The name of the receiver that another node speaks for, too; empty: there was none when this one was heard."""
    arrived: int = -1
    had: int | None = None
    """The numbers below this one an earlier life of it has acknowledged; it is not sent them."""
    waits_for: int = 0
    """What it comes to next by its own word: a new life begins at 0."""
    moved_at: float = 0.0
    """When it came further, or was last put something again."""
    pause_s: float = RESEND_S
    wanted: Wanted | None = None
    """What is to be put again, until it is taken."""
    question: int | None = None
    """It has been asked how far it is, when this many samples had been put: its next acknowledgement is the answer."""
    batch_end: int | None = None
    unreached_since: float | None = None
    heard_at: float = 0.0
    owes_since: float | None = None
    """Since when it lacks something and has not come further."""
    is_ended: bool = False
    has_left: bool = False
    """It wants nothing more."""
    is_confirmed: bool = False
    """It was seen to subscribe to what is sent again."""

    def is_awaited(self, now: float, *, is_own: bool) -> bool:
        """Whether an input waits until it has the answers; ``is_own``: the input came from it."""
        is_moving = self.owes_since is None or now - self.owes_since <= STALLED_S
        return not self.has_left and (is_own or is_moving)

    def note_debt(self, count: int, now: float, *, has_moved: bool) -> None:
        """Note since when it stands still with less than ``count`` samples."""
        if self.arrived >= count:
            self.owes_since = None
        elif has_moved or self.owes_since is None:
            self.owes_since = now


class Expected(Struct, eq=False):
    """One whose inputs answers were made of, and that has acknowledged none: it may not be told of them at all."""

    since: float
    is_decided: bool = False
    """It is a receiver by now, or does not subscribe."""


class SharedSender(Struct, kw_only=True, eq=False):
    """One publisher towards everybody that subscribes and acknowledges."""

    limit: int
    """Samples that are kept at most."""
    is_whole: bool = True
    """Every sample is wanted (class ``reliable``). If not, a late receiver is asked first how far it is: it drops what
    is older than what it has, but would take old numbers in a row for proof that a stranger made its newest jump."""
    count: int = 0
    """Samples put so far, and the number of the next one."""
    kept: Kept = field(default_factory=Kept)
    receivers: dict[str, Receiver] = field(default_factory=dict)
    expected: dict[str, Expected] = field(default_factory=dict)
    """{one that may come to be a receiver: what is known of it}."""
    had: dict[str, tuple[str, int]] = field(default_factory=dict)
    """{receiver that was forgotten: (its node, how far it has acknowledged)}, the oldest first."""
    end: EndMarker | None = None
    ended_at: float = 0.0
    began_at: float | None = None
    is_over: bool = False
    """Nobody looks after it any more: there is nothing left to do."""
    crowded_out: int = 0
    """Receivers that were forgotten for want of room."""
    contradicted: int = 0
    """Receivers that two nodes have spoken for."""

    # --- what goes out -----------------------------------------------------------------------------------------------

    def note_put(self, sample: Any, stamp: Any, size: int, now: float) -> int:
        """A sample is about to be put; answers its number. The oldest that are kept give way."""
        number, self.count, self.end = self.count, self.count + 1, None
        self.began_at = now if self.began_at is None else self.began_at
        self.kept.keep(Sent(number, sample, stamp, size, now), samples=self.limit, least=1, size=SHARED_BYTES)
        return number

    def note_end(self, marker: EndMarker, now: float) -> None:
        """The end marker was put behind the last sample."""
        self.end, self.ended_at = marker, now

    def owing(self) -> tuple[str, ...]:
        """The receivers that something is to be put again for (`take_owed`)."""
        return tuple(name for name, one in self.receivers.items() if one.wanted is not None)

    def take_owed(self, name: str, now: float, *, is_reached: bool) -> Owed:
        """What a receiver is to be put now; nothing when it is not reached."""
        receiver = self.receivers.get(name)
        if receiver is None or receiver.wanted is None:
            return NOTHING
        wanted, receiver.wanted, receiver.moved_at = receiver.wanted, None, now
        if not self._is_reached(name, receiver, now, is_reached=is_reached):
            return NOTHING
        if wanted.is_question:
            receiver.question = self.count
            return Owed(skip=receiver.arrived)
        until = min(wanted.until, self.count)
        owed = self.kept.owed(receiver.arrived, until, receiver.waits_for, samples=BATCH, size=BATCH_BYTES)
        end = owed.again[-1].number + 1 if owed.again else wanted.until
        receiver.batch_end = end if end < wanted.until else None
        is_end_due = self.end is not None and not receiver.is_ended and not owed.again
        return owed._replace(skip=owed.skip if wanted.is_asked else None, end=self.end if is_end_due else None)

    def skip_marker(self, name: str, count: int, now: float) -> EndMarker:
        """What tells a receiver that it must not wait for the numbers below ``count``."""
        receiver = self.receivers.get(name)
        age_s = None if self.began_at is None else now - self.began_at
        return EndMarker(epoch=0, count=count, had=None if receiver is None else receiver.had, age_s=age_s)

    def _is_reached(self, name: str, receiver: Receiver, now: float, *, is_reached: bool) -> bool:
        if is_reached:
            receiver.unreached_since, receiver.is_confirmed = None, True
            return True
        receiver.unreached_since = now if receiver.unreached_since is None else receiver.unreached_since
        if now - receiver.unreached_since > FORGET_S:
            self.forget(name)
        return False

    # --- what the receivers say --------------------------------------------------------------------------------------

    def hear(self, name: str, node: str, ack: StreamAck, now: float) -> Receiver:
        """Take an acknowledgement of the receiver with this name, on a node."""
        other = self.receivers.get(name)
        beside = "" if other is None or other.node == node else name
        alias = f"{name}{BESIDE}{node}"
        if beside or alias in self.receivers:
            name = alias
        receiver = self.receivers.get(name) or self._add(name, node, beside)
        ack = near(ack, self.count)
        receiver.waits_for = min(ack.arrived, self.count)  # nobody can have more than was sent
        arrived = max(receiver.waits_for, receiver.had or 0)
        has_moved = arrived > receiver.arrived
        receiver.heard_at, receiver.is_ended, receiver.has_left = now, ack.is_ended, ack.has_left
        if has_moved:
            receiver.arrived, receiver.moved_at, receiver.pause_s = arrived, now, RESEND_S
        receiver.note_debt(self.count, now, has_moved=has_moved)
        self._let_go(now)
        self._note_wanted(receiver, ack, now, has_moved=has_moved)
        return receiver

    def _note_wanted(self, receiver: Receiver, ack: StreamAck, now: float, *, has_moved: bool) -> None:
        if ack.has_gap:
            if has_moved or now - receiver.moved_at > ASKED_S:
                receiver.wanted = Wanted(ack.until or self.count, is_asked=True)
        elif receiver.batch_end is not None and receiver.arrived >= receiver.batch_end:
            receiver.batch_end = None
            if receiver.arrived < self.count:
                receiver.wanted = Wanted(self.count)
        elif receiver.question == self.count and not has_moved:  # what has been put since makes older ones needless
            receiver.wanted = Wanted(self.count)
        receiver.question = None

    def _add(self, name: str, node: str, beside: str) -> Receiver:
        """One that is heard for the first time; one that begins another life has another name on the same node."""
        for old in [other for other, one in self.receivers.items() if one.node == node]:
            self.forget(old)
        if len(self.receivers) >= MAX_RECEIVERS:
            self._make_room()
        receiver = self.receivers[name] = Receiver(node=node, beside=beside, had=self._had_by(name, node))
        self.contradicted += bool(beside)
        return receiver

    def forget(self, name: str) -> None:
        """A receiver is another one by now, or cannot be reached; what it had is remembered."""
        gone = self.receivers.pop(name, None)
        if gone is None:
            return
        self.had[name] = (gone.node, gone.arrived)
        if len(self.had) > MAX_RECEIVERS:
            self.had.pop(next(iter(self.had)))

    def _had_by(self, name: str, node: str) -> int | None:
        """How far a receiver's node has come by another name, ``None``: by none; one that is known knows it itself."""
        if self.had.pop(name, None) is not None:
            return None
        return max((arrived for of, arrived in self.had.values() if of == node), default=None)

    def _make_room(self) -> None:
        least = min(self.receivers, key=lambda name: (self.receivers[name].is_confirmed, self.receivers[name].heard_at))
        self.forget(least)
        self.crowded_out += 1

    # --- who has what ------------------------------------------------------------------------------------------------

    def settled(self, name: str, now: float) -> int:
        """The samples below this number have reached everybody for whom an input of receiver ``name`` waits.

        An input waits for its answers: for its own receiver until that has them, wants no more of them, or is
        forgotten; for any other one while it comes further, since a frozen one must not stop the inputs of the others.
        Where two nodes speak for its own, nobody knows which is right, and each is like any other.
        """
        if self.is_over:
            return self.count
        own = "" if any(one.beside == name for one in self.receivers.values()) else name
        awaited = [one for other, one in self.receivers.items() if one.is_awaited(now, is_own=other == own)]
        is_known = name in self.receivers or name in self.had
        low = self.count if is_known or not self._is_expected(name, now) else 0
        return min((one.arrived for one in awaited), default=low) if low else 0

    def _is_expected(self, name: str, now: float) -> bool:
        expected = self.expected.get(name)
        if expected is None:
            if len(self.expected) >= MAX_RECEIVERS and not self._forget_decided():
                return False
            expected = self.expected[name] = Expected(since=now)
        return not expected.is_decided

    def _forget_decided(self) -> bool:
        """Make room for one more that is expected: relays' lives come and go, and are names of their own."""
        decided = next((name for name, one in self.expected.items() if one.is_decided), None)
        return decided is not None and self.expected.pop(decided) is not None

    def in_doubt(self, now: float) -> tuple[str, ...]:
        """The expected that have said nothing: somebody must see whether they subscribe, and say so (`decide`)."""
        names = []
        for name, one in self.expected.items():
            if not one.is_decided and now - one.since >= LOOK_S:
                one.is_decided = name in self.receivers
                if not one.is_decided:
                    names.append(name)
        return tuple(names)

    def decide(self, name: str, now: float, *, is_there: bool) -> None:
        """Whether an expected one was seen to subscribe; it is waited for no longer than `FORGET_S`."""
        expected = self.expected[name]
        expected.is_decided = not is_there or now - expected.since > FORGET_S

    def give_up(self) -> None:
        """Nobody looks after it any more."""
        self.is_over = True
        for one in self.expected.values():
            one.is_decided = True

    def needs_way(self, name: str) -> bool:
        """Whether it may have to be known if somebody can be reached: it lacks something, or has said nothing yet."""
        receiver = self.receivers.get(name)
        if receiver is not None:
            return receiver.arrived < self.count or (self.end is not None and not receiver.is_ended)
        expected = self.expected.get(name)
        return expected is not None and not expected.is_decided

    # --- time --------------------------------------------------------------------------------------------------------

    def look_after(self, now: float) -> None:
        """Have put again what is late, note who stands still, let go of what nobody will acknowledge."""
        first = self.kept.first(self.count)
        for one in self.receivers.values():
            if self._is_late(one, first, now):
                is_question = not self.is_whole and one.arrived < self.count
                one.wanted = Wanted(self.count, is_question=is_question)
                one.pause_s = min(2 * one.pause_s, MAX_PAUSE_S)
            one.note_debt(self.count, now, has_moved=False)
        self._let_go(now)
        if not self.receivers:
            self.kept.let_go_before(now - FORGET_S)

    def next_deadline(self, now: float) -> float | None:
        """When to look after it again; ``None``: there is nothing left to do."""
        is_told = all(one.is_ended for one in self.receivers.values()) or now - self.ended_at > FORGET_S
        is_at_rest = not self.kept and (self.end is None or is_told)
        return None if is_at_rest else now + TICK_S

    def _is_late(self, receiver: Receiver, first: int, now: float) -> bool:
        if now - receiver.moved_at < receiver.pause_s:
            return False
        if receiver.arrived >= self.count:
            return self.end is not None and not receiver.is_ended and now - self.ended_at > RESEND_S
        at = self.kept.at(receiver.arrived)
        return receiver.arrived < first or (at is not None and now - at > RESEND_S)

    def _let_go(self, now: float) -> None:
        """Of what every receiver that we know of has, once those that we do not know have had time to come."""
        if not self.receivers or (self.began_at is not None and now - self.began_at < NEWCOMERS_S):
            return
        self.kept.let_go(min(one.arrived for one in self.receivers.values()))
