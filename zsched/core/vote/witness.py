"""VOTE, peers' memory of an elector: a state that is older than peers have seen was lost, and must not vote.

A folder that comes back from a backup, or a disk that lies about its sync, forgets promises, and nothing on that disk
shows it. But other nodes have seen more of that state. So every elector counts its promises and acceptances. All nodes
ask it whenever its beats show a higher count, and keep its answers. A starting elector asks them before it votes. A
node that remembers a higher count, or a later life, has seen what this state forgot.

A beat leads to a question at most. Only the answer of the node that was asked is kept, or believed. Votes that no
living node has seen are not found out (docs/design/failures.md).

Knows: counts, incarnations, which peers have answered. Does not know: the votes' content, how a node is asked.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

from zsched.core.values.beat import Beat
from zsched.core.values.in_force import InForce
from zsched.core.values.messages import Learnt
from zsched.core.values.model import NodeId
from zsched.core.values.quorum import majority

ASK_ALL_S = 0.5
"""A starting elector waits this long for the answers of all others, and longer only for those of a majority."""


@dataclass(slots=True)
class Witness:
    """One node's memory of the electors, and the others' memory of this elector.

    Args:
        me: this node.
        electors: the configured electors.
        in_force: the fleet, for its nodes.
        incarnation: of this daemon.
        votes: the state's count of promises and acceptances at the start.
        started_at: monotonic seconds.
        seen: {elector: (incarnation, votes)}, from their own answers.
    """

    me: NodeId
    electors: tuple[NodeId, ...]
    in_force: InForce
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
        return is_enough and (known == self.in_force.nodes.keys() or now >= self.started_at + ASK_ALL_S)

    def has_asked(self, peer: NodeId) -> bool:
        """Whether this node has asked a peer in this life, as an elector has to before it votes."""
        return self.me not in self.electors or peer in self._answered

    def must_ask(self, beat: Beat) -> bool:
        """Whether to ask a peer: it was not asked in this life, or its count has risen."""
        if not self.has_asked(beat.node):
            return True
        return beat.node in self.electors and beat.votes > self.seen.get(beat.node, (0, 0))[1]

    def on_twin(self) -> None:
        """Our name lives twice, or did: a later life in a peer's memory may be the other one's.

        If that life has no more votes than our state knows, our state has forgotten nothing.
        """
        self._has_twin = True

    def on_answer(self, learnt: Learnt) -> str:
        """A peer answered: keep its word about itself. Why our state was lost; empty: it was not."""
        self._has_twin |= learnt.node in self._answered and self._is_later(learnt)  # it began after our own start
        self._answered.add(learnt.node)
        if learnt.node in self.electors:
            incarnation, votes = self.seen.get(learnt.node, (0, 0))
            self.seen[learnt.node] = (max(incarnation, learnt.incarnation), max(votes, learnt.votes))
        mine = [(incarnation, votes) for name, incarnation, votes in learnt.seen if name == self.me]
        return next((f"{learnt.node} remembers {why}" for why in map(self._excess, mine) if why), "")

    def _is_later(self, learnt: Learnt) -> bool:
        """Whether a peer remembers a later life of this elector."""
        return any(name == self.me and incarnation > self.incarnation for name, incarnation, _ in learnt.seen)

    def _excess(self, mark: tuple[int, int]) -> str:
        """What a peer remembers beyond our state, in words; empty: nothing."""
        incarnation, votes = mark
        if incarnation > self.incarnation and not self._has_twin:
            return f"a later life of this elector ({incarnation}, this is {self.incarnation})"
        # A peer keeps the highest of both, so a twin's life is told with the votes that this one has cast.
        known = self.votes if incarnation >= self.incarnation else self._at_start
        return f"{votes} votes of this elector, its state knows of {known}" if votes > known else ""


def as_tuple(seen: dict[NodeId, tuple[int, int]]) -> tuple[tuple[NodeId, int, int], ...]:
    """The memory in the form of messages and of the state file.

    >>> as_tuple({"robot2": (8, 120), "robot1": (7, 3)})
    (('robot1', 7, 3), ('robot2', 8, 120))
    """
    return tuple((name, *mark) for name, mark in sorted(seen.items()))


def as_seen(told: Iterable[tuple[NodeId, int, int]]) -> dict[NodeId, tuple[int, int]]:
    """The reverse of `as_tuple`."""
    return {name: (incarnation, votes) for name, incarnation, votes in told}
