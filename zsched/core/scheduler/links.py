"""SCHEDULER, the radio: what one robot's link to one candidate is worth (Eq. 3), and how far away it counts.

Knows: links that were measured directly, the two ways of a pair that meet at an access point, ways that nobody
has measured yet. Does not know: weights, who may have the task, how signals are smoothed.

Whether a candidate is *reached* is always a matter of the weaker way as measured: a path with a dead end is dead.
What it is *worth* depends on the task's reading of a pair.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

from zsched.core.gateway.gateway import Gateway
from zsched.core.scheduler.utility import network_utility
from zsched.core.values.fleet import LinkLimits
from zsched.core.values.model import NodeId, PairReading
from zsched.core.values.profile import LinkSource, Profile
from zsched.core.values.struct import Struct

WIRED_DBM = 0.0
"""Stands for a cable in comparisons of signals: better than any radio."""


class PairLink(Struct, frozen=True):
    """The link of one (robot, candidate) pair: ``is_reached`` by nu, and Eq. 3's kappa in [0, 1]."""

    is_reached: bool
    utility: float
    at_limit: bool = False
    """Reached, but not with the margins that were asked for."""
    is_direct: bool = True
    """Measured between the two; otherwise the robot's own way to the access point or the cable is a part of it."""


def pair_link(
    voter: NodeId,
    candidate: NodeId,
    gateway: Gateway,
    limits: LinkLimits,
    now: float,
    margin_db: float = 0.0,
    own_margin_db: float = 0.0,
) -> PairLink | None:
    """Eq. 3 for one (robot, candidate) pair, or ``None`` when nobody measured it.

    A candidate is at its limit up to ``margin_db`` above nu, the access point by the robot's own radio up to
    ``own_margin_db`` above it.

    A link measured between the two counts as it is, from either end. Else both reach each other through one access
    point, and ``limits.pair`` says how the two ways become one.
    """
    if voter == candidate:
        return PairLink(is_reached=True, utility=1.0)
    ends, nu_dbm = (gateway.fresh(voter, now), gateway.fresh(candidate, now)), limits.nu_dbm
    for end, other in ((ends[0], candidate), (ends[1], voter)):
        signal_dbm = None if end is None else _way(end, other)
        if signal_dbm is not None:
            return PairLink(
                is_reached=signal_dbm >= nu_dbm,
                utility=_worth(signal_dbm, limits),
                at_limit=nu_dbm <= signal_dbm < nu_dbm + margin_db,
            )
    if ends[0] is None or ends[1] is None:
        return None
    own, its = _way(ends[0], None), _way(ends[1], None)
    if own is None or its is None:
        return None
    is_reached = min(own, its) >= nu_dbm
    is_clear = own >= nu_dbm + own_margin_db and its >= nu_dbm + margin_db
    at_limit = is_reached and not is_clear
    return PairLink(is_reached=is_reached, utility=_joint(own, its, limits), at_limit=at_limit, is_direct=False)


def _joint(own_dbm: float, its_dbm: float, limits: LinkLimits) -> float:
    """Two ways through one access point as one utility, by the task's reading of a pair."""
    is_candidates = limits.pair is PairReading.CANDIDATE
    return _worth(its_dbm if is_candidates else min(own_dbm, its_dbm), limits)


def _worth(signal_dbm: float, limits: LinkLimits) -> float:
    return network_utility(signal_dbm, limits.nu_dbm, limits.rho_dbm)


def _way(profile: Profile, peer: NodeId | None) -> float | None:
    """The smoothed signal of a node's link to ``peer`` (``None``: to the access point or the cable), in dBm.

    ``None``: it measures none.
    """
    for link in profile.links:
        if link.peer == peer:
            return WIRED_DBM if link.source is LinkSource.WIRED else link.rssi_dbm
    return None


def ways(
    voter: NodeId, candidates: Collection[NodeId], round_trips: Mapping[NodeId, float], gateway: Gateway, now: float
) -> dict[NodeId, float]:
    """Seconds from a robot to each candidate and back.

    A way that is not measured yet counts as the longest to another candidate that is heard: it must not be better by
    that. Where none is measured, none counts.
    """
    heard = (name for name in candidates if name in round_trips and gateway.fresh(name, now) is not None)
    longest_s = max((round_trips[name] for name in heard), default=0.0)
    return {name: 0.0 if name == voter else round_trips.get(name, longest_s) for name in candidates}
