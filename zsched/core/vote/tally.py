"""VOTE: plurality of the robots' proposals, with the tie rules (Alg. 3, Consensus).

Knows: counting fresh proposals on one base. Does not know: the reason of a robot's proposal, how the winner is
committed (`zsched.core.register.register`).

An outcome needs fresh proposals on the same base revision from a majority of the robots. (For an escape: of the robots
that are not gone; the electors' majority alone guards uniqueness.) Then the most proposed candidate wins. Ties go to
the owner, then to the higher aggregate (to 1/1024), then to the lowest name. A proposal for the owner means staying.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from enum import StrEnum

from zsched.core.scheduler.standing import rounded
from zsched.core.values.model import NodeId, Proposal
from zsched.core.values.quorum import majority
from zsched.core.values.struct import Struct


class VoteOutcome(StrEnum):
    """The only answers."""

    PENDING = "pending"  # may still change
    WON = "won"  # by a candidate that is not the owner
    STAY = "stay"
    NO_QUORUM = "no_quorum"


class Tally(Struct, frozen=True, kw_only=True):
    """The count of one vote."""

    outcome: VoteOutcome
    winner: NodeId | None
    votes: tuple[tuple[NodeId, NodeId], ...]
    """(voter, candidate), sorted by voter."""
    is_escape: bool
    reason: str


def tally(
    proposals: Mapping[NodeId, Proposal],
    *,
    voters: tuple[NodeId, ...],
    present: frozenset[NodeId],
    owner: NodeId | None,
    is_over: bool,
) -> Tally:
    """Count one vote.

    Args:
        proposals: {voter: its newest proposal}, fresh and on the same base only.
        voters: the configured robots.
        present: the robots that are not gone.
        owner: the current owner, for the tie rule.
        is_over: no further proposal will be waited for.

    Returns:
        `PENDING` while a missing proposal could change the result and `is_over` is false.
    """
    ballots = {voter: proposals[voter] for voter in voters if voter in proposals}
    votes = tuple((voter, ballots[voter].candidate) for voter in sorted(ballots))
    is_escape = any(ballot.is_escape for ballot in ballots.values())
    needed = majority(len(voters))
    if is_escape:
        needed = max(min(needed, majority(len([voter for voter in voters if voter in present]))), 1)
    missing = [voter for voter in voters if voter not in ballots and voter in present]
    if len(ballots) < needed:
        outcome = VoteOutcome.NO_QUORUM if is_over or not missing else VoteOutcome.PENDING
        reason = f"{len(ballots)} of {needed} proposals needed"
        return Tally(outcome=outcome, winner=None, votes=votes, is_escape=is_escape, reason=reason)
    counts = Counter(candidate for _, candidate in votes)
    best = {name: max(b.aggregate for b in ballots.values() if b.candidate == name) for name in counts}
    winner = min(counts, key=lambda name: (-counts[name], name != owner, -rounded(best[name]), name))
    is_decided = counts[winner] >= majority(len(voters)) or not missing or is_over
    reason = f"{counts[winner]} of {len(votes)} for {winner}"
    if not is_decided:
        return Tally(outcome=VoteOutcome.PENDING, winner=None, votes=votes, is_escape=is_escape, reason=reason)
    outcome = VoteOutcome.STAY if winner == owner else VoteOutcome.WON
    return Tally(outcome=outcome, winner=winner, votes=votes, is_escape=is_escape, reason=reason)
