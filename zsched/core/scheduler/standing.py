"""SCHEDULER: joins all robots' scores of a task's candidates (Alg. 2, Compare_Utility).

Knows: Eq. 5-6, vetoes. Does not know: how a score is made (`zsched.core.scheduler.scoring`), stickiness
(`zsched.core.scheduler.judge`), how scores travel.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

from zsched.core.scheduler.utility import Total
from zsched.core.values.fleet import TaskSpec
from zsched.core.values.model import Allocation, NodeId, Reach, Tuning, Utility, UtilityVector
from zsched.core.values.quorum import majority
from zsched.core.values.struct import Struct, replace
from zsched.core.values.veto import Filter, Veto

LOST_S = 3.0
"""Where all candidates stand at the limit of their signals, the owner is not reached for a moment now and then."""
RESOLUTION = 1 / 1024
"""Aggregates are compared to this: half of what a tenth of a machine's free share is worth."""

_Row = Mapping[NodeId, Utility]
_UNSCORED = Veto(Filter.SCORES, "not scored by enough robots")


def rounded(aggregate: float) -> float:
    """An aggregate to `RESOLUTION`: sums of floats differ by their order, and a difference that small decides nothing.

    >>> rounded(0.5 + 0.4 / 1024), rounded(0.5 + 0.6 / 1024)
    (0.5, 0.5009765625)
    """
    return round(aggregate / RESOLUTION) * RESOLUTION


class Standing(Struct, frozen=True, kw_only=True):
    """The joint view of one gather: ``aggregates`` without bonus, ``vetoed`` with reasons, and who was heard."""

    aggregates: Mapping[NodeId, float]
    vetoed: Mapping[NodeId, Veto]
    vectors: tuple[UtilityVector, ...]
    voters_heard: int
    machines: Mapping[NodeId, float] | None = None
    """{candidate: its aggregate without the network: a signal is no promise}; ``None``: the task weighs no network."""

    def kept_out_by(self, node: NodeId | None) -> Filter | None:
        """Which filter keeps ``node`` out; ``None``: none does."""
        veto = None if node is None else self.vetoed.get(node)
        return None if veto is None else veto.filter


def reaches_owner(spec: TaskSpec, allocation: Allocation, vectors: Mapping[NodeId, UtilityVector]) -> bool:
    """Whether the robots reach the task's owner, by the vectors that `compare` counts; false without an owner."""
    told = _counted(allocation, vectors)
    if allocation.owner is None:
        return False
    # a robot that refuses the owner for something else has not lost it by that
    return len(told) - _saying(allocation.owner, told, reachable=False) >= _needed(spec, told)


def _counted(allocation: Allocation, vectors: Mapping[NodeId, UtilityVector]) -> tuple[UtilityVector, ...]:
    return tuple(vectors[voter] for voter in sorted(vectors) if vectors[voter].revision == allocation.revision)


def _needed(spec: TaskSpec, told: tuple[UtilityVector, ...]) -> int:
    return len(told) if spec.reach is Reach.ALL else majority(len(told))


def compare(
    spec: TaskSpec, allocation: Allocation, vectors: Mapping[NodeId, UtilityVector], lost_for_s: float = math.inf
) -> Standing:
    """Join the fresh voters' vectors column by column (Eq. 5-6: argmax over candidates of the aggregate over robots).

    Args:
        spec: the task.
        allocation: the current one; vectors under another revision are not counted.
        vectors: {voter: its vector}, the fresh ones only.
        lost_for_s: for how long the robots have not reached the owner. Less than `LOST_S`, and who is at the limit of
            its signal is no better place: it would be lost as soon.
    """
    told = _counted(allocation, vectors)
    needed, least = _needed(spec, told), majority(len(told))
    fresh = told
    if allocation.owner is not None and (lost_for_s < LOST_S or reaches_owner(spec, allocation, vectors)):
        fresh = tuple(_with_margin(vector) for vector in told)
    # each candidate once, however often a vector names it
    rows = [{utility.candidate: utility for utility in vector.utilities} for vector in fresh]
    reasons: dict[NodeId, Veto] = {}
    for vector in fresh:
        reasons |= vector.vetoes
    vetoed: dict[NodeId, Veto] = {}
    kept: list[NodeId] = []
    for candidate in spec.candidates:
        column = [row[candidate].reachable for row in rows if candidate in row]
        reaching = sum(column)
        if len(column) < least or len(column) == reaching < needed:
            # Not scored is not "not reached": only the latter is a reason to flee from an owner.
            vetoed[candidate] = reasons.get(candidate, _UNSCORED)
        elif reaching < needed:
            at_limit = _saying(candidate, told, reachable=True) - reaching
            told_of = f", by {at_limit} more at the limit of the signal (link.nu_dbm)" if at_limit else ""
            why = f"reached by {reaching} of {len(fresh)} robots{told_of}"
            vetoed[candidate] = Veto(Filter.REACH, why)
        else:
            kept.append(candidate)
    return Standing(
        aggregates=_aggregates(kept, rows),
        machines=_machines(kept, rows, allocation.tuning) if allocation.tuning.weights.network else None,
        vetoed=vetoed,
        vectors=fresh,
        voters_heard=len(fresh),
    )


def _saying(candidate: NodeId, vectors: tuple[UtilityVector, ...], *, reachable: bool) -> int:
    """How many robots say of a candidate that they reach it (at the limit of its signal, too), or that they do not."""
    told = (vector.utilities for vector in vectors)
    return sum(
        any(one.candidate == candidate and one.reachable is reachable for one in utilities) for utilities in told
    )


def _with_margin(vector: UtilityVector) -> UtilityVector:
    """A robot's utilities while the owner is reached, who is never at the limit: a candidate that is counts as lost."""
    if not any(one.at_limit for one in vector.utilities):
        return vector
    near = (
        Utility(candidate=one.candidate, value=0.0, reachable=False) if one.at_limit else one
        for one in vector.utilities
    )
    return replace(vector, utilities=tuple(near))


def _comparable(candidates: Iterable[NodeId], rows: Sequence[_Row]) -> Sequence[_Row]:
    """The rows that these candidates are compared by: of the robots that score all of them, if they are a majority.

    A robot that is far away gives low values. If it leaves out one candidate, for a doubt of its own, that one would
    gain by it, and the task move there and back with every doubt. Else all count, each for what it scores.
    """
    wanted = set(candidates)
    whole = [row for row in rows if wanted <= row.keys()]
    return whole if len(whole) >= majority(len(rows)) else rows


def _aggregates(candidates: list[NodeId], rows: Sequence[_Row]) -> dict[NodeId, float]:
    """{candidate: the mean of the robots' utilities} (Eq. 5-6)."""
    told = _comparable(candidates, rows)
    columns = {name: [row[name].value for row in told if name in row] for name in candidates}
    return {name: math.fsum(column) / len(column) for name, column in columns.items()}


def _machines(candidates: list[NodeId], rows: Sequence[_Row], tuning: Tuning) -> dict[NodeId, float]:
    """What candidates are worth wherever the robots are; 1 where nothing but the network counts.

    By one robot's word: all have it of the candidate's profile.
    """
    said = {name: next(row[name].terms for row in rows if name in row) for name in candidates}
    measured = {metric for terms in said.values() for metric, term in terms.items() if term is not None}
    total = Total(tuning.weights, measured - {"network"}, tuning.score)
    return {name: 1.0 if (value := total.of(terms)) is None else value for name, terms in said.items()}


def pick(aggregates: Mapping[NodeId, float], owner: NodeId | None) -> NodeId | None:
    """The candidate with the highest aggregate; ties (to 1/1024) go to the owner, then to the lowest name."""
    if not aggregates:
        return None
    close = max(aggregates.values()) - 2 * RESOLUTION
    near = [name for name, value in aggregates.items() if value >= close]
    return min(near, key=lambda name: (-rounded(aggregates[name]), name != owner, name))
