"""SCHEDULER at rest: when a robot may go on by the answers of its last gather, and asks nobody (decision 0049).

Knows: answers, when two vectors of one robot say the same. Does not know: rounds, time, who is asked how.

A robot that sees a change asks, and its proposal calls the others. So a robot whose own utilities are as they were need
not ask: whoever sees more will call it.
"""

from __future__ import annotations

from collections.abc import Mapping

from zsched.core.values.model import NodeId, PeerState, UtilityVector
from zsched.core.values.struct import Struct

SAME_UTILITY = 0.02
"""Utilities that differ by less are the same: as much as a profile's figures change before it is sent at once."""


class Answers(Struct, frozen=True, kw_only=True):
    """What all living robots have answered to one gather, our own vectors among it."""

    vectors: Mapping[NodeId, tuple[UtilityVector, ...]]
    states: Mapping[NodeId, PeerState]
    """The nodes' states at its end."""
    at: float
    """When that was, monotonic seconds."""


def is_like(new: tuple[UtilityVector, ...], old: tuple[UtilityVector, ...]) -> bool:
    """Whether two answers of one robot lead to the same decisions, but for less than `SAME_UTILITY`."""
    return len(new) == len(old) and all(_is_like(one, other) for one, other in zip(new, old, strict=True))


def _is_like(new: UtilityVector, old: UtilityVector) -> bool:
    if (new.task, new.revision) != (old.task, old.revision):
        return False
    if _names(new) != _names(old):
        return False
    utilities = {one.candidate: one.value for one in new.utilities}, {one.candidate: one.value for one in old.utilities}
    return _is_near(*utilities)


def _names(vector: UtilityVector) -> tuple[list[NodeId], list[NodeId], list[NodeId]]:
    """Who is refused, who is out of reach, and who is at the limit of its signal."""
    lost = [one.candidate for one in vector.utilities if not one.reachable]
    return [name for name, _ in vector.refused], lost, [one.candidate for one in vector.utilities if one.at_limit]


def _is_near(new: Mapping[NodeId, float], old: Mapping[NodeId, float]) -> bool:
    return new.keys() == old.keys() and all(abs(value - old[name]) < SAME_UTILITY for name, value in new.items())
