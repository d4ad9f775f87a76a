"""SCHEDULER: one robot's scores of a task's candidates (Alg. 2, Calculate_Utility).

Knows: Eq. 1-4, doubts, who is reached. Does not know: which use is whose (`zsched.core.scheduler.usage`), what forbids
a task (`zsched.core.scheduler.eligibility`), what other robots say (`zsched.core.scheduler.standing`).
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping

from zsched.core.gateway.demand import Demands, Need, speed_of
from zsched.core.gateway.gateway import Gateway
from zsched.core.gateway.shortfall import is_short
from zsched.core.scheduler.eligibility import (
    NO_DOUBTS,
    Case,
    Doubts,
    has_living_owner,
    is_far_beyond,
    may_return,
    veto,
)
from zsched.core.scheduler.links import PairLink, pair_link, ways
from zsched.core.scheduler.usage import Bookings, Use, coming_use, own_use, predicted, predicted_gauges
from zsched.core.scheduler.utility import (
    cpu_utility,
    memory_service,
    memory_utility,
    on_time,
    service_utility,
    spare_factor,
    timely_worth,
    total_utility,
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
from zsched.core.values.struct import Struct, replace
from zsched.core.values.veto import Filter, Veto
from zsched.core.values.words import GaugeName

REACH_MARGIN_DB = 3.0
"""A candidate is at its limit up to so much above nu: twice what a smoothed signal scatters by. While the robots reach
the owner it does not count there, so that a signal that stands about nu moves a task once."""


_NAMES = {
    flags: frozenset(name for name, is_there in zip(("cpu", "memory", "network"), flags, strict=True) if is_there)
    for flags in itertools.product((False, True), repeat=3)
}
"""{which of Eq. 1-3 are measured: their names}."""


class _Terms(Struct, frozen=True):
    """Eq. 1-3 for one candidate; ``None`` where the metric is not measured. Of the gauges the weighed ones."""

    cpu: float | None
    memory: float | None
    network: float | None
    gauges: Mapping[str, float]
    at_limit: bool = False

    def names(self) -> frozenset[str]:
        """The measured metrics."""
        three = _NAMES[self.cpu is not None, self.memory is not None, self.network is not None]
        return three.union(self.gauges) if self.gauges else three


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
        told = None if owner is None else gateway.fresh(owner, now)
        may_keep = owner in spec.candidates and owner not in doubts.unfit
        has_owner = (
            owner is not None
            and may_keep
            and has_living_owner(spec, states.get(owner, PeerState.UNKNOWN), told, is_spared=owner in doubts.in_grace)
        )
        is_kept = has_owner and owner not in doubts.left and may_return(spec, told)
        is_within = told is None or not is_far_beyond(spec, gateway.readings(told))
        of_owner = pair_link(voter, owner, gateway, spec.limits, now) if has_owner and owner is not None else None
        margin_db = own_margin_db = 0.0
        if is_kept:
            margin_db = REACH_MARGIN_DB
            # the way to the access point takes no part in who is better where the owner is reached by it, too
            own_margin_db = margin_db if of_owner is None or of_owner.is_direct else 0.0
        self._owner = owner if has_owner else None
        """Who has the task, works, or may, and may keep it; ``None``: nobody."""
        self._is_kept = is_kept and is_within
        self._of_owner, self._margin_db, self._own_margin_db = of_owner, margin_db, own_margin_db

    def terms(self, candidate: NodeId, network_s: float) -> _Terms | Veto | None:
        """Eq. 1-3 for a candidate to which ``network_s`` lead and back; why it is kept out; ``None``: not reached."""
        spec, allocation, gateway, now, doubts = self._spec, self._allocation, self._gateway, self._now, self._doubts
        state, is_owner = self._states.get(candidate, PeerState.UNKNOWN), candidate == allocation.owner
        is_there = state is PeerState.ALIVE or (is_owner and candidate in doubts.in_grace)
        if state is not PeerState.UNKNOWN and (not is_there or candidate in doubts.unseen):
            return None
        case = Case(spec=spec, node=candidate, is_owner=is_owner, state=state, doubts=doubts)
        profile = gateway.fresh(candidate, now)
        if profile is None:
            return veto(case)
        demand, is_comer = gateway.demand(spec, profile), self._owner is not None and candidate != self._owner
        own = own_use(spec, allocation, profile, demand, gateway)
        coming = coming_use(spec, profile, self._bookings, gateway, now, None if is_comer else own)
        use = predicted(profile, own, demand, coming)
        gauges = predicted_gauges(spec, allocation, profile, self._bookings, gateway, now)
        needed = demand if is_comer else spec.demand
        least_use = use if needed is demand else predicted(profile, own, needed, coming)
        case = replace(
            case, profile=profile, needed_mb=needed.memory_mb, use=least_use, gauges=gauges, is_kept=self._is_kept
        )
        if (found := veto(case)) is not None:
            return found
        link = self._link(candidate)
        if link is not None and not link.is_reached:
            return None
        others = () if self._bookings is None else self._bookings.get(candidate, ())
        if any(other.priority > spec.priority for other in others):
            fair = 0.0
        else:
            fair = gateway.share(spec, profile, demand.cpu_cores, coming.cpu_cores)
        load = profile.worker(spec.name)
        # what an owner that is short gets is measured
        is_measured = is_owner and load is not None and is_short(load)
        worth = _Worth(
            spec=spec,
            profile=profile,
            demand=demand,
            use=use,
            least_cores=min(fair, own.cpu_cores) if is_measured else fair,
            fair_cores=fair,
            network_s=network_s,
            is_owner=is_owner,
            is_short=is_measured,
            demands=gateway.demands,
            now=now,
        )
        tuning = allocation.tuning
        is_paper = tuning.score is ScoreForm.PAPER
        cpu, memory = worth.by_paper() if is_paper else worth.by_service(tuning.deadline_ms)
        weighed, at_limit = _gauges(spec, allocation, gauges), link is not None and link.at_limit
        return _Terms(cpu, memory, None if link is None else link.utility, weighed, at_limit)

    def _link(self, candidate: NodeId) -> PairLink | None:
        if candidate == self._owner:
            return self._of_owner
        margins = self._margin_db, self._own_margin_db
        return pair_link(self._voter, candidate, self._gateway, self._spec.limits, self._now, *margins)


def _weighed(tuning: Tuning, terms: Mapping[NodeId, _Terms]) -> tuple[list[Utility], dict[NodeId, Veto]]:
    """What each candidate is worth by its terms, and why some have no worth beside others that have one."""
    named = {name: term.names() for name, term in terms.items()}
    measured = frozenset[str]().union(*named.values())
    weighed = [name for name, weight in tuning.weights.shares if weight > 0.0]
    # a machine that does not tell its CPU or memory is blind; of links and gauges there may be none
    are_alike = not {"cpu", "memory", *measured} & {*weighed}
    utilities, vetoes = [], dict[NodeId, Veto]()
    for candidate, term in terms.items():
        by_gauge = term.gauges
        if lacking := measured - named[candidate]:
            assumed = {name: 1.0 for name in sorted(lacking) if name in BY_NAME and _is_assumed(name)}
            by_gauge = {**by_gauge, **assumed}
        value = total_utility(
            tuning.weights,
            cpu=term.cpu,
            memory=term.memory,
            network=term.network,
            measured=measured,
            form=tuning.score,
            gauges=by_gauge,
        )
        if are_alike:
            value = 1.0
        elif value is None:
            unknown = [name for name in weighed if name not in named[candidate] and name not in by_gauge]
            kept_out = Filter.LINK if unknown == ["network"] else Filter.FIGURES
            vetoes[candidate] = Veto(kept_out, f"{', '.join(unknown)}: not measured there, and it has a weight")
            continue
        utilities.append(
            Utility(
                candidate=candidate,
                value=value,
                cpu=term.cpu,
                memory=term.memory,
                network=term.network,
                gauges=tuple(sorted(by_gauge.items())),
                at_limit=term.at_limit,
            )
        )
    return utilities, vetoes


def _spare_own_link(voter: NodeId, terms: dict[NodeId, _Terms]) -> None:
    """Drop a robot's link to itself where no other is measured: a robot always reaches itself, nobody measures that."""
    if len(terms) > 1 and all(term.network is None for name, term in terms.items() if name != voter):
        for name, term in terms.items():
            terms[name] = replace(term, network=None)


def _gauges(spec: TaskSpec, allocation: Allocation, gauges: Mapping[GaugeName, float]) -> dict[str, float]:
    """The terms of the weighed gauges that this node measures; none of a GPU of which nothing says what the task uses.

    Its owner would look worse by the task's own work, which would follow the task wherever it goes.
    """
    if not allocation.tuning.weights.gauges:
        return {}
    weighed = {name for name, _ in allocation.tuning.weights.gauges if name != "gpu" or spec.demand.gpu}
    return {name: BY_NAME[name].term(reading) for name, reading in gauges.items() if name in weighed}


def _is_assumed(name: str) -> bool:
    """Whether a node without this gauge counts as if it had the best reading."""
    return not BY_NAME[name].is_needed


class _Worth(Struct, frozen=True):
    """What Eq. 1 and 2 go by on one candidate that has the task, or what `ScoreForm.SERVICE` has in their place."""

    spec: TaskSpec
    profile: Profile
    demand: Need
    use: Use
    least_cores: float
    """It gets at least this if it needs it, however full the machine is."""
    fair_cores: float
    """A job gets at least this while it runs. Between its jobs a task uses nothing, so that may be far more."""
    network_s: float
    is_owner: bool
    is_short: bool
    """It is the owner, and visibly lacks CPU."""
    demands: Demands
    now: float

    def by_paper(self) -> tuple[float | None, float | None]:
        """Eq. 1 and 2."""
        cpu, mb, profile = self.use.cpu_cores, self.use.memory_mb, self.profile
        need_mb = self.demand.memory_mb
        return (
            None if cpu is None else cpu_utility(profile.cpu_cores, cpu),
            None if mb is None else memory_utility(profile.memory_mb, need_mb, mb - need_mb),
        )

    def by_service(self, deadline_ms: float | None) -> tuple[float | None, float | None]:
        """The share of its jobs that the task would get done, in time where it has a deadline; whether memory fits."""
        cpu, mb, profile, need_mb = None, self.use.memory_mb, self.profile, self.demand.memory_mb
        if self.use.cpu_cores is not None:
            cpu = self._cpu(profile.cpu_cores - self.use.cpu_cores, deadline_ms)
            if self.is_short:
                cpu = min(cpu, self.demands.given_ratio(self.spec.name, profile, self.now))
        if mb is None:
            return cpu, None
        free_mb = profile.memory_mb - mb + need_mb
        return cpu, memory_service(free_mb, need_mb, profile.memory_mb, self.spec.memory_floor_ratio)

    def _cpu(self, left_cores: float, deadline_ms: float | None) -> float:
        spec, profile, need = self.spec, self.profile, self.demand.cpu_cores
        free, job, most = left_cores + need, self.demands.job(spec.name), None
        share = spare_factor(left_cores, profile.cpu_cores, spec.cpu_floor_ratio)
        if job is not None:
            speed = speed_of(profile)
            most = job.most_cores(speed, need)
            if deadline_ms is not None:
                seen_s = self.demands.seen_s(spec.name, profile, self.now) if self.is_owner else 0.0
                job_s = max(job.age_s(speed, max(free, self.fair_cores)), seen_s) + self.network_s
                share *= timely_worth(on_time(job_s, deadline_ms / 1e3))
        return service_utility(free, need, profile.cpu_cores, least=self.least_cores, most=most, share=share)
