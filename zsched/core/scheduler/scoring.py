"""SCHEDULER: one robot's scores of a task's candidates (Alg. 2, Calculate_Utility).

Knows: Eq. 1-4, doubts, who is reached. Does not know: which use is whose (`zsched.core.scheduler.usage`), what forbids
a task (`zsched.core.scheduler.eligibility`), what other robots say (`zsched.core.scheduler.standing`).
"""

from __future__ import annotations

from collections.abc import Mapping

from zsched.core.gateway.demand import speed_of
from zsched.core.gateway.gateway import Gateway
from zsched.core.gateway.shortfall import is_short
from zsched.core.scheduler.eligibility import (
    NO_DOUBTS,
    Case,
    Doubts,
    chain_of,
    has_living_owner,
    is_far_beyond,
    may_return,
    veto,
)
from zsched.core.scheduler.links import PairLink, pair_link, signals_of, ways
from zsched.core.scheduler.usage import Bookings, coming_use, own_use, predicted, predicted_gauges
from zsched.core.scheduler.utility import (
    Total,
    cpu_utility,
    memory_utility,
    on_time,
    service_utility,
    timely_worth,
)
from zsched.core.values.fleet import TaskSpec
from zsched.core.values.gauges import BY_NAME
from zsched.core.values.model import (
    Allocation,
    NodeId,
    PeerState,
    ScoreForm,
    Tuning,
    Utility,
    UtilityVector,
)
from zsched.core.values.profile import Profile
from zsched.core.values.struct import Struct
from zsched.core.values.veto import Filter, Veto

REACH_MARGIN_DB = 3.0
"""A candidate is at its limit up to so much above nu: twice what a smoothed signal scatters by. While the robots reach
the owner it does not count there, so that a signal that stands about nu moves a task once."""


class _Terms(Struct, frozen=True):
    """Eq. 1-3 for one candidate."""

    told: dict[str, float]
    """{metric: its term}, of those that are measured; of the gauges the weighed ones."""
    at_limit: bool


NOTHING_HELD: Mapping[NodeId, float] = {}


def score(
    spec: TaskSpec,
    allocation: Allocation,
    voter: NodeId,
    gateway: Gateway,
    states: Mapping[NodeId, PeerState],
    now: float,
    bookings: Bookings | None = None,
    doubts: Doubts = NO_DOUBTS,
    round_trips: Mapping[NodeId, float] = NOTHING_HELD,
) -> UtilityVector:
    """This robot's utilities of a task's candidates, by the tuning of ``allocation``.

    A candidate that this robot cannot reach gets 0 (not: is left out, which would raise its mean); one that may not
    have the task is refused with the reason. Where there are ``doubts`` about a node, it keeps
    what it has and gets nothing new. What the other tasks of ``bookings`` will use there, and do not show yet, counts
    as in use. ``round_trips`` are
    seconds to each candidate and back, where measured (`zsched.core.gateway.round_trips`).

    Memory that a worker has come to use forbids a candidate that lacks it, while the task runs elsewhere. Without an
    owner the file's figure alone does: a worker that starts anew may need far less, and any place is better than none.
    """
    view = _View(
        spec=spec,
        allocation=allocation,
        voter=voter,
        gateway=gateway,
        states=states,
        now=now,
        bookings=bookings,
        doubts=doubts,
    )
    away_s = NOTHING_HELD
    if allocation.tuning.deadline_ms is not None:
        away_s = ways(voter, spec.candidates, round_trips, gateway, now)
    terms: dict[NodeId, _Terms] = {}
    unreachable: list[NodeId] = []
    vetoes: dict[NodeId, Veto] = {}
    for candidate in spec.candidates:
        found = view.terms(candidate, away_s.get(candidate, 0.0))
        if found is None:
            unreachable.append(candidate)
        elif isinstance(found, Veto):
            vetoes[candidate] = found
        else:
            terms[candidate] = found
    _spare_own_link(voter, terms)
    utilities, unmeasured = _weighed(allocation.tuning, terms)
    utilities += [Utility(candidate=name, value=0.0, reachable=False) for name in unreachable]
    vector = UtilityVector(
        voter=voter,
        task=spec.name,
        revision=allocation.revision,
        utilities=tuple(sorted(utilities, key=lambda utility: utility.candidate)),
    )
    vetoes |= unmeasured
    return vector.refusing(vetoes) if vetoes else vector


class _View:
    """What one robot sees of a task's candidates in one round."""

    def __init__(
        self,
        *,
        spec: TaskSpec,
        allocation: Allocation,
        voter: NodeId,
        gateway: Gateway,
        states: Mapping[NodeId, PeerState],
        now: float,
        bookings: Bookings | None,
        doubts: Doubts,
    ) -> None:
        self._spec, self._allocation, self._voter, self._gateway = spec, allocation, voter, gateway
        self._states, self._now, self._bookings, self._doubts = states, now, bookings, doubts
        owner = allocation.owner
        told, own = None if owner is None else gateway.fresh(owner, now), signals_of(gateway.fresh(voter, now))
        rests = told is not None and told.rests(spec.name)
        may_keep = owner in spec.candidates and owner not in doubts.unfit and not rests
        has_owner = (
            owner is not None
            and may_keep
            and has_living_owner(spec, states.get(owner, PeerState.UNKNOWN), told, is_spared=owner in doubts.in_grace)
        )
        is_kept = has_owner and owner not in doubts.left and may_return(spec, told)
        is_within = told is None or not is_far_beyond(spec, gateway.readings(told))
        of_owner = None
        if has_owner and owner is not None:
            of_owner = pair_link(voter, owner, (own, signals_of(told)), spec.limits)
        margin_db = own_margin_db = 0.0
        if is_kept:
            margin_db = REACH_MARGIN_DB
            # the way to the access point takes no part in who is better where the owner is reached by it, too
            own_margin_db = margin_db if of_owner is None or of_owner.is_direct else 0.0
        self._chain = chain_of(spec, doubts)
        self._owner = owner if has_owner else None
        """Who has the task, works, or may, and may keep it; ``None``: nobody."""
        self._is_kept = is_kept and is_within
        weighed = allocation.tuning.weights.gauges
        self._gauges = [name for name, _ in weighed if name != "gpu" or spec.demand.gpu]
        """Whose terms count: where nothing says what the task uses of a GPU, its owner would look worse by that."""
        self._is_paper, self._job = allocation.tuning.score is ScoreForm.PAPER, gateway.demands.job(spec.name)
        self._signals, self._of_owner, self._margins = own, of_owner, (margin_db, own_margin_db)

    def terms(self, candidate: NodeId, network_s: float) -> _Terms | Veto | None:
        """Eq. 1-3 for a candidate to which ``network_s`` lead and back; why it is kept out; ``None``: not reached."""
        spec, allocation, gateway, now, doubts = self._spec, self._allocation, self._gateway, self._now, self._doubts
        state, is_owner = self._states.get(candidate, PeerState.UNKNOWN), candidate == allocation.owner
        is_there = state is PeerState.ALIVE or (is_owner and candidate in doubts.in_grace)
        if (not is_there or candidate in doubts.unseen) and state is not PeerState.UNKNOWN:
            return None
        profile = gateway.fresh(candidate, now)
        if profile is None:
            return veto(Case(spec=spec, node=candidate, is_owner=is_owner, state=state, doubts=doubts), self._chain)
        demand, is_comer = gateway.demand(spec, profile), self._owner is not None and candidate != self._owner
        own = own_use(spec, allocation, profile, demand, gateway)
        coming = coming_use(spec, profile, self._bookings, gateway, now, None if is_comer else own)
        use = predicted(profile, own, demand, coming)
        gauges = predicted_gauges(spec, allocation, profile, self._bookings, gateway, now)
        needed = demand if is_comer else spec.demand
        least_use = use if needed is demand else predicted(profile, own, needed, coming)
        case = Case(
            spec=spec,
            node=candidate,
            is_owner=is_owner,
            state=state,
            doubts=doubts,
            profile=profile,
            needed_mb=needed.memory_mb,
            use=least_use,
            gauges=gauges,
            is_kept=self._is_kept,
        )
        if (found := veto(case, self._chain)) is not None:
            return found
        link = self._link(candidate, profile)
        if link is not None and not link.is_reached:
            return None
        told = {}
        if self._gauges:
            told = {name: BY_NAME[name].term(gauges[name]) for name in self._gauges if name in gauges}
        if link is not None:
            told["network"] = link.utility
        if use.cpu_cores is not None:
            left = profile.cpu_cores - use.cpu_cores
            told["cpu"] = (
                cpu_utility(profile.cpu_cores, use.cpu_cores)
                if self._is_paper
                else self._cpu_service(profile, left, demand.cpu_cores, own.cpu_cores, coming.cpu_cores, network_s)
            )
        if use.memory_mb is not None:
            has, need, others = profile.memory_mb, demand.memory_mb, use.memory_mb - demand.memory_mb
            told["memory"] = (
                memory_utility(has, need, others)
                if self._is_paper
                else service_utility(has - use.memory_mb + need, need, has)
            )
        return _Terms(told, link is not None and link.at_limit)

    def _cpu_service(
        self, profile: Profile, left: float, need: float, own: float, coming: float, network_s: float
    ) -> float:
        """The share of its jobs that the task would get done, in time where it has a deadline; all in cores.

        Args:
            profile: the candidate's.
            left: free there beside the task; below 0: it lacks so much.
            need: of the task there.
            own: what it uses there now.
            coming: what other tasks will use there.
            network_s: from this robot and back.
        """
        spec, demands, deadline_ms = self._spec, self._gateway.demands, self._allocation.tuning.deadline_ms
        others = () if self._bookings is None else self._bookings.get(profile.node, ())
        is_outranked = others != () and any(other.priority > spec.priority for other in others)
        # it gets at least this if it needs it, however full the machine is
        fair = 0.0 if is_outranked else self._gateway.shares.at(spec.name, profile, need, coming)
        free, is_owner = left + need, profile.node == self._allocation.owner
        share = 1.0
        if self._job is not None:
            speed = speed_of(profile)
            if deadline_ms is not None:
                seen_s = demands.seen_s(spec.name, profile) if is_owner else 0.0
                # a job gets that while it runs; between its jobs a task uses nothing, so that may be far more
                job_s = max(self._job.age_s(speed, max(free, fair)), seen_s) + network_s
                share = timely_worth(on_time(job_s, deadline_ms / 1e3))
        load = profile.worker(spec.name) if is_owner else None
        if load is not None and is_short(load):  # what such an owner gives is measured
            worth = service_utility(free, need, profile.cpu_cores, least=min(fair, own), share=share)
            return min(worth, demands.given_ratio(spec.name, profile))
        return service_utility(free, need, profile.cpu_cores, least=fair, share=share)

    def _link(self, candidate: NodeId, profile: Profile) -> PairLink | None:
        if candidate == self._owner:
            return self._of_owner
        signals = self._signals, signals_of(profile)
        return pair_link(self._voter, candidate, signals, self._spec.limits, *self._margins)


def _weighed(tuning: Tuning, terms: Mapping[NodeId, _Terms]) -> tuple[list[Utility], dict[NodeId, Veto]]:
    """What each candidate is worth by its terms, and why some have no worth beside others that have one."""
    measured = set[str]().union(*(term.told for term in terms.values()))
    weighed = [name for name, weight in tuning.weights.shares if weight > 0.0]
    # a machine that does not tell its CPU or memory is blind; of links and gauges there may be none
    are_alike = not {"cpu", "memory", *measured} & {*weighed}
    # a node without such a gauge counts as if it had the best reading
    assumed = {name: 1.0 for name in measured if name in BY_NAME and not BY_NAME[name].is_needed}
    gauges, total = sorted(measured & BY_NAME.keys()), Total(tuning.weights, measured, tuning.score)
    utilities, vetoes = [], dict[NodeId, Veto]()
    for candidate, term in terms.items():
        told = {**assumed, **term.told} if assumed else term.told
        value = 1.0 if are_alike else total.of(told)
        if value is None:
            unknown = [name for name in weighed if name not in told]
            kept_out = Filter.LINK if unknown == ["network"] else Filter.FIGURES
            vetoes[candidate] = Veto(kept_out, f"{', '.join(unknown)}: not measured there, and it has a weight")
            continue
        utilities.append(
            Utility(
                candidate=candidate,
                value=value,
                cpu=told.get("cpu"),
                memory=told.get("memory"),
                network=told.get("network"),
                gauges=tuple([(name, told[name]) for name in gauges if name in told]) if gauges else (),
                at_limit=term.at_limit,
            )
        )
    return utilities, vetoes


def _spare_own_link(voter: NodeId, terms: Mapping[NodeId, _Terms]) -> None:
    """Drop a robot's link to itself where no other is measured: a robot always reaches itself, nobody measures that."""
    if len(terms) > 1 and not any("network" in term.told for name, term in terms.items() if name != voter):
        for term in terms.values():
            term.told.pop("network", None)
