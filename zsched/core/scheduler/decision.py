"""SCHEDULER: one judgement from its figures, in the whole order of docs/design/scheduling.md.

Knows: the order of a judgement's steps. Does not know: where the figures come from (`zsched.core.scheduler.rounds`),
what becomes of the judgement, files.

`decide` is what a robot runs in every round, and what `explain --replay` runs on figures that were written down: the
same figures give the same judgement, bit for bit.
"""

from __future__ import annotations

from collections.abc import Mapping

from zsched.core.scheduler.fuse import Fuse
from zsched.core.scheduler.judge import Judge, Judgement, Outcome, escape_ahead, escape_reason
from zsched.core.scheduler.standing import Standing, compare, reaches_owner
from zsched.core.values.decision import Figures, Rules, Verdict
from zsched.core.values.fleet import TaskSpec, WorkerSpec
from zsched.core.values.model import Allocation, NodeId, PeerState
from zsched.core.values.quorum import majority
from zsched.core.values.struct import Struct, replace
from zsched.core.values.veto import Filter, Veto


class Decided(Struct, frozen=True, kw_only=True):
    """The result of one judgement."""

    standing: Standing
    judgement: Judgement
    escape: Veto | None
    """Why the owner is to be left at once."""
    leaving: str | None
    """Why the owner is to be left, by an escape or by an operator's drain."""
    needed: int
    """How many robots' utilities this decision needs."""
    takes_turns: bool = False
    """It waits for other tasks' moves, as a planned one does."""
    is_waiting_its_turn: bool = False
    """Another task's move holds it back."""


def decide(judge: Judge, fuse: Fuse, figures: Figures) -> Decided:
    """Judge by ``figures``; ``judge`` and ``fuse`` hold the memory of which the figures have a copy."""
    vectors = {vector.voter: vector for vector in figures.vectors}
    spec, allocation = judge.spec, figures.allocation
    lost_for_s = judge.lost_for(reaches_owner(spec, allocation, vectors), figures.now)
    return decide_by(compare(spec, allocation, vectors, lost_for_s), judge, fuse, figures)


def decide_by(compared: Standing, judge: Judge, fuse: Fuse, figures: Figures) -> Decided:
    """`decide` by the vectors of ``figures`` as `compare` has joined them: once for all who have the same."""
    allocation = figures.allocation
    standing = _keep_out(compared, figures)
    escape = _escape(judge, standing, figures)
    standing = _leave_to_others(standing, figures)
    needed = _robots_needed(figures, is_escape=escape is not None)
    if standing.voters_heard < needed:
        reason = f"utilities of {standing.voters_heard} robots, {needed} needed"
        judgement = Judgement(outcome=Outcome.NONE, candidate=None, aggregate=0.0, reason=reason)
    else:
        judge.out = frozenset(figures.out)
        judgement = judge.judge(
            standing,
            allocation,
            escape=None if escape is None else escape.why,
            drained=figures.drained,
            is_called=figures.is_called,
            now=figures.now,
            fuse=fuse,
            is_unheard=figures.owner_state is PeerState.UNKNOWN,
            head_starts=dict(figures.head_starts),
        )
    if escape is None:
        judgement = _look_ahead(judge, judgement, standing, figures)
    takes_turns = judgement.outcome is Outcome.PROPOSE and not judgement.is_escape
    is_waiting = takes_turns and figures.first is not None
    if is_waiting:
        # the figures are read again before it is judged once more
        judgement = _put_off(judgement, allocation, f"{figures.first} moves first")
    if not figures.is_called:
        judgement = _spare(judgement, figures)
    return Decided(
        standing=standing,
        judgement=judgement,
        escape=escape,
        leaving=escape.why if escape else f"{allocation.owner} is {figures.drained}" if figures.drained else None,
        needed=needed,
        takes_turns=takes_turns,
        is_waiting_its_turn=is_waiting,
    )


def decide_again(figures: Figures) -> Decided:
    """The judgement of figures that were written down."""
    spec = spec_of(figures)
    judge = Judge(spec=spec)
    judge.recall(figures.judge)
    return decide(judge, Fuse.of(figures.fuse), figures)


def rules_of(spec: TaskSpec) -> Rules:
    """The settings by which a task is judged."""
    return Rules(
        candidates=spec.candidates,
        reach=spec.reach,
        max_moves_per_minute=spec.max_moves_per_minute,
        price_s=spec.price_s,
        memory_s=spec.memory_s,
        start_deadline_s=spec.worker.start_deadline_s,
        has_command=bool(spec.worker.command),
    )


def spec_of(figures: Figures) -> TaskSpec:
    """A task of the fleet file, as far as a judgement goes by it."""
    rules = figures.rules
    return TaskSpec(
        name=figures.task,
        candidates=rules.candidates,
        tuning=figures.allocation.tuning,
        reach=rules.reach,
        max_moves_per_minute=rules.max_moves_per_minute,
        price_s=rules.price_s,
        memory_s=rules.memory_s,
        worker=WorkerSpec(command=("",) if rules.has_command else (), start_deadline_s=rules.start_deadline_s),
    )


def verdict_of(judgement: Judgement) -> Verdict:
    """A judgement as a plain value."""
    return Verdict(
        outcome=judgement.outcome.value,
        candidate=judgement.candidate,
        aggregate=judgement.aggregate,
        reason=judgement.reason,
        is_escape=judgement.is_escape,
        aggregates=tuple(sorted(judgement.aggregates.items())),
    )


def _keep_out(standing: Standing, figures: Figures) -> Standing:
    """The standing without the candidates that take nothing new; an owner among them keeps what it has."""
    candidates = figures.rules.candidates
    closed = {name: Veto(Filter.ORDER, why) for name, why in figures.closed if name in candidates}
    return _without(standing, closed, figures)


def _leave_to_others(standing: Standing, figures: Figures) -> Standing:
    """The standing without the candidates that other tasks are about to fill; all of them where it has no other place.

    Who is first there by its name may have a choice, and leaves again; a task that waited would have no owner for good.
    One that is pinned hard has one place.
    """
    if figures.allocation.is_bound:
        return standing
    rest = _without(standing, {name: Veto(Filter.ROOM, why) for name, why in figures.claimed}, figures)
    return rest if rest.aggregates.keys() - {figures.allocation.owner} else standing


def _without(standing: Standing, shut: Mapping[NodeId, Veto], figures: Figures) -> Standing:
    """The standing without the candidates of ``shut`` ({candidate: why}) but the owner."""
    shut = {name: why for name, why in shut.items() if name != figures.allocation.owner}
    if not shut:
        return standing
    return replace(
        standing,
        aggregates={name: value for name, value in standing.aggregates.items() if name not in shut},
        vetoed={**standing.vetoed, **shut},
    )


def _robots_needed(figures: Figures, *, is_escape: bool) -> int:
    """How many robots' utilities a decision needs; for an escape a majority of those that are not gone."""
    needed = majority(len(figures.voters))
    return max(min(needed, majority(len(figures.present))), 1) if is_escape else needed


def _escape(judge: Judge, standing: Standing, figures: Figures) -> Veto | None:
    allocation, profile = figures.allocation, figures.owner_profile
    if allocation.owner is None:
        return None
    state = figures.owner_state
    if state is PeerState.SUSPECT and not figures.is_called_escape:
        state = PeerState.ALIVE  # in grace; only a peer's word makes our own suspicion enough
    not_ready_for = judge.not_ready_for(profile, figures.now)
    return escape_reason(judge.spec, allocation, state, profile, standing, not_ready_for, judge.held_s)


def _look_ahead(judge: Judge, judgement: Judgement, standing: Standing, figures: Figures) -> Judgement:
    """While an owner whose worker is not ready has its start-up deadline: say that, and when it will be left."""
    since, allocation = judge.absences.since, figures.allocation
    if since is None or allocation.owner is None or judgement.outcome is Outcome.PROPOSE:
        return judgement
    has_other = any(name != allocation.owner for name in standing.aggregates)
    not_ready_s = figures.now - since
    ahead = escape_ahead(judge.spec, allocation, figures.owner_profile, not_ready_s, has_other=has_other)
    return replace(judgement, reason=f"{judgement.reason}; {ahead}") if ahead else judgement


def _spare(judgement: Judgement, figures: Figures) -> Judgement:
    """What too few electors could agree to is not called for.

    It would wait in the register for the very moment in which the network heals, and be committed then.
    """
    if judgement.outcome is not Outcome.PROPOSE:
        return judgement
    electors, heard = figures.electors, len(figures.electors_heard)
    if heard >= majority(len(electors)):
        return judgement
    return _put_off(judgement, figures.allocation, f"{heard} of {len(electors)} electors heard")


def _put_off(judgement: Judgement, allocation: Allocation, why: str) -> Judgement:
    """The same judgement, without the move."""
    owner = allocation.owner
    return replace(
        judgement,
        outcome=Outcome.WAIT,
        candidate=owner,
        aggregate=judgement.aggregates.get(owner, 0.0) if owner is not None else 0.0,
        reason=f"{judgement.reason}; {why}",
        is_escape=False,
    )
