"""What robots tell one another before a vote, with what a test does not care about filled in."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from zsched.core.values.model import NodeId, Proposal, Utility, UtilityVector


def proposal_of(voter: NodeId, candidate: NodeId = "edge1", **options: Any) -> Proposal:
    """A robot's proposal for the task "merge", on revision 0, with an aggregate of 0.5."""
    return Proposal(
        voter=voter, candidate=candidate, **{"task": "merge", "base_revision": 0, "aggregate": 0.5, **options}
    )


def vector_of(voter: NodeId, utilities: Mapping[NodeId, float], revision: int = 0, **options: Any) -> UtilityVector:
    """A robot's {candidate: utility} of the task "merge"; of a candidate below 0 it says that it does not reach it."""
    column = tuple(
        Utility(candidate=name, value=max(value, 0.0), reachable=value >= 0.0) for name, value in utilities.items()
    )
    return UtilityVector(voter=voter, revision=revision, utilities=column, **{"task": "merge", **options})
