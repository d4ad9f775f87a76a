"""Electors by themselves: which elector is removed, which node is added, which robots are away; at most one at a time.

Knows: what this node has heard in beats, what other electors think, the fleet value. Does not know: rounds
(`zsched.core.electorate.roll`), what an operator wants beyond the `Course`.

* *Gone*: no beat with an elector's name *and disk* for the silence T. One name on two machines is thus no news, and a
  lost disk is another member.
* An elector is removed when a majority of the electors takes it for gone: one deaf link, or a node that has slept,
  throws nobody out. A node that has itself paused begins to listen anew.
* Remove first, then add. A node is added only with room: the electors that are alive now are a majority of the
  enlarged electorate even if the new one never answers. From one to two there is never such room. A single elector
  takes a second one all the same when a third one is fit, too: the aim is odd, so the third follows at once.
* A candidate has been heard without a break for `STEADY` times T, and shows the present number. It is added with the
  disk of its newest beat.
* Two electors are no better than three of which one is gone: so the third goes only when a spare is there. Two never
  become one but by a leave, for a majority of two is both. The last one stays.
* A leaver is removed once those that are heard without it, within the time in which silence is no suspicion, are a
  majority of the electors that stay: else whoever is gone is replaced first. A single elector that leaves takes a
  second one, if one is fit, and goes then.
* A leaver stays until it has learnt a settled value without it (`may_go`).
* The aim is an odd number, at most `TARGET`, of robots and edges alike, of those the steadiest.
* Robots that a majority of the electors has not heard for long are *away*; they are back when it hears them.

Any elector may propose, each at its own time. Several that propose the same do no harm: one change is chosen.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property

from zsched.core.electorate.changes import AddElector, FleetChange, RemoveElector, SetAway
from zsched.core.values.electorate import Elector, FleetValue
from zsched.core.values.model import NodeId, NodeKind
from zsched.core.values.quorum import majority
from zsched.core.values.struct import Struct, replace

TARGET = 5
"""How many electors a fleet has at most by itself."""
STEADY = 4.0
"""A node that becomes an elector has been heard without a break for this many times `replace_s`."""
PAUSE_SHARE = 0.5
"""A node that has not looked for this share of the silence has paused itself: it listens anew."""


class Course(Struct, frozen=True, kw_only=True, dict=True):
    """What the document says about electors and robots."""

    members: tuple[tuple[NodeId, NodeKind], ...]
    """Every node of the document, sorted by name."""
    is_auto: bool
    """Whether electors are replaced by themselves; otherwise the operator has named them, and they stay."""
    silence_s: float
    """T: an elector that is not heard for this long is gone (seconds, > 0)."""
    suspect_s: float
    """A node that is not heard for this long may be gone (seconds, > 0)."""
    away_s: float
    """A robot that is not heard for this long does not vote (seconds, >= ``silence_s``)."""
    leaving: tuple[NodeId, ...] = ()
    """Nodes that an operator takes out of the fleet."""

    @property
    def fresh_s(self) -> float:
        """Whoever was heard within this time is surely there: a leave counts on it, and it may become an elector."""
        return min(self.silence_s, self.suspect_s)

    @cached_property
    def names(self) -> tuple[NodeId, ...]:
        """All nodes."""
        return tuple(name for name, _ in self.members)

    @cached_property
    def robots(self) -> tuple[NodeId, ...]:
        """The nodes that vote, sorted."""
        return tuple(name for name, kind in self.members if kind is NodeKind.ROBOT)


class Word(Struct, frozen=True, kw_only=True):
    """What one beat says to the pilot."""

    node: NodeId
    disk: str
    """Id of the disk with which its sender may elect; empty: it has none."""
    is_current: bool
    """It shows the generation and the number by which this node counts."""
    gone: tuple[NodeId, ...] = ()
    """Electors that its sender takes for gone."""
    away: tuple[NodeId, ...] = ()
    """Robots that its sender takes for away."""
    may_return: bool = False
    """Its sender has lost what belongs to its seat, and can be added anew once that is given up."""


class Advice(Struct, frozen=True, kw_only=True):
    """What is to be done now, or why nothing is."""

    change: FleetChange | None
    reason: str


class _Peer(Struct):
    """One name: its newest word, and since when it has been heard with that disk without a break."""

    word: Word
    at: float
    since: float


@dataclass(slots=True)
class Pilot:
    """One node's ear for electors and robots.

    Args:
        me: this node.
        disk: id of its disk, if it may elect.
        now: monotonic seconds.
    """

    me: NodeId
    disk: str
    now: float
    advice: Advice = Advice(change=None, reason="")
    """The newest, for the status."""
    _listens_since: float = field(init=False)
    _peers: dict[NodeId, _Peer] = field(default_factory=dict)
    _seats: dict[Elector, float] = field(default_factory=dict)
    """{seat: when it was last heard with its disk}; a seat that is new counts as heard."""
    _wish: FleetChange | None = None
    _due: float = math.inf

    def __post_init__(self) -> None:
        self._listens_since = self.now

    # --- what is heard -----------------------------------------------------------------------------------------------

    def hear(self, word: Word, value: FleetValue, course: Course, now: float) -> None:
        """A peer's newest beat has come."""
        self._look(value, course, now)
        peer = self._peers.get(word.node)
        if peer is None or peer.word.disk != word.disk or now - peer.at >= course.silence_s:
            self._peers[word.node] = _Peer(word=word, at=now, since=now)
        else:
            peer.word, peer.at = word, now
        seat = value.electorate.seat(word.node)
        if seat is not None and _answers(seat, word):
            self._seats[seat] = now

    def _look(self, value: FleetValue, course: Course, now: float) -> None:
        """Time has passed, and the electors may be others."""
        if now - self.now > PAUSE_SHARE * course.silence_s:
            self._listens_since = now
        self.now = now
        if tuple(self._seats) != value.electors:
            self._seats = {seat: self._seats.get(seat, now) for seat in value.electors}
        for name in [name for name in self._peers if name not in course.names]:
            if value.electorate.seat(name) is None:
                del self._peers[name]

    # --- this node's opinion, for its beats --------------------------------------------------------------------------

    def gone(self, value: FleetValue, course: Course, now: float) -> tuple[NodeId, ...]:
        """The electors that this node takes for gone, sorted."""
        self._look(value, course, now)
        return tuple(seat.name for seat in value.electors if self._silence(seat, now) >= course.silence_s)

    def away(self, value: FleetValue, course: Course, now: float) -> tuple[NodeId, ...]:
        """The robots that this node takes for away, sorted; whoever is away already is so until it is heard."""
        self._look(value, course, now)
        return tuple(name for name in course.robots if name != self.me and self._is_away(name, value, course, now))

    def _is_away(self, name: NodeId, value: FleetValue, course: Course, now: float) -> bool:
        peer = self._peers.get(name)
        heard_at = -math.inf if peer is None else peer.at
        if name in value.away:
            return now - heard_at >= course.silence_s
        return now - max(heard_at, self._listens_since) >= course.away_s

    def _silence(self, seat: Elector, now: float) -> float:
        if seat.name == self.me:
            return 0.0 if seat.is_held_by(self.me, self.disk) and self.disk else math.inf
        return now - max(self._seats[seat], self._listens_since)

    # --- what is to be done ------------------------------------------------------------------------------------------

    def tick(
        self, value: FleetValue, course: Course, now: float, *, stagger_s: float, is_busy: bool
    ) -> FleetChange | None:
        """The change to propose now, if it is this node's turn; `advice` says why, or why there is none.

        Args:
            value: learnt.
            course: the document's.
            now: monotonic seconds.
            stagger_s: how much later than the one before each elector proposes (seconds).
            is_busy: a change of this node's is under way.
        """
        self.advice = self.advise(value, course, now)
        wish, before = self.advice.change, self._wish
        self._wish = wish
        if wish is None or is_busy or not _is_same(wish, before):
            self._due = now + stagger_s * self._rank(value, course, now)
        if wish is None or is_busy or now < self._due:
            return None
        self._due = now + stagger_s * (1 + len(value.electors))  # it may have been lost: once more
        return wish

    def advise(self, value: FleetValue, course: Course, now: float) -> Advice:
        """What any elector with these beats would do."""
        self._look(value, course, now)
        seat = value.electorate.seat(self.me)
        if not value.document:
            return _none("no document is agreed yet")
        if seat is None or not self.disk or not seat.is_held_by(self.me, self.disk):
            return _none("this node is no elector")
        if value.settled:
            advice = self._elect(value, course, now)
            if advice.change is not None:
                return advice
        else:
            advice = _none(f"number {value.number} is not settled")
        away = self._mark(value, course, now)
        return advice if away is None else Advice(change=away, reason=away.reason)

    def _elect(self, value: FleetValue, course: Course, now: float) -> Advice:
        if not course.is_auto:
            return _none("the operator has named the electors")
        lost = self._removable(value, course, now)
        if lost is not None and lost.change is not None:
            return lost
        added = self._addable(value, course, now)
        return lost if lost is not None and added.change is None else added

    def _removable(self, value: FleetValue, course: Course, now: float) -> Advice | None:
        """The elector to remove, or why one that is gone stays; ``None``: all are there."""
        names, count = value.electorate.names, len(value.electors)
        members = {name for name, _ in course.members}
        leaver = next((name for name in names if name in course.leaving or name not in members), None)
        told = []
        if leaver is not None:
            if count == 1:
                return _none(f"{leaver} is the last elector, and stays")
            staying = [name for name in self._alive(value, course, now, course.fresh_s) if name != leaver]
            if len(staying) >= majority(count - 1):
                return _remove(value, leaver, "it leaves")
            told.append(f"{leaver} leaves when {majority(count - 1)} of the other electors are alive")
        opinions = {name: self._who_miss(name, value, course, now) for name in names}
        needed = majority(count)
        lost = next((name for name in names if len(opinions[name]) >= needed), None)
        if lost is None:
            doubted = [f"{name} is gone for {', '.join(who)}" for name, who in opinions.items() if who]
            told += [f"{'; '.join(doubted)}: {needed} electors must say so"] if doubted else []
            return _none("; ".join(told)) if told else None
        if count == 3 and not self._fit(value, course, now, instead=lost):
            why = f"{lost} is gone, and no node is fit to follow it: two electors are no better than three"
            return _none("; ".join([*told, f"{why}; start it again, or bring another node"]))
        return _remove(value, lost, f"gone for {', '.join(opinions[lost])}")

    def _who_miss(self, name: NodeId, value: FleetValue, course: Course, now: float) -> list[NodeId]:
        """The electors that take this one for gone."""
        own = [self.me] if name in self.gone(value, course, now) else []
        others = [one for one, word in self._electors_heard(value, course, now) if name in word.gone and one != name]
        return sorted(own + others)

    def _electors_heard(self, value: FleetValue, course: Course, now: float) -> list[tuple[NodeId, Word]]:
        """The newest words of the other electors that are alive and count as this node does."""
        words = ((name, self._peers[name].word) for name in self._alive(value, course, now) if name != self.me)
        return [(name, word) for name, word in words if word.is_current]

    def _alive(self, value: FleetValue, course: Course, now: float, within_s: float | None = None) -> list[NodeId]:
        """The electors that this node hears, itself included; who was never heard is not, however new its seat is.

        ``within_s``: seconds since they were; ``None``: less than the silence after which they are gone.
        """
        silence_s, heard = course.silence_s if within_s is None else within_s, []
        for seat in value.electors:
            peer = self._peers.get(seat.name)
            if peer is not None and now - peer.at < silence_s and _answers(seat, peer.word):
                heard.append(seat.name)
        return sorted({*heard, self.me})

    def _rank(self, value: FleetValue, course: Course, now: float) -> int:
        """This node's turn among the electors that it hears; they take turns by the value's revision."""
        alive = self._alive(value, course, now)
        return (alive.index(self.me) + value.revision) % len(alive)

    def _fit(self, value: FleetValue, course: Course, now: float, instead: NodeId = "") -> list[NodeId]:
        """Nodes that may be added, the best first; ``instead`` of an elector that goes.

        That elector itself is one of them if it is there with another disk, or without what belongs to its seat.
        """
        kinds = dict(course.members)
        kept = [name for name in value.electorate.names if name != instead]
        found = []
        for name, kind in course.members:
            peer = self._peers.get(name)
            if peer is None or name in kept or name in course.leaving:
                continue
            if not peer.word.disk and not (name == instead and peer.word.may_return):
                continue
            # fresh: else it may be gone, and a command have just removed it
            is_steady = now - peer.at < course.fresh_s and now - peer.since >= STEADY * course.silence_s
            if is_steady and peer.word.is_current:
                alike = sum(kinds.get(other) is kind for other in kept)
                found.append((alike, peer.since, name))
        return [name for _, _, name in sorted(found)]

    def _addable(self, value: FleetValue, course: Course, now: float) -> Advice:
        count = len(value.electors)
        alive, fit = self._alive(value, course, now), self._fit(value, course, now)
        aim = min(TARGET, _odd(len(alive) + len(fit)))
        is_handed_on = count == 1 and value.electorate.names[0] in course.leaving
        if not fit or (count >= aim and not is_handed_on):
            return _none(f"{count} electors, {len(alive)} alive, {len(fit)} more could be one")
        if count > 1 and len(alive) < majority(count + 1):
            return _none(f"no room for {fit[0]}: {len(alive)} of then {count + 1} electors are sure to answer")
        name = fit[0]
        reason = f"{name} becomes an elector: heard without a break for {now - self._peers[name].since:.0f} s"
        disk = self._peers[name].word.disk
        change = AddElector(base_revision=value.revision, name=name, disk=disk, reason=reason)
        return Advice(change=change, reason=reason)

    def _mark(self, value: FleetValue, course: Course, now: float) -> SetAway | None:
        """Robots that a majority of the electors takes for away, or for back."""
        needed = majority(len(value.electors))
        lists = [self.away(value, course, now)]
        lists += [word.away for _, word in self._electors_heard(value, course, now)]
        away = []
        for name in course.robots:
            count = sum(name in one for one in lists)
            is_back = len(lists) - count >= needed
            if count >= needed or (name in value.away and not is_back):
                away.append(name)
        if tuple(away) == value.away:
            return None
        return SetAway(base_revision=value.revision, away=tuple(away), reason=_change_text(value.away, away))


def may_go(value: FleetValue, me: NodeId) -> bool:
    """Whether a node that leaves may stop: the electors are settled without it."""
    return value.settled and value.electorate.seat(me) is None


def _is_same(change: FleetChange, other: FleetChange | None) -> bool:
    """Whether two changes differ at most in their reasons: those tell how long, and of whom, and both go on."""
    return other is not None and replace(change, reason=other.reason) == other


def _answers(seat: Elector, word: Word) -> bool:
    """Whether a beat is of the node that holds this seat."""
    return word.disk != "" and seat.is_held_by(word.node, word.disk)


def _odd(count: int) -> int:
    return count - 1 + count % 2


def _none(reason: str) -> Advice:
    return Advice(change=None, reason=reason)


def _remove(value: FleetValue, name: NodeId, why: str) -> Advice:
    reason = f"{name} is removed as an elector: {why}"
    return Advice(change=RemoveElector(base_revision=value.revision, name=name, reason=reason), reason=reason)


def _change_text(before: Iterable[NodeId], after: Iterable[NodeId]) -> str:
    gone, back = sorted(set(after) - set(before)), sorted(set(before) - set(after))
    parts = [f"{', '.join(gone)} away"] if gone else []
    parts += [f"{', '.join(back)} back"] if back else []
    return f"robots that do not vote: {'; '.join(parts)}"
