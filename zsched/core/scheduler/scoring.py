"""SCHEDULER, first half: filters and scores candidates and compares the robots' scores (Alg. 2).

Knows: eligibility, Eq. 1-6, vetoes. Does not know: stickiness (`zsched.core.scheduler.judge`), how utilities travel.

Two steps, both pure functions: `score` makes this robot's `UtilityVector` (Calculate_Utility); `compare` joins the
vectors of all fresh voters into a `Standing` (Compare_Utility), and `pick` names its best.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Mapping
from collections.abc import Set as AbstractSet

from zsched.core.gateway.company import is_full
from zsched.core.gateway.demand import Demands
from zsched.core.gateway.gateway import Gateway
from zsched.core.gateway.sharing import fair_share
from zsched.core.gateway.shortfall import is_short
from zsched.core.scheduler.links import pair_link, ways
from zsched.core.scheduler.utility import (
    cpu_utility,
    memory_service,
    memory_utility,
    on_time,
    predicted_use,
    service_utility,
    spare_factor,
    total_utility,
)
from zsched.core.values.fleet import Demand, Standby, TaskSpec
from zsched.core.values.gauges import BY_NAME, possible
from zsched.core.values.model import (
    Aggregate,
    Allocation,
    NodeId,
    PeerState,
    Reach,
    ScoreForm,
    TaskId,
    Tuning,
    Utility,
    UtilityVector,
)
from zsched.core.values.profile import Profile, WorkerLoad, WorkerState
from zsched.core.values.quorum import majority
from zsched.core.values.struct import Struct, field, replace
from zsched.core.values.words import GaugeName

Bookings = Mapping[NodeId, tuple[TaskSpec, ...]]
"""{owner: its tasks}: of a task that has just come, profiles show nothing yet."""


def rounded(aggregate: float) -> float:
    """An aggregate to 1/256: sums of floats differ by their order, and a difference that small decides nothing."""
    return round(aggregate * 256) / 256


# --- score: one robot's view (Calculate_Utility) ---------------------------------------------------------------------


class _Terms(Struct, frozen=True):
    """Eq. 1-3 for one candidate; ``None`` where the metric is not measured. Of the gauges the weighed ones."""

    cpu: float | None
    memory: float | None
    network: float | None
    gauges: Mapping[str, float]

    def names(self) -> frozenset[str]:
        """The measured metrics."""
        three = {"cpu": self.cpu, "memory": self.memory, "network": self.network}
        return frozenset((*(name for name, term in three.items() if term is not None), *self.gauges))


class Doubts(Struct, frozen=True, kw_only=True):
    """Doubts about nodes that are too young, or not enough, to take a task from them."""

    in_grace: AbstractSet[NodeId] = frozenset()
    """Suspect, but not for long enough to tell a lost beat from a lost node: an owner among them counts as alive."""
    unproven: Mapping[NodeId, str] = field(default_factory=dict)
    """{candidate: why it may not get the task} of those that were gone (`zsched.core.scheduler.probation`)."""
    unseen: AbstractSet[NodeId] = frozenset()
    """Not reached by this robot's streams, though by its questions (`zsched.core.scheduler.unseen`)."""
    unfit: Mapping[NodeId, str] = field(default_factory=dict)
    """{candidate: why it may not have the task, though it has it} of an exclusive task (`zsched.core.vote.lease`)."""


NO_DOUBTS = Doubts()
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
    penalties: Mapping[NodeId, float] = NOTHING_HELD,
    round_trips: Mapping[NodeId, float] = NOTHING_HELD,
) -> UtilityVector:
    """This robot's utilities of a task's candidates, by the tuning of ``allocation``.

    A candidate that this robot cannot reach gets 0 (not: is left out, which would raise its mean); one that may not
    have the task is refused with the reason. Where there are ``doubts`` about a node, it keeps
    what it has and gets nothing new. What the other tasks of ``bookings`` will use there, and do not show yet, counts
    as in use. ``penalties`` are what this robot remembers; they go along, and `compare` joins them. ``round_trips`` are
    seconds to each candidate and back, where measured (`zsched.core.gateway.round_trips`).
    """
    form = allocation.tuning.score
    away_s = NOTHING_HELD
    if allocation.tuning.deadline_ms is not None:
        away_s = ways(voter, spec.candidates, round_trips, gateway, now)
    terms: dict[NodeId, _Terms] = {}
    unreachable: list[NodeId] = []
    refused: list[tuple[NodeId, str]] = []
    for candidate in spec.candidates:
        state = states.get(candidate, PeerState.UNKNOWN)
        if state is PeerState.UNKNOWN:
            refused.append((candidate, "not heard yet"))  # we may have just started: that says nothing about it
            continue
        is_spared = candidate == allocation.owner and candidate in doubts.in_grace
        if (state is not PeerState.ALIVE and not is_spared) or candidate in doubts.unseen:
            unreachable.append(candidate)
            continue
        if candidate in doubts.unfit:
            refused.append((candidate, doubts.unfit[candidate]))
            continue
        if candidate in doubts.unproven and candidate != allocation.owner:
            refused.append((candidate, doubts.unproven[candidate]))
            continue
        profile = gateway.fresh(candidate, now)
        if profile is None:
            refused.append((candidate, "no fresh profile"))
            continue
        load = profile.worker(spec.name)
        demand, unseen = gateway.demand(spec, profile), _unseen(spec, profile, bookings, gateway)
        own = _own(spec, allocation, profile, demand)
        use = _predicted(profile, own, demand, unseen)
        gauges = _readings(spec, allocation, profile, gateway, _coming_gpu(spec, profile, bookings, gateway, now))
        reason = _refusal(spec, allocation, profile, demand, use, gauges)
        if reason:
            refused.append((candidate, reason))
            continue
        link = pair_link(voter, candidate, gateway, spec.limits, now)
        if link is not None and not link.is_reached:
            unreachable.append(candidate)
            continue
        fair = gateway.share(spec, profile, demand.cpu_cores, unseen.cpu_cores)
        # what an owner that is short gets is measured
        is_measured = candidate == allocation.owner and load is not None and is_short(load)
        least = min(fair, own.cpu_cores) if is_measured else fair
        network_s = away_s.get(candidate, 0.0)
        cpu = _cpu(spec, profile, demand, use, allocation.tuning, gateway.demands, network_s, least, fair)
        memory = _memory(spec, profile, demand, use, form)
        weighed = _gauges(allocation, gauges)
        terms[candidate] = _Terms(cpu, memory, None if link is None else link.utility, weighed)
    _spare_gpu(spec, allocation, terms)
    if len(terms) > 1 and all(term.network is None for name, term in terms.items() if name != voter):
        # A robot always reaches itself: nobody measures that.
        terms = {name: replace(term, network=None) for name, term in terms.items()}
    measured = frozenset[str]().union(*(term.names() for term in terms.values()))
    utilities = [Utility(candidate=name, value=0.0, reachable=False) for name in unreachable]
    for candidate, term in terms.items():
        assumed = {name: 1.0 for name in sorted(measured - term.names()) if name in BY_NAME and _is_assumed(name)}
        by_gauge = {**term.gauges, **assumed}
        value = total_utility(
            allocation.tuning.weights,
            cpu=term.cpu,
            memory=term.memory,
            network=term.network,
            measured=measured,
            form=form,
            gauges=by_gauge,
        )
        if value is None:
            refused.append((candidate, "a weighted metric is not measured"))
            continue
        utilities.append(
            Utility(
                candidate=candidate,
                value=value,
                cpu=term.cpu,
                memory=term.memory,
                network=term.network,
                gauges=tuple(sorted(by_gauge.items())),
            )
        )
    return UtilityVector(
        voter=voter,
        task=spec.name,
        revision=allocation.revision,
        utilities=tuple(sorted(utilities, key=lambda utility: utility.candidate)),
        refused=tuple(sorted(refused)),
        penalties=tuple(sorted((name, round(penalty, 4)) for name, penalty in penalties.items())),
    )


_NOTHING = Demand()


def book(specs: Iterable[TaskSpec], values: Mapping[TaskId, Allocation]) -> Bookings:
    """{owner: its tasks}; empty with a single task."""
    booked: dict[NodeId, tuple[TaskSpec, ...]] = {}
    specs = tuple(specs)
    for spec in specs if len(specs) > 1 else ():
        owner = values[spec.name].owner
        if owner is not None:
            booked[owner] = (*booked.get(owner, ()), spec)
    return booked


def _unseen(spec: TaskSpec, profile: Profile, bookings: Bookings | None, gateway: Gateway) -> Demand:
    """What other tasks will use on a node beyond what its profile shows of their workers.

    A worker that somebody else started never shows what it uses, so it is in the profile already, or nowhere. What a
    worker visibly lacks on a full machine is no coming use: it will not get it there while that lasts.
    """
    others = () if bookings is None else bookings.get(profile.node, ())
    if not others:
        return _NOTHING
    cpu = memory = 0.0
    for other in others:
        load = profile.worker(other.name)
        if other.name != spec.name and load is not None:
            demand = gateway.demand(other, profile)
            if not (is_full(profile) and is_short(load)):
                cpu += max(demand.cpu_cores - (load.cpu_cores or 0.0), 0.0)
            memory += max(demand.memory_mb - (load.memory_mb or 0.0), 0.0)
    return Demand(cpu_cores=cpu, memory_mb=memory)


class _Use(Struct, frozen=True):
    """What would be in use on a node if it had the task; ``None`` where the node does not measure it."""

    cpu_cores: float | None
    memory_mb: float | None


def _predicted(profile: Profile, own: Demand, demand: Demand, unseen: Demand) -> _Use:
    cpu, memory = profile.cpu_used_cores, profile.memory_used_mb
    return _Use(
        cpu_cores=None if cpu is None else predicted_use(cpu + unseen.cpu_cores, own.cpu_cores, demand.cpu_cores),
        memory_mb=None if memory is None else predicted_use(memory + unseen.memory_mb, own.memory_mb, demand.memory_mb),
    )


def _own(spec: TaskSpec, allocation: Allocation, profile: Profile, demand: Demand) -> Demand:
    """What of a node's use is the task's own.

    Nobody measures a worker that somebody else started. At the owner its demand is taken for its use, or the owner
    would look worse by the task's own work. So is a demand of memory, whatever is measured: not all of it shows in the
    worker's processes (a GPU's, where that is the machine's, or files that it maps), and no machine could keep a task
    whose memory counts twice there. Eq. 2 goes by what shows.
    """
    load = profile.worker(spec.name)
    cpu, memory = (None, None) if load is None else (load.cpu_cores, load.memory_mb)
    is_at_work = profile.node == allocation.owner and (load is None or load.state is WorkerState.READY)
    if cpu is None:
        cpu = _likely_cores(profile, load, demand) if is_at_work else 0.0
    if is_at_work and (memory is None or allocation.tuning.score is ScoreForm.SERVICE):
        memory = max(memory or 0.0, min(profile.memory_used_mb or 0.0, demand.memory_mb))
    return Demand(cpu_cores=cpu, memory_mb=memory or 0.0)


def _likely_cores(profile: Profile, load: WorkerLoad | None, demand: Demand) -> float:
    """What a worker without a figure uses at the owner: its demand, as far as the machine gives it that."""
    use = profile.cpu_used_cores or 0.0
    if load is not None and load.jobs is not None and is_short(load):
        return min(load.jobs.done_hz * load.jobs.cpu_s, use)
    if profile.runnable is None:
        return min(demand.cpu_cores, use)
    others = max(profile.runnable - demand.cpu_cores, 0.0)
    return min(demand.cpu_cores, use, fair_share(profile.cpu_cores, max(demand.cpu_cores, 1.0), others))


def is_out(spec: TaskSpec, profile: Profile) -> bool:
    """Whether a node cannot have the task until an operator or a restart changes something there."""
    load = profile.worker(spec.name)
    return profile.draining or (load is not None and load.state is WorkerState.FAILED)


def may_get(spec: TaskSpec, state: WorkerState | None) -> bool:
    """Whether a node that is not the owner may get the task by its worker there; ``None``: no worker is known.

    What somebody else starts is there or is not, cold or warm.
    """
    if state is None:
        return not spec.worker.command
    starts_then = bool(spec.worker.command) and spec.worker.standby is Standby.COLD
    return state is WorkerState.READY or (starts_then and state is not WorkerState.FAILED)


def _refusal(
    spec: TaskSpec,
    allocation: Allocation,
    profile: Profile,
    demand: Demand,
    use: _Use,
    gauges: Mapping[GaugeName, float],
) -> str:
    """Why the node may not have the task; empty when it may."""
    if profile.draining:
        return "draining"
    load = profile.worker(spec.name)
    state = None if load is None else load.state
    if spec.worker.command and state is None:
        return "runs no worker for it"
    why = "" if load is None or not load.reason else f": {load.reason}"
    if state is WorkerState.FAILED:
        return f"worker failed{why}"
    is_owner = profile.node == allocation.owner
    if not is_owner and not may_get(spec, state):
        return f"worker {state}{why}"
    used = use.memory_mb
    if used is not None and used > profile.memory_mb:
        return f"needs {demand.memory_mb:.0f} MiB, has {max(profile.memory_mb - used + demand.memory_mb, 0.0):.0f} free"
    return _beyond_limits(spec, profile, gauges, is_owner=is_owner)


def _beyond_limits(spec: TaskSpec, profile: Profile, gauges: Mapping[GaugeName, float], *, is_owner: bool) -> str:
    """Why the machine's gauges forbid the task; empty: they do not.

    An owner whose GPU may be busy with the task alone, for all that is known, is not left for that.
    """
    told = dict(possible(profile.gauges)) if spec.gauge_limits else {}
    added = {"gpu"} if spec.demand.gpu and not is_owner else set[str]()
    limits = dict(spec.gauge_limits)
    if is_owner and "gpu" in limits and not spec.demand.gpu:
        limits["gpu"] = BY_NAME["gpu"].high
    faults = (
        BY_NAME[name].fault(
            gauges.get(name), limit, is_owner=is_owner, is_reckoned=name in added, is_old=name not in told
        )
        for name, limit in limits.items()
    )
    return next((fault for fault in faults if fault), "")


GPU_SHOWS_S = 6.0
"""So long after a task has come, its use of the GPU shows: three time constants of the gauges' means."""


def _coming_gpu(spec: TaskSpec, profile: Profile, bookings: Bookings | None, gateway: Gateway, now: float) -> float:
    """What other tasks will use of a node's GPU, beyond what shows: all that they ask for, until it must show.

    Else two of them that leave one GPU at the same moment find the other one idle, and go together, again and again.
    """
    others = () if bookings is None else bookings.get(profile.node, ())
    return sum(
        (
            other.demand.gpu
            for other in others
            if other.name != spec.name and not gateway.demands.has_been(other.name, profile.node, GPU_SHOWS_S, now)
        ),
        0.0,
    )


def _readings(
    spec: TaskSpec, allocation: Allocation, profile: Profile, gateway: Gateway, coming_gpu: float
) -> Mapping[GaugeName, float]:
    """The node's gauges, predicted as if it had the task; none where the task goes by none."""
    if not (spec.gauge_limits or allocation.tuning.weights.gauges):
        return {}
    readings, need = dict(gateway.readings(profile)), spec.demand.gpu
    if need and "gpu" in readings:  # by the fleet file: no driver tells which process uses how much
        own = need if profile.node == allocation.owner else 0.0
        readings["gpu"] = predicted_use(readings["gpu"] + coming_gpu, own, need)
    return readings


def _gauges(allocation: Allocation, gauges: Mapping[GaugeName, float]) -> dict[str, float]:
    """The terms of the weighed gauges that this node measures."""
    weighed = {name for name, _ in allocation.tuning.weights.gauges}
    return {name: BY_NAME[name].term(reading) for name, reading in gauges.items() if name in weighed}


def _spare_gpu(spec: TaskSpec, allocation: Allocation, terms: dict[NodeId, _Terms]) -> None:
    """Of a task whose use of the GPU nobody knows: let the owner's be worth as much as the best of the others'.

    Else it would look worse by the task's own work, which would follow the task wherever it goes (0120).
    """
    owner = allocation.owner
    if owner is None or owner not in terms or spec.demand.gpu:
        return
    own = terms[owner]
    if "gpu" in own.gauges:
        best = max(term.gauges["gpu"] for term in terms.values() if "gpu" in term.gauges)
        terms[owner] = replace(own, gauges={**own.gauges, "gpu": best})


def _is_assumed(name: str) -> bool:
    """Whether a node without this gauge counts as if it had the best reading."""
    return not BY_NAME[name].is_needed


def _cpu(
    spec: TaskSpec,
    profile: Profile,
    demand: Demand,
    use: _Use,
    tuning: Tuning,
    demands: Demands,
    network_s: float,
    least_cores: float,
    fair_cores: float,
) -> float | None:
    """Eq. 1, or the share of its jobs that the task would get done, in time where it has a deadline.

    ``least_cores``: it gets at least this if it needs it, however full the machine is. ``fair_cores``: a job gets at
    least this while it runs. Between its jobs a task uses nothing, so that may be far more than it needs on the mean.
    """
    used = use.cpu_cores
    if used is None:
        return None
    if tuning.score is ScoreForm.PAPER:
        return cpu_utility(profile.cpu_cores, used)
    free, job = profile.cpu_cores - used + demand.cpu_cores, demands.job_on(spec.name, profile.node)
    share, stretch = demands.shortfalls.of(spec.name, profile)
    share *= spare_factor(profile.cpu_cores - used, profile.cpu_cores, spec.cpu_floor_ratio)
    if job is None:
        return service_utility(free, demand.cpu_cores, profile.cpu_cores, least=least_cores, share=share)
    speed = demands.speed(spec.name, profile)
    if tuning.deadline_ms is not None:
        share *= on_time(stretch * job.age_s(speed, max(free, fair_cores)) + network_s, tuning.deadline_ms / 1e3)
    most = job.most_cores(speed)
    return service_utility(free, demand.cpu_cores, profile.cpu_cores, least=least_cores, most=most, share=share)


def _memory(spec: TaskSpec, profile: Profile, demand: Demand, use: _Use, form: ScoreForm) -> float | None:
    used_mb = use.memory_mb
    if used_mb is None:
        return None
    others_mb = used_mb - demand.memory_mb
    if form is ScoreForm.PAPER:
        return memory_utility(profile.memory_mb, demand.memory_mb, others_mb)
    free_mb = profile.memory_mb - others_mb
    return memory_service(free_mb, demand.memory_mb, profile.memory_mb, spec.memory_floor_ratio)


# --- compare: all robots' views (Compare_Utility) --------------------------------------------------------------------


class Standing(Struct, frozen=True, kw_only=True):
    """The joint view of one gather: ``aggregates`` without bonus, ``vetoed`` with reasons, and who was heard."""

    aggregates: Mapping[NodeId, float]
    vetoed: Mapping[NodeId, str]
    vectors: tuple[UtilityVector, ...]
    voters_heard: int
    penalties: Mapping[NodeId, float] = field(default_factory=dict)
    """{node: what is held against it}, by the robot that remembers most."""


def compare(spec: TaskSpec, allocation: Allocation, vectors: Mapping[NodeId, UtilityVector]) -> Standing:
    """Join the fresh voters' vectors column by column (Eq. 5-6: argmax over candidates of the aggregate over robots).

    Args:
        spec: the task.
        allocation: the current one; vectors under another revision are not counted.
        vectors: {voter: its vector}, the fresh ones only.
    """
    fresh = tuple(vectors[voter] for voter in sorted(vectors) if vectors[voter].revision == allocation.revision)
    columns: dict[NodeId, list[Utility]] = {candidate: [] for candidate in spec.candidates}
    reasons: dict[NodeId, str] = {}
    for vector in fresh:
        for candidate, utility in {utility.candidate: utility for utility in vector.utilities}.items():
            columns.setdefault(candidate, []).append(utility)  # once per voter, however often its vector names it
        reasons.update(vector.refused)
    mean = statistics.fmean if allocation.tuning.aggregate is Aggregate.MEAN else statistics.median
    vetoed: dict[NodeId, str] = {}
    kept: list[NodeId] = []
    for candidate in spec.candidates:
        column = columns[candidate]
        reaching = sum(utility.reachable for utility in column)
        needed = len(fresh) if spec.reach is Reach.ALL else majority(len(fresh))
        if len(column) < majority(len(fresh)) or len(column) == reaching < needed:
            # Not scored is not "not reached": only the latter is a reason to flee from an owner.
            vetoed[candidate] = reasons.get(candidate, "not scored by enough robots")
        elif reaching < needed:
            vetoed[candidate] = f"reached by {reaching} of {len(fresh)} robots"
        else:
            kept.append(candidate)
    return Standing(
        aggregates=_aggregates(kept, fresh, mean),
        vetoed=vetoed,
        vectors=fresh,
        voters_heard=len(fresh),
        penalties=joined(dict(vector.penalties) for vector in fresh),
    )


def counted(candidates: Iterable[NodeId], vectors: tuple[UtilityVector, ...]) -> tuple[UtilityVector, ...]:
    """The vectors that these candidates are compared by: of the robots that score all of them, if they are a majority.

    A robot that is far away gives low values. If it leaves out one candidate, for a doubt of its own, that one would
    gain by it, and the task move there and back with every doubt. Else all count, each for what it scores.
    """
    wanted = set(candidates)
    whole = tuple(one for one in vectors if wanted <= {utility.candidate for utility in one.utilities})
    return whole if len(whole) >= majority(len(vectors)) else vectors


def _aggregates(
    candidates: list[NodeId], vectors: tuple[UtilityVector, ...], mean: Callable[[list[float]], float]
) -> dict[NodeId, float]:
    told = [{one.candidate: one.value for one in vector.utilities} for vector in counted(candidates, vectors)]
    return {name: mean([values[name] for values in told if name in values]) for name in candidates}


def joined(penalties: Iterable[Mapping[NodeId, float]]) -> dict[NodeId, float]:
    """What any of them holds against a node, the most of it: forgetting (a restart) and not knowing say nothing.

    >>> joined([{"edge1": 0.09}, {}, {"edge1": 0.03, "edge2": 0.03}])
    {'edge1': 0.09, 'edge2': 0.03}
    """
    most: dict[NodeId, float] = {}
    for held in penalties:
        for name, penalty in held.items():
            most[name] = max(penalty, most.get(name, 0.0))
    return dict(sorted(most.items()))


def pick(aggregates: Mapping[NodeId, float], owner: NodeId | None) -> NodeId | None:
    """The candidate with the highest aggregate; ties (to 1/256) go to the owner, then to the lowest name."""
    if not aggregates:
        return None
    return min(aggregates, key=lambda name: (-rounded(aggregates[name]), name != owner, name))
