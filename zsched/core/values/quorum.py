"""What a majority is: of robots that vote, of electors that promise."""

from __future__ import annotations

from collections.abc import Mapping

from zsched.core.values.model import NodeId, PeerState


def majority(count: int) -> int:
    """The least number that is more than half of ``count``.

    >>> [majority(n) for n in (1, 2, 3, 4, 5)]
    [1, 2, 2, 3, 3]
    """
    return count // 2 + 1


def present_voters(voters: tuple[NodeId, ...], states: Mapping[NodeId, PeerState]) -> frozenset[NodeId]:
    """The robots that are not gone."""
    return frozenset(name for name in voters if states[name] is not PeerState.GONE)
