"""SCHEDULER, for an operator: the sums of one judgement, and what would have to change for a move.

Knows: how the terms become a total, and the order in which a judgement is held back. Does not know: how that is shown
(`zsched.commands.look.explain`), live state: it goes by written figures alone.

The sums are not taken from the verdict. They are made again, so that a reader can check them.
"""

from __future__ import annotations

from collections.abc import Iterator

from zsched.core.scheduler.decision import Decided, decide_again, verdict_of
from zsched.core.scheduler.eligibility import FOR_COMERS
from zsched.core.scheduler.fuse import WINDOW_S, Fuse
from zsched.core.scheduler.judge import Outcome
from zsched.core.scheduler.standing import Standing, pick, rounded
from zsched.core.values.decision import Decision, Figures, Verdict
from zsched.core.values.model import NodeId, PeerState, Tuning, Utility, UtilityVector
from zsched.core.values.quorum import majority
from zsched.core.values.struct import Struct, replace
from zsched.core.values.words import Readings


class RobotView(Struct, frozen=True, kw_only=True):
    """One robot's score of one candidate: the terms and the utility that they make, each in [0, 1]."""

    robot: NodeId
    utility: float | None = None
    cpu: float | None = None
    memory: float | None = None
    network: float | None = None
    gauges: Readings = ()
    """Of the gauges that the task weighs."""
    reachable: bool = True
    refused: str = ""
    """Why this robot did not score it; empty: it did."""
    filter: str = ""
    """Which filter kept it out (`zsched.core.values.veto.Filter`)."""


class CandidateSum(Struct, frozen=True, kw_only=True):
    """``joint - unkept + bonus = total``; ``None`` where the candidate cannot have the task."""

    node: NodeId
    is_owner: bool
    joint: float | None
    """Mean or median of the robots' utilities."""
    unkept: float
    """What the machine promised so before, and did not give (`zsched.core.scheduler.kept`)."""
    bonus: float
    """The owner's, and what the file prefers."""
    total: float | None
    owed_s: float | None = None
    """Seconds of work that the task owes there, with what it will lose; ``None``: it cannot have it."""
    why_not: str = ""
    """Why it cannot have the task, or must be left."""
    filter: str = ""
    """Which filter keeps it out."""
    need_cpu_cores: float | None = None
    need_memory_mb: float | None = None
    robots: tuple[RobotView, ...] = ()


class Explained(Struct, frozen=True, kw_only=True):
    """One judgement as an operator reads it."""

    task: str
    owner: NodeId | None
    epoch: int
    revision: int
    outcome: str
    candidate: NodeId | None
    """Whom this robot would vote for."""
    reason: str
    is_escape: bool
    tuning: Tuning
    price_s: float
    """What a move costs, in seconds of the task's work."""
    known_for_s: float
    """For how long this robot has known the owner."""
    heard: tuple[NodeId, ...]
    silent: tuple[NodeId, ...]
    """Robots whose utilities did not come in time, or are about another revision."""
    needed: int
    """How many robots a decision needs."""
    candidates: tuple[CandidateSum, ...]
    """The best one first."""
    margin: float | None
    """The best total less the next one; ``None``: fewer than two have one."""
    changes: tuple[str, ...]
    """What would have to change for a move."""


class Sight(Struct, frozen=True, kw_only=True):
    """What one robot sees: its own terms, and whom it hears."""

    robot: NodeId
    is_heard: bool
    """Whether its utilities are part of the judgement."""
    best: NodeId | None
    """The candidate to which it gives the highest utility; the owner where several have that."""
    is_own: bool
    """Whether the judgement is this robot's own; the fields below are of the node that judged."""
    robots: tuple[NodeId, ...]
    """Robots that are not gone."""
    gone: tuple[NodeId, ...]
    electors: tuple[NodeId, ...]
    """Electors that are heard."""
    electors_silent: tuple[NodeId, ...]


def seen_by(decision: Decision, robot: NodeId, judge: NodeId) -> Sight:
    """What ``robot`` sees, by the judgement that the node ``judge`` made."""
    figures = decision.figures
    standing = decide_again(figures).standing
    own = {
        one.candidate: one.value
        for vector in standing.vectors
        for one in vector.utilities
        if vector.voter == robot and one.reachable
    }
    return Sight(
        robot=robot,
        is_heard=any(vector.voter == robot for vector in standing.vectors),
        best=pick(own, figures.allocation.owner),
        is_own=robot == judge,
        robots=tuple(name for name in figures.voters if name in figures.present),
        gone=tuple(name for name in figures.voters if name not in figures.present),
        electors=figures.electors_heard,
        electors_silent=tuple(name for name in figures.electors if name not in figures.electors_heard),
    )


def explained(decision: Decision) -> Explained:
    """The sums of a judgement."""
    figures, verdict = decision.figures, decision.verdict
    allocation, again = figures.allocation, decide_again(figures)
    sums = _sums(decision, again)
    totals = [one.total for one in sums if one.total is not None]
    heard = tuple(vector.voter for vector in again.standing.vectors)
    return Explained(
        task=figures.task,
        owner=allocation.owner,
        epoch=allocation.epoch,
        revision=allocation.revision,
        outcome=verdict.outcome,
        candidate=verdict.candidate,
        reason=verdict.reason,
        is_escape=verdict.is_escape,
        tuning=allocation.tuning,
        price_s=figures.rules.price_s,
        known_for_s=figures.settled_for_s,
        heard=heard,
        silent=tuple(voter for voter in figures.voters if voter not in heard),
        needed=again.needed,
        candidates=sums,
        margin=totals[0] - totals[1] if len(totals) > 1 else None,
        changes=tuple(_changes(figures, verdict, again, sums)),
    )


def without(figures: Figures, node: NodeId) -> Figures:
    """The same figures if ``node`` were gone: nobody reaches it, and it neither votes nor promises."""
    allocation = figures.allocation
    return replace(
        figures,
        present=tuple(name for name in figures.present if name != node),
        electors_heard=tuple(name for name in figures.electors_heard if name != node),
        vectors=tuple(_cut_off(vector, node, figures) for vector in figures.vectors if vector.voter != node),
        owner_state=PeerState.GONE if allocation.owner == node else figures.owner_state,
        owner_profile=None if allocation.owner == node else figures.owner_profile,
    )


def judged_again(decision: Decision, figures: Figures) -> Decision:
    """The judgement by other figures than the ones of ``decision``."""
    return replace(decision, figures=figures, verdict=verdict_of(decide_again(figures).judgement))


def _cut_off(vector: UtilityVector, node: NodeId, figures: Figures) -> UtilityVector:
    if node not in figures.rules.candidates:
        return vector
    others = [one for one in vector.utilities if one.candidate != node]
    lost = Utility(candidate=node, value=0.0, reachable=False)
    kept = {name: veto for name, veto in vector.vetoes.items() if name != node}
    if node == figures.allocation.owner:  # what only keeps others from a task that somebody has
        kept |= {
            name: replace(veto, why=f"{veto.why}, which may not matter then")
            for name, veto in kept.items()
            if veto.filter in FOR_COMERS
        }
    utilities = tuple(sorted((*others, lost), key=lambda one: one.candidate))
    return replace(vector, utilities=utilities).refusing(kept)


# --- the sums --------------------------------------------------------------------------------------------------------


def _sums(decision: Decision, again: Decided) -> tuple[CandidateSum, ...]:
    """Every candidate's sum, the best first."""
    figures, standing = decision.figures, again.standing
    owner, tuning, head_starts = figures.allocation.owner, figures.allocation.tuning, dict(figures.head_starts)
    needs = {need.candidate: need for need in decision.needs}
    unkept = again.judgement.unkept
    found = []
    for name in figures.rules.candidates:
        is_left = name == owner and again.leaving is not None
        joint = standing.aggregates.get(name)
        bonus = (tuning.bonus if name == owner and not is_left else 0.0) + head_starts.get(name, 0.0)
        need = needs.get(name)
        veto = again.escape if is_left else standing.vetoed.get(name)
        is_out = joint is None or is_left
        found.append(
            CandidateSum(
                node=name,
                is_owner=name == owner,
                joint=joint,
                unkept=unkept.get(name, 0.0),
                bonus=bonus,
                total=None if is_out or joint is None else joint - unkept.get(name, 0.0) + bonus,
                owed_s=again.judgement.owed.get(name),
                why_not=again.leaving or "" if is_left else "" if veto is None else veto.why,
                filter="" if veto is None else veto.filter,
                need_cpu_cores=None if need is None else need.cpu_cores,
                need_memory_mb=None if need is None else need.memory_mb,
                robots=tuple(_views(name, standing)),
            )
        )
    totals = {one.node: one.total for one in found if one.total is not None}
    first = pick(totals, owner)
    return tuple(sorted(found, key=lambda one: (one.node != first, -totals.get(one.node, -1.0), one.node)))


def _views(name: NodeId, standing: Standing) -> Iterator[RobotView]:
    for vector in standing.vectors:
        veto = vector.vetoes.get(name)
        if veto is not None:
            yield RobotView(robot=vector.voter, refused=veto.why, filter=veto.filter)
        for one in vector.utilities:
            if one.candidate == name:
                yield RobotView(
                    robot=vector.voter,
                    utility=one.value,
                    cpu=one.cpu,
                    memory=one.memory,
                    network=one.network,
                    gauges=one.gauges,
                    reachable=one.reachable,
                )


# --- what would have to change ---------------------------------------------------------------------------------------


def _changes(figures: Figures, verdict: Verdict, again: Decided, sums: tuple[CandidateSum, ...]) -> Iterator[str]:
    """Sentences, in the order in which a judgement is held back."""
    if verdict.outcome == Outcome.PROPOSE:
        yield f"nothing: this robot proposes {verdict.candidate}"
        return
    heard = again.standing.voters_heard
    if heard < again.needed:
        yield f"{again.needed} robots must tell their utilities, {heard} did"
        return
    allocation = figures.allocation
    is_away = allocation.home not in (None, allocation.owner) and again.leaving is None and not allocation.paused
    if is_away and verdict.outcome == Outcome.WAIT:  # its pin takes it home, whatever the others are worth
        yield f"what holds it back must end: {verdict.reason}"
        return
    if allocation.paused or (allocation.pinned and (allocation.is_bound or again.leaving is None)):
        yield f"an operator must end that the task is {'paused' if allocation.paused else 'pinned'}"
    others = [one for one in sums if not one.is_owner]
    owner = next((one for one in sums if one.is_owner), None)
    if is_away:
        yield f"or {allocation.home} must be able to have it"
    elif not any(one.total is not None for one in others):
        yield "another candidate must be able to have the task"
    elif allocation.owner is not None and again.leaving is None and owner is not None and owner.total is not None:
        yield from _leads(figures, again, owner, [one for one in others if one.total is not None])
    elif verdict.outcome == Outcome.WAIT:
        yield f"what holds it back must end: {verdict.reason}"
    for one in others:
        if one.why_not:
            yield f"{one.node} cannot have it: {one.why_not}"


def _leads(figures: Figures, again: Decided, owner: CandidateSum, others: list[CandidateSum]) -> Iterator[str]:
    """What the owner's challengers lack: worth, or time."""
    assert owner.total is not None
    for number, one in enumerate(others):
        assert one.total is not None
        if rounded(one.total) <= rounded(owner.total):
            yield f"{one.node} lacks {owner.total - one.total:.4f} of worth to be ahead of {owner.node}"
        elif not number:
            yield from _times(figures, again, one.node, owner.node)


def _times(figures: Figures, again: Decided, node: NodeId, owner: NodeId) -> Iterator[str]:
    """What ``node``, which owes less than the ``owner``, still waits for."""
    more_s, price_s = again.judgement.owed[owner] - again.judgement.owed[node], figures.rules.price_s
    yield f"{owner} owes {more_s:.2f} s more than {node}, and must go on losing:"
    if more_s < price_s:
        yield f"until that is the price of a move, {price_s:g} s"
    if figures.first is not None:
        yield f"until {figures.first} has moved"
    electors, heard = len(figures.electors), len(figures.electors_heard)
    if heard < majority(electors):
        yield f"until {majority(electors)} of {electors} electors are heard ({heard} are)"
    if Fuse.of(figures.fuse).moves_within(WINDOW_S, figures.now, escapes=False) >= figures.rules.max_moves_per_minute:
        yield f"until fewer than {figures.rules.max_moves_per_minute} moves lie in the last minute"
