"""The rules that are compared: zsched's own judges, the paper's schemes, and yardsticks without any view.

Knows: when each rule looks, and which node it then chooses. Does not know: the truth, what a choice is worth.

`CoreRule` is the production's decision: `zsched.core.scheduler.decision` at each robot, a called vote, the tally, flap
damping. It does what `zsched.core.scheduler.rounds` does when no message is lost;
`tests/unit/lab/decisions/test_same_as_nodes.py` holds the two together. `TimedJudge` is what the production decided by
before patience: a yardstick.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from random import Random
from typing import Any, Protocol

from zsched.core.scheduler.damping import Damping
from zsched.core.scheduler.decision import decide_by, rules_of
from zsched.core.scheduler.judge import Judge, Judgement, Outcome
from zsched.core.scheduler.standing import Standing, pick
from zsched.core.values.decision import Figures, Rules
from zsched.core.values.fleet import PAPER_PATIENCE, TaskSpec
from zsched.core.values.model import Allocation, NodeId, PeerState, Proposal, ScoreForm, Tuning
from zsched.core.vote.tally import VoteOutcome, tally
from zsched_lab.decisions.ledger import Ledger, LedgerJudge
from zsched_lab.decisions.view import Sight

COMMIT_S = 0.03
"""From the vote to the commit; measured on loopback (`benchmarks.commit`)."""
TIMER_MARGIN_S = 0.001
"""Sums of floats: a timer has certainly ended this much later."""


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


class TimedJudge(Judge):
    """The production's judge with a time-to-trigger in place of patience: another candidate must lead for that long.

    A time-to-trigger is counted from the first judgement at which the owner is beaten, by whomever, without a break
    (docs/decisions/0017; patience took its place by docs/decisions/0021).
    """

    __slots__ = ("beaten_since", "trigger_s")

    def __init__(self, spec: TaskSpec, trigger_s: float) -> None:
        super().__init__(spec=replace(spec, patience=0.0, learns_patience=False))
        self.trigger_s = trigger_s
        self.beaten_since: float | None = None

    def reset(self, *, is_new_owner: bool = False) -> None:
        """As `Judge.reset`; the whole time counts again."""
        super().reset(is_new_owner=is_new_owner)
        self.beaten_since = None

    def judge(self, standing: Standing, allocation: Allocation, **given: Any) -> Judgement:
        """As `Judge.judge`, but that a planned move waits for its time."""
        judgement, owner, now = super().judge(standing, allocation, **given), allocation.owner, float(given["now"])
        if owner is None or pick(judgement.aggregates, owner) in (None, owner):
            self.beaten_since = None
            return judgement
        self.beaten_since = now if self.beaten_since is None else self.beaten_since
        is_planned = judgement.outcome is Outcome.PROPOSE and not (judgement.is_escape or given["is_called"])
        if not is_planned or now - self.beaten_since >= self.trigger_s:
            return judgement
        aggregate = judgement.aggregates.get(owner, 0.0)
        return replace(judgement, outcome=Outcome.WAIT, candidate=owner, aggregate=aggregate)


@dataclass(slots=True)
class CoreRule:
    """The production's decision under some tuning; with a ``time_to_trigger_s`` as it was before it had patience."""

    view: Sight
    tuning: Tuning
    patience: float = PAPER_PATIENCE
    learns_patience: bool = False
    time_to_trigger_s: float | None = None
    ledger: Callable[[], Ledger] | None = None
    """In place of patience."""
    moves: list[Move] = field(default_factory=list)
    _judges: list[Judge] = field(init=False)
    _allocation: Allocation = field(init=False)
    _damping: Damping = field(default_factory=Damping)
    _settled_at: float = -math.inf
    _due: float = math.inf
    _spec: TaskSpec = field(init=False)
    _rules: Rules = field(init=False)

    def __post_init__(self) -> None:
        self._spec = replace(self.view.spec, patience=self.patience, learns_patience=self.learns_patience)
        self._rules = rules_of(self._spec)
        self._judges = [self._new_judge() for _ in self.view.fleet.voters]
        self._allocation = Allocation(task=self._spec.name, revision=0, epoch=0, owner=None, tuning=self.tuning)

    def _new_judge(self) -> Judge:
        if self.ledger is not None:
            return LedgerJudge(self._spec, self.ledger())
        timer_s = self.time_to_trigger_s
        return Judge(spec=self._spec) if timer_s is None else TimedJudge(self._spec, timer_s)

    def round(self, seats: tuple[int, ...], at_s: float, now: float) -> None:
        """Judge at every robot whose turn it is; the first that proposes a move calls the vote."""
        if now >= self._due:
            seats, self._due = tuple(range(len(self._judges))), math.inf
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
            self._wake_when_due(seat, judgement, now)

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
        return decide_by(standing, self._judges[seat], self._damping, figures).judgement

    def _wake_when_due(self, seat: int, judgement: Judgement, now: float) -> None:
        """A lead that only waits for a time-to-trigger and the cool-down is judged when they end."""
        judge = self._judges[seat]
        if judgement.outcome is not Outcome.WAIT or not isinstance(judge, TimedJudge) or judge.beaten_since is None:
            return
        ends = max(judge.beaten_since + judge.trigger_s, self._settled_at + self.tuning.cool_down_s)
        if ends + TIMER_MARGIN_S > now:
            self._due = min(self._due, ends + TIMER_MARGIN_S)

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
        self._damping.note_move(owner, has_failed=False, is_escape=counted.is_escape, now=now)
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
