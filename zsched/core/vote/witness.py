"""VOTE, what peers remember of an elector's state: one that is older than that was lost, and is not voted with.

A state folder that is brought back from a backup, or a disk that says it has synced what it has not, forgets promises,
and nothing on that disk shows it. Others have seen more of it. So every elector counts its promises and acceptances;
all nodes ask it, whenever its beats say that the count has risen, and keep what they are answered. An elector that
starts asks them before it votes: who remembers a higher count, or a later life, than its state knows has seen what that
state forgot.

Nothing here rests on a beat: a beat leads to a question at most, and only the answer of whom it was asked is kept, or
believed. What nobody living has seen is not found out (docs/design/failures.md).

Knows: counts, incarnations, who has answered. Does not know: what was voted, how anything is asked.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

from zsched.core.values.messages import Learnt
from zsched.core.values.model import Beat, NodeId
from zsched.core.values.quorum import majority

ASK_ALL_S = 0.5
"""A starting elector waits so long for the answers of all others, and longer only for those of a majority."""


@dataclass(slots=True)
class Witness:
    """What one node has seen of the electors, and whether others have seen more of it than its state knows.

    Args:
        me: this node.
        electors: the configured electors.
        nodes: all nodes of the fleet file.
        incarnation: of this daemon.
        votes: how many promises and acceptances the state knows at the start.
        started_at: monotonic seconds.
        seen: {elector: (incarnation, votes)}, as its own answers said.
    """

    me: NodeId
    electors: tuple[NodeId, ...]
    nodes: frozenset[NodeId]
    incarnation: int
    votes: int
    started_at: float
    seen: dict[NodeId, tuple[int, int]] = field(default_factory=dict)
    _answered: set[NodeId] = field(default_factory=set)
    _has_twin: bool = False
    _at_start: int = field(init=False)

    def __post_init__(self) -> None:
        self._at_start = self.votes

    def may_vote(self, now: float) -> bool:
        """Whether enough of the others have been asked."""
        known = self._answered | {self.me}
        is_enough = len(known.intersection(self.electors)) >= majority(len(self.electors))
        return is_enough and (known == self.nodes or now >= self.started_at + ASK_ALL_S)

    def must_ask(self, beat: Beat) -> bool:
        """Whether a peer has something to answer: it has not been asked in this life, or its count has risen."""
        if self.me in self.electors and beat.node not in self._answered:
            return True
        return beat.node in self.electors and beat.votes > self.seen.get(beat.node, (0, 0))[1]

    def on_twin(self) -> None:
        """Our name lives twice, or did: a later life that a peer remembers may be the other one's.

        One that has cast no vote beyond those of our state forgets nothing of ours.
        """
        self._has_twin = True

    def on_answer(self, learnt: Learnt) -> str:
        """A peer answered our question: keep what it says of itself. Why our state was lost; empty: it was not."""
        self._has_twin |= learnt.node in self._answered and self._is_later(learnt)  # it began after our own start
        self._answered.add(learnt.node)
        if learnt.node in self.electors:
            incarnation, votes = self.seen.get(learnt.node, (0, 0))
            self.seen[learnt.node] = (max(incarnation, learnt.incarnation), max(votes, learnt.votes))
        mine = [(incarnation, votes) for name, incarnation, votes in learnt.seen if name == self.me]
        return next((f"{learnt.node} remembers {why}" for why in map(self._excess, mine) if why), "")

    def _is_later(self, learnt: Learnt) -> bool:
        """Whether a peer remembers a life of this elector behind this one."""
        return any(name == self.me and incarnation > self.incarnation for name, incarnation, _ in learnt.seen)

    def _excess(self, mark: tuple[int, int]) -> str:
        """What a peer remembers of this elector that its state does not know; empty: nothing."""
        incarnation, votes = mark
        if incarnation > self.incarnation and not self._has_twin:
            return f"a later life of this elector ({incarnation}, this is {self.incarnation})"
        # A peer keeps the highest of both, so a twin's life is told with the votes that this one has cast.
        known = self.votes if incarnation >= self.incarnation else self._at_start
        return f"{votes} votes of this elector, its state knows of {known}" if votes > known else ""


def as_tuple(seen: dict[NodeId, tuple[int, int]]) -> tuple[tuple[NodeId, int, int], ...]:
    """As it is told and written.

    >>> as_tuple({"robot2": (8, 120), "robot1": (7, 3)})
    (('robot1', 7, 3), ('robot2', 8, 120))
    """
    return tuple((name, *mark) for name, mark in sorted(seen.items()))


def as_seen(told: Iterable[tuple[NodeId, int, int]]) -> dict[NodeId, tuple[int, int]]:
    """The reverse of `as_tuple`."""
    return {name: (incarnation, votes) for name, incarnation, votes in told}
