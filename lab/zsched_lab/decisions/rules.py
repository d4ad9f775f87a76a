"""The rules that are compared: zsched's own judges, the paper's schemes, and yardsticks without any view.

Knows: when each rule looks, and which node it then chooses. Does not know: the truth, what a choice is worth.

`CoreRule` is the production's decision: `zsched.core.scheduler.decision` at each robot, a called vote, the tally, the
bound on moves. It does what `zsched.core.scheduler.rounds` does when no message is lost;
`tests/unit/lab/decisions/test_same_as_nodes.py` holds the two together.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from random import Random
from typing import Protocol

from zsched.core.scheduler.decision import decide_by, rules_of
from zsched.core.scheduler.fuse import Fuse
from zsched.core.scheduler.judge import Judge, Judgement, Outcome
from zsched.core.scheduler.standing import Standing, pick
from zsched.core.values.decision import Figures, Rules
from zsched.core.values.fleet import TaskSpec
from zsched.core.values.model import Allocation, NodeId, PeerState, Proposal, ScoreForm, Tuning
from zsched.core.vote.tally import VoteOutcome, tally
from zsched_lab.decisions.view import Sight

COMMIT_S = 0.03
"""From the vote to the commit; measured on loopback (`benchmarks.commit`)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Move:
    """An allocation: at ``at_s`` of the history ``owner`` gets the task, from ``left`` (``None``: the first)."""

    at_s: float
    owner: NodeId
    left: NodeId | None
    is_escape: bool = False


class Rule(Protocol):
    """What the replay drives: it calls `round` whenever a robot's round is due."""

    moves: list[Move]

    def round(self, seats: tuple[int, ...], at_s: float, now: float) -> None:
        """The robots ``seats`` have a round now (none of them: only timers that the rule set itself may be due)."""
        ...


@dataclass(slots=True)
class CoreRule:
    """The production's decision under some tuning."""

    view: Sight
    tuning: Tuning
    price_s: float = 0.3
    memory_s: float = 1000.0
    moves: list[Move] = field(default_factory=list)
    _judges: list[Judge] = field(init=False)
    _allocation: Allocation = field(init=False)
    _fuse: Fuse = field(default_factory=Fuse)
    _settled_at: float = -math.inf
    _spec: TaskSpec = field(init=False)
    _rules: Rules = field(init=False)

    def __post_init__(self) -> None:
        self._spec = replace(self.view.spec, price_s=self.price_s, memory_s=self.memory_s)
        self._rules = rules_of(self._spec)
        self._judges = [Judge(spec=self._spec) for _ in self.view.fleet.voters]
        self._allocation = Allocation(task=self._spec.name, revision=0, epoch=0, owner=None, tuning=self.tuning)

    def round(self, seats: tuple[int, ...], at_s: float, now: float) -> None:
        """Judge at every robot whose turn it is; the first that proposes a move calls the vote."""
        if not seats:
            return
        by_service = self.tuning.score is ScoreForm.SERVICE
        allocation = self._allocation if by_service else None
        standing = self.view.standing(now, allocation, self._judges[0].lost_for)
        for seat in seats:
            judgement = self._judge(seat, standing, now, is_called=False)
            if judgement.outcome is Outcome.PROPOSE:
                self._vote(seat, judgement, standing, at_s, now)
                return

    def _judge(self, seat: int, standing: Standing, now: float, *, is_called: bool) -> Judgement:
        owner, voters, electors = self._allocation.owner, self.view.fleet.voters, self.view.fleet.electors
        figures = Figures(
            task=self._spec.name,
            now=now,
            rules=self._rules,
            allocation=self._allocation,
            voters=voters,
            present=voters,
            vectors=standing.vectors,
            electors=electors,
            electors_heard=electors,
            settled_for_s=now - self._settled_at,
            owner_state=PeerState.ALIVE,
            owner_profile=None if owner is None else self.view.gateway.fresh(owner, now),
            is_called=is_called,
        )
        return decide_by(standing, self._judges[seat], self._fuse, figures).judgement

    def _vote(self, caller: int, first: Judgement, standing: Standing, at_s: float, now: float) -> None:
        """Every robot answers the caller with today's winner; the tally decides (Alg. 3)."""
        voters = self.view.fleet.voters
        judgements = [
            first if seat == caller else self._judge(seat, standing, now, is_called=True) for seat in range(len(voters))
        ]
        proposals = {
            voter: Proposal(
                voter=voter,
                task=self._spec.name,
                base_revision=0,
                candidate=judgement.candidate,
                aggregate=judgement.aggregate,
                is_escape=judgement.is_escape,
            )
            for voter, judgement in zip(voters, judgements, strict=True)
            if judgement.candidate is not None
        }
        owner = self._allocation.owner
        counted = tally(proposals, voters=voters, present=frozenset(voters), owner=owner, is_over=True)
        won = counted.outcome is VoteOutcome.WON and counted.winner is not None
        for judge in self._judges:
            judge.reset(is_new_owner=won)
        if counted.winner is None or not won:
            return
        if owner is not None:
            self._fuse.note_move(is_escape=counted.is_escape, now=now)
        self._settled_at = now + COMMIT_S
        self._allocation = Allocation(
            task=self._spec.name, revision=0, epoch=self._allocation.epoch + 1, owner=counted.winner, tuning=self.tuning
        )
        self.moves.append(
            Move(at_s=at_s + COMMIT_S, owner=counted.winner, left=owner, is_escape=counted.is_escape),
        )


@dataclass(slots=True)
class PickRule:
    """The paper's scheduler as printed: every ``period_s`` the argmax, with a cost for the selected one.

    ``cost`` above 0 is a bonus for the owner, below 0 the literal penalty, 0 is plain argmax. No memory, no timers.
    """

    view: Sight
    cost: float = 0.0
    period_s: float = 1.0
    moves: list[Move] = field(default_factory=list)
    owner: NodeId | None = None
    _due: float = -math.inf

    def round(self, _seats: tuple[int, ...], at_s: float, now: float) -> None:
        """Decide when the period has passed."""
        if now < self._due:
            return
        self._due = now + self.period_s - 0.05
        aggregates = self.view.standing(now).aggregates
        scored = {name: value + (self.cost if name == self.owner else 0.0) for name, value in aggregates.items()}
        winner = pick(scored, self.owner)
        if winner is not None and winner != self.owner:
            self.moves.append(Move(at_s=at_s, owner=winner, left=self.owner))
            self.owner = winner


@dataclass(slots=True)
class BlindRule:
    """Fixed, first match, random: a rule that looks at who can have the task, and not at how good it would be."""

    view: Sight
    choose: Callable[[tuple[NodeId, ...]], NodeId]
    period_s: float = math.inf
    moves: list[Move] = field(default_factory=list)
    owner: NodeId | None = None
    _due: float = -math.inf

    def round(self, _seats: tuple[int, ...], at_s: float, now: float) -> None:
        """Decide when the period has passed, or for the first time."""
        if now < self._due:
            return
        can = tuple(sorted(self.view.standing(now).aggregates))
        if not can:
            return
        self._due = now + self.period_s
        winner = self.choose(can)
        if winner != self.owner:
            self.moves.append(Move(at_s=at_s, owner=winner, left=self.owner))
            self.owner = winner


def fixed(name: NodeId) -> Callable[[tuple[NodeId, ...]], NodeId]:
    """Always this one."""
    return lambda _can: name


def first_match(can: tuple[NodeId, ...]) -> NodeId:
    """What a label selector does: the first candidate that can have it."""
    return can[0]


def drawn(rng: Random) -> Callable[[tuple[NodeId, ...]], NodeId]:
    """A random one of those that can have it."""
    return rng.choice
