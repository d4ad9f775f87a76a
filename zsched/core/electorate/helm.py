"""The pilot of a node at work: what it hears of beats, what its own beats say, which change it proposes.

Knows: the learnt fleet value, the document in force, which beats count. Does not know: the pilot's rules
(`zsched.core.electorate.pilot`), how a change is agreed (`zsched.core.electorate.numbers`).
"""

from __future__ import annotations

from collections.abc import Callable

from zsched.core.electorate.numbers import Numbers
from zsched.core.electorate.pilot import Course, Pilot, Word
from zsched.core.values import instructions as do
from zsched.core.values.beat import Beat
from zsched.core.values.document import Flag, FlagKind
from zsched.core.values.electorate import FleetValue
from zsched.core.values.fleet import Fleet, Timing
from zsched.core.values.model import NodeId
from zsched.core.values.todo import ToDo

STAGGER_BALLOTS = 2
"""Each elector proposes a change of the electors so many times ``ballot_s`` after the one before."""
_NOBODY: tuple[NodeId, ...] = ()


class Helm:
    """One node's pilot, at its numbers; without an agreed document it rests.

    Args:
        numbers: this node's.
        me: this node.
        clocks: those in force; each elector proposes so many times a ballot's deadline later than the one before
            (`STAGGER_BALLOTS`).
        now: monotonic seconds.
    """

    def __init__(self, numbers: Numbers, me: NodeId, *, clocks: Callable[[], Timing], now: float) -> None:
        self._numbers, self._me, self._clocks = numbers, me, clocks
        self._pilot = Pilot(me=me, disk="", now=now)
        self._told: FleetValue | None = None
        """The value whose electors the decision log has."""
        self._read: tuple[str, Course | None] = "", None
        """(document, what it says)."""

    @property
    def reason(self) -> str:
        """What the pilot does, or why it does nothing; empty: it rests."""
        return self._pilot.advice.reason

    def hear(self, beat: Beat, now: float, *, is_current: bool) -> None:
        """A peer's newest beat; ``is_current``: its sender counts by this node's generation and number."""
        value = self._numbers.changed
        course = None if value is None else self._course(value)
        if value is not None and course is not None:
            word = Word(
                node=beat.node,
                disk=beat.disk,
                is_current=is_current,
                gone=beat.gone,
                away=beat.away,
                may_return=beat.may_return,
            )
            self._pilot.hear(word, value, course, now)

    def opinion(self, disk: str, now: float) -> tuple[tuple[NodeId, ...], tuple[NodeId, ...]]:
        """(electors that are gone, robots that are away) in the opinion of this node, for its next beat.

        ``disk``: id of the disk with which this node may elect; empty: it may not.
        """
        self._pilot.disk = disk
        value = self._numbers.changed
        course = None if value is None else self._course(value)
        seat = None if value is None else value.electorate.seat(self._me)
        if value is None or course is None or seat is None or not disk or not seat.is_held_by(self._me, disk):
            return _NOBODY, _NOBODY
        return self._pilot.gone(value, course, now), self._pilot.away(value, course, now)

    def tick(self, todo: ToDo, now: float) -> None:
        """Time has passed: propose what is due, if it is this node's turn."""
        value, roll = self._numbers.changed, self._numbers.roll
        if value is None or roll is None:
            return
        self._tell(value, todo)
        course = self._course(value)
        if course is None or not roll.is_elector:
            return
        change = self._pilot.tick(
            value, course, now, stagger_s=STAGGER_BALLOTS * self._clocks().ballot_s, is_busy=roll.is_busy
        )
        if change is not None:
            self._numbers.propose(change, todo, now)

    def _course(self, value: FleetValue) -> Course | None:
        """What the document in force says; ``None``: it is not stored here."""
        document, course = self._read
        if document != value.document or course is None:
            fleet = self._numbers.documents.fleet(value.document)
            flags = self._numbers.documents.flags(value.document)
            course = None if fleet is None else course_of(fleet, flags)
            self._read = value.document, course
        return course

    def _tell(self, value: FleetValue, todo: ToDo) -> None:
        """Write down who elects now, and who does not any more."""
        before, self._told = self._told, value
        if before is None or before is value:
            return
        was, names = before.electorate.names, value.electorate.names
        parts = [f"{name} is no elector any more" for name in was if name not in names]
        parts += [f"{name} is an elector" for name in names if name not in was]
        parts += [f"{name} is away and does not vote" for name in value.away if name not in before.away]
        parts += [f"{name} is back and votes" for name in before.away if name not in value.away]
        if parts:
            text = f"number {value.number}: {'; '.join(parts)} (electors: {', '.join(names)})"
            todo.add(do.RecordStory(stage="vote", text=text))


def course_of(fleet: Fleet, flags: tuple[Flag, ...] = ()) -> Course:
    """What a document says about electors and robots."""
    return Course(
        members=tuple((node.name, node.kind) for node in fleet.nodes),
        is_auto=fleet.is_auto,
        silence_s=fleet.replace_s,
        suspect_s=fleet.timing.suspect_s,
        away_s=fleet.away_s,
        leaving=tuple(flag.subject for flag in flags if flag.kind is FlagKind.LEAVE),
    )


def voters(fleet: Fleet, value: FleetValue | None) -> tuple[NodeId, ...]:
    """The robots that count in votes: those that are not away; all of them when none would be left."""
    away = () if value is None else value.away
    return tuple(name for name in fleet.voters if name not in away) or fleet.voters
