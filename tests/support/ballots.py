"""Ballots of proposers, with what a test does not care about filled in."""

from __future__ import annotations

from zsched.core.values.model import Ballot, NodeId


def ballot_of(counter: int = 1, node: NodeId = "robot1", incarnation: int = 1) -> Ballot:
    """A ballot of a node's first life."""
    return Ballot(counter=counter, node=node, incarnation=incarnation)
