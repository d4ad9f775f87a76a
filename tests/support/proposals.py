"""What robots tell one another before a vote, with what a test does not care about filled in."""

from __future__ import annotations

from typing import Any

from zsched.core.values.model import NodeId, Proposal


def proposal_of(voter: NodeId, candidate: NodeId = "edge1", **options: Any) -> Proposal:
    """A robot's proposal for the task "merge", on revision 0, with an aggregate of 0.5."""
    return Proposal(
        voter=voter, candidate=candidate, **{"task": "merge", "base_revision": 0, "aggregate": 0.5, **options}
    )
