"""SCHEDULER, the radio: what one robot's link to one candidate is worth (Eq. 3), and how far away it counts.

Knows: links that were measured directly, the two ways of a pair that meet at an access point, ways that nobody
has measured yet. Does not know: weights, who may have the task, how signals are smoothed.

Whether a candidate is *reached* is always a matter of the weaker way as measured: a path with a dead end is dead.
Its *worth* is told by the candidate's own way.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

from zsched.core.gateway.gateway import Gateway
from zsched.core.scheduler.utility import network_utility
from zsched.core.values.fleet import LinkLimits
from zsched.core.values.model import NodeId
from zsched.core.values.profile import LinkSource, Profile
from zsched.core.values.struct import Struct

WIRED_DBM = 0.0
"""Stands for a cable in comparisons of signals: better than any radio."""

Signals = Mapping[NodeId | None, float | None]
"""{peer (``None``: the access point or the cable): the smoothed signal in dBm}; ``None``: not measured."""


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
    signals: tuple[Signals, Signals],
    limits: LinkLimits,
    margin_db: float = 0.0,
    own_margin_db: float = 0.0,
) -> PairLink | None:
    """Eq. 3 for one (robot, candidate) pair with these ``signals`` at its two ends; ``None``: nobody measured it.

    A candidate is at its limit up to ``margin_db`` above nu, the access point by the robot's own radio up to
    ``own_margin_db`` above it.

    A link measured between the two counts as it is, from either end. Else both reach each other through one access
    point, and the candidate's own way counts, as the paper prints Eq. 3: the robot's is part of every path.
    """
    if voter == candidate:
        return PairLink(is_reached=True, utility=1.0)
    (own, its), nu_dbm = signals, limits.nu_dbm
    own_dbm = its_dbm = its.get(voter) if own.get(candidate) is None else own[candidate]
    if is_direct := own_dbm is not None:
        own_margin_db = margin_db
    else:
        own_dbm, its_dbm = own.get(None), its.get(None)
    if own_dbm is None or its_dbm is None:
        return None
    is_reached = own_dbm >= nu_dbm and its_dbm >= nu_dbm
    is_clear = own_dbm >= nu_dbm + own_margin_db and its_dbm >= nu_dbm + margin_db
    utility = network_utility(its_dbm, nu_dbm, limits.rho_dbm)
    return PairLink(is_reached, utility, is_reached and not is_clear, is_direct)


def signals_of(profile: Profile | None) -> Signals:
    """A node's links by its fresh profile; of several to one peer the first."""
    links = () if profile is None else profile.links
    return {one.peer: WIRED_DBM if one.source is LinkSource.WIRED else one.rssi_dbm for one in reversed(links)}


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
