"""What a hostile network makes of one frame: copies, late ones, old ones again, damaged and forged ones.

Knows: frames and the events they become; the production codec decides what is a frame. Does not know: which nodes are
up, when anything arrives, cuts (the simulator's).

A frame that was damaged and still reads as *another* valid value is not delivered: that takes an insider's key, and
against insiders zsched does not protect (docs/design/failures.md).
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from random import Random
from typing import Any

from zsched.core.values import codec as wire
from zsched.core.values import events as ev
from zsched.core.values.errors import InvariantError, WireError
from zsched.core.values.messages import Ballots, Votes, fleet_answer
from zsched.core.values.model import Ballot, NodeId
from zsched.core.values.struct import replace
from zsched_lab.sim.checks import FORGED

GHOST = "ghost"
"""A name that no fleet file holds: its sender is a stranger."""
SENDER_FIELDS = ("node", "voter", "elector")
KEPT = 300


@dataclass(frozen=True, slots=True)
class Message:
    """Something on its way: the event it becomes, and its bytes (none: the question has no payload)."""

    event: ev.Event
    frame: bytes = b""
    kind: type[Any] = object


@dataclass(slots=True, kw_only=True)
class Weather:
    """Chances per message, each in [0, 1]; ``spike_s`` is the longest extra delay, ``foreign_version`` speaks v2."""

    duplicate: float = 0.0
    spike: float = 0.0
    spike_s: float = 0.0
    mutate: float = 0.0
    forge: float = 0.0
    replay: float = 0.0
    foreign_version: set[NodeId] = field(default_factory=set)
    counts: Counter[str] = field(default_factory=Counter)
    _past: deque[tuple[NodeId, NodeId, Message]] = field(default_factory=lambda: deque(maxlen=KEPT))

    @property
    def is_calm(self) -> bool:
        """Whether every message arrives once, whole and on time."""
        return not (self.duplicate or self.spike or self.mutate or self.forge or self.replay or self.foreign_version)

    def calm(self) -> None:
        """The faults end; what is on its way still arrives."""
        self.duplicate = self.spike = self.mutate = self.forge = self.replay = 0.0
        self.foreign_version.clear()

    def through(
        self, source: NodeId, target: NodeId, message: Message, rng: Random
    ) -> list[tuple[NodeId, NodeId, float, ev.Event]]:
        """(from, to, extra delay, event) of everything that reaches somebody because of this one message."""
        if message.frame and (source in self.foreign_version) != (target in self.foreign_version):
            return [(source, target, 0.0, self._of_version_2(message))]
        out = [(source, target, self._late(rng), self._damaged(message, rng))]
        if rng.random() < self.duplicate:
            self.counts["duplicated"] += 1
            out.append((source, target, self._late(rng) + rng.uniform(0.0, 0.05), message.event))
        if rng.random() < self.replay and self._past:
            self.counts["replayed"] += 1
            old = rng.choice(self._past)
            out.append((old[0], old[1], 0.0, old[2].event))
        if message.frame and rng.random() < self.forge:
            self.counts["forged"] += 1
            out.append((source, target, 0.0, forge(message, rng)))
        self._past.append((source, target, message))
        return out

    def _late(self, rng: Random) -> float:
        if rng.random() >= self.spike:
            return 0.0
        self.counts["late"] += 1
        return rng.uniform(0.0, self.spike_s)

    def _of_version_2(self, message: Message) -> ev.Event:
        """The same frame as a later version would stamp it: read by the production codec, which must refuse it."""
        self.counts["foreign version"] += 1
        frame = message.frame[:1] + b"\x02" + message.frame[2:]
        event = read(frame, message.kind, lambda _: message.event)
        if event is message.event:
            raise InvariantError(f"a frame of version 2 was read as {message.kind.__name__}")
        return event

    def _damaged(self, message: Message, rng: Random) -> ev.Event:
        if not message.frame or rng.random() >= self.mutate:
            return message.event
        self.counts["damaged"] += 1
        dropped = ev.FrameDropped(kind="damaged", reason="other")
        value = wire.decode(message.frame, message.kind)
        return read(mutated(message.frame, rng), message.kind, lambda v: message.event if v == value else dropped)


def read(frame: bytes, kind: type[Any], make: Callable[[Any], ev.Event]) -> ev.Event:
    """What a receiver makes of bytes; anything but a `WireError` that escapes is a violation."""
    try:
        value = wire.decode(frame, kind)
    except WireError as error:
        return ev.FrameDropped(kind=kind.__name__.lower(), reason=error.reason)
    except Exception as error:
        raise InvariantError(f"decode of {frame[:80]!r} raised {error!r}") from error
    return make(value)


def mutated(frame: bytes, rng: Random) -> bytes:
    """A frame with one to three bytes flipped, removed, repeated or cut off."""
    body = bytearray(frame)
    for _ in range(rng.randint(1, 3)):
        if not body:
            break
        at, how = rng.randrange(len(body)), rng.random()
        if how < 0.6:
            body[at] ^= 1 << rng.randrange(8)
        elif how < 0.7:
            body[at] = rng.randrange(256)
        elif how < 0.8:
            del body[at]
        elif how < 0.9:
            body[at:at] = body[at : at + rng.randint(1, 8)]
        else:
            del body[at:]
    return bytes(body)


FAR = (1, 3, 12, 1000, 10**9, 2**52)
"""How far ahead a forged number is: within the window of honest ones, and beyond it."""


def forge(message: Message, rng: Random) -> ev.Event:
    """A stranger's message: the same one in a name that the fleet does not know, or a valid one in its sender's name.

    The bus compares a value's sender with its key: under another key it ends there.
    """
    value, event = wire.decode(message.frame, message.kind), message.event
    if isinstance(event, ev.PrepareAsked | ev.AcceptAsked):
        return _forged_question(event, rng)
    if isinstance(event, ev.BallotsAsked):
        return _forged_ballots(event, rng)
    if isinstance(event, ev.VotesReceived):
        return _forged_votes(event, rng)
    if rng.random() < 0.5 and (forged := _in_its_name(event, rng)) is not None:
        return forged
    if rng.random() < 0.3:
        return ev.FrameDropped(kind=message.kind.__name__.lower(), reason="foreign")
    sender = next(name for name in SENDER_FIELDS if hasattr(value, name))
    other = replace(value, **{sender: GHOST})
    slot = next(name for name in type(event).__dataclass_fields__ if getattr(event, name) == value)
    return replace(event, **{slot: other})


def _in_its_name(event: ev.Event, rng: Random) -> ev.Event | None:
    """What anybody can put under the sender's own key; ``None``: such a thing is only an answer.

    It says nothing about leases: who forges grants is an insider.
    """
    if isinstance(event, ev.BeatReceived):
        beat = event.beat
        learnt = tuple((task, min(revision + rng.choice(FAR), 2**53), epoch) for task, revision, epoch in beat.learnt)
        life, number = _ahead(beat.incarnation, beat.sequence, rng)
        beat = replace(beat, incarnation=life, sequence=number, learnt=learnt, has_voted=True)
        return ev.BeatReceived(beat=replace(beat, suspects=(), echoes=(), released=(), asked_to_leave=()))
    if isinstance(event, ev.ProfileReceived):
        life, number = _ahead(event.profile.incarnation, event.profile.sequence, rng)
        return ev.ProfileReceived(profile=replace(event.profile, incarnation=life, sequence=number))
    if isinstance(event, ev.LearntReceived):
        values = tuple(
            replace(value, revision=number, epoch=number, owner=GHOST)
            for value in event.learnt.values
            for number in (min(value.revision + rng.choice(FAR), 2**53),)
        )
        learnt_by = replace(event.learnt, values=values)
        return ev.LearntReceived(learnt=learnt_by, is_answer=rng.random() < 0.5)
    return None


def _ahead(life: int, number: int, rng: Random) -> tuple[int, int]:
    """(incarnation, sequence) of a forged message: of the same life, or of another one."""
    if rng.random() < 0.3:
        return min(life + rng.choice(FAR), 2**53), rng.choice(FAR)
    return life, min(number + rng.choice(FAR), 2**53)


def _forged_question(event: ev.PrepareAsked | ev.AcceptAsked, rng: Random) -> ev.Event:
    """A ballot that is not its asker's, or that of a stranger, with a high counter."""
    asker = GHOST if rng.random() < 0.5 else event.asker
    if isinstance(event, ev.PrepareAsked):
        node = GHOST if asker == GHOST else _other(event.prepare.ballot.node)
        prepare = replace(event.prepare, ballot=_high(event.prepare.ballot, node))
        return ev.PrepareAsked(request=FORGED, asker=asker, prepare=prepare)
    acceptance = event.accept.acceptance
    node = GHOST if asker == GHOST else _other(acceptance.ballot.node)
    value = replace(acceptance.value, revision=acceptance.value.revision + 1)
    accept = replace(event.accept, acceptance=replace(acceptance, ballot=_high(acceptance.ballot, node), value=value))
    return ev.AcceptAsked(request=FORGED, asker=asker, accept=accept)


def _forged_ballots(event: ev.BallotsAsked, rng: Random) -> ev.Event:
    """Such questions, all in one frame, and with them the word of a fleet value that nobody has chosen."""
    told = event.ballots.fleet
    forged = [
        *(
            _forged_question(ev.PrepareAsked(request=FORGED, asker=event.asker, prepare=one), rng)
            for one in event.ballots.prepares
        ),
        *(
            _forged_question(ev.AcceptAsked(request=FORGED, asker=event.asker, accept=one), rng)
            for one in event.ballots.accepts
        ),
    ]
    ballots = Ballots(
        prepares=tuple(one.prepare for one in forged if isinstance(one, ev.PrepareAsked)),
        accepts=tuple(one.accept for one in forged if isinstance(one, ev.AcceptAsked)),
        fleet=None if told is None else replace(told, revision=min(told.revision + rng.choice(FAR), 2**53)),
    )
    return ev.BallotsAsked(request=FORGED, asker=GHOST if rng.random() < 0.5 else event.asker, ballots=ballots)


def _forged_votes(event: ev.VotesReceived, rng: Random) -> ev.Event:
    """A stranger's answers, or what the bus makes of them under another's key."""
    if rng.random() < 0.3:
        return ev.FrameDropped(kind="votes", reason="foreign")
    votes = event.votes
    return ev.VotesReceived(
        votes=Votes(
            promises=tuple(replace(one, elector=GHOST) for one in votes.promises),
            accepted=tuple(replace(one, elector=GHOST) for one in votes.accepted),
            refused=tuple(replace(one, elector=GHOST) for one in votes.refused),
            ahead=None if votes.ahead is None else fleet_answer(replace(votes.ahead.content, elector=GHOST)),
        )
    )


def _other(node: NodeId) -> NodeId:
    return f"{node}x"


def _high(ballot: Ballot, node: NodeId) -> Ballot:
    return replace(ballot, counter=ballot.counter + 1000, node=node)
