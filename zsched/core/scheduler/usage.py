"""SCHEDULER: what would be in use on a candidate that had the task: CPU, memory, gauges.

Knows: which use is the task's own, what other tasks will use there and do not show yet. Does not know: what that is
worth, who may have the task (`zsched.core.scheduler.eligibility`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from zsched.core.gateway.demand import Amount, Need
from zsched.core.gateway.gateway import Gateway
from zsched.core.gateway.sharing import fair_share
from zsched.core.gateway.shortfall import is_full, is_short
from zsched.core.scheduler.utility import predicted_use
from zsched.core.values.fleet import TaskSpec
from zsched.core.values.model import Allocation, NodeId, TaskId
from zsched.core.values.profile import MAX_CPU_CORES, MAX_MEMORY_MB, Profile, WorkerLoad, WorkerState
from zsched.core.values.struct import Struct
from zsched.core.values.words import GaugeName

Bookings = Mapping[NodeId, tuple[TaskSpec, ...]]
"""{owner: its tasks}: of a task that has just come, profiles show nothing yet."""

GPU_SHOWS_S = 3.0
"""Time constant with which a task's use of the GPU shows: that of the gauges' means, and they are read every 2 s."""
_NOTHING = Amount(cpu_cores=0.0, memory_mb=0.0)


def book(specs: Iterable[TaskSpec], values: Mapping[TaskId, Allocation]) -> Bookings:
    """{owner: its tasks}; empty with a single task."""
    booked: dict[NodeId, tuple[TaskSpec, ...]] = {}
    specs = tuple(specs)
    for spec in specs if len(specs) > 1 else ():
        owner = values[spec.name].owner
        if owner is not None:
            booked[owner] = (*booked.get(owner, ()), spec)
    return booked


def coming_use(
    spec: TaskSpec, profile: Profile, bookings: Bookings | None, gateway: Gateway, now: float, own: Amount | None
) -> Amount:
    """What other tasks will use on a node beyond what its profile shows of their workers.

    Of a worker that somebody else started no profile says what it uses. What it brings from another node is coming as
    far as the machine's means do not show it yet. What a worker visibly lacks on a full machine is no coming use: it
    will not get it there while that lasts.

    Memory that a worker holds and no process shows (a GPU's, where that is the machine's) is in use and would count
    twice. How much of what a task asks for is held like that nobody measures: at most what the machine has in use
    beyond the workers' processes. That much is not reserved against a task that has no other place, once the other's
    worker has had the time to take it; nor against a task that is there, which that would drive away.

    Args:
        spec: the task that is to be there.
        profile: the node's.
        bookings: which tasks nodes have.
        gateway: what tasks need.
        now: monotonic seconds.
        own: what of the node's use is the task's own; ``None``: it has a place elsewhere, so it can wait for room.
    """
    others = () if bookings is None else bookings.get(profile.node, ())
    if not others:
        return _NOTHING
    is_home = any(other.name == spec.name for other in others)
    cpu = memory = hidden_mb = 0.0
    for other in others:
        load = profile.worker(other.name)
        if other.name != spec.name and load is not None:
            # what it had come to use ended with it; what the file asks for stays reserved, but see below
            demand = other.demand if load.state is WorkerState.FAILED else gateway.demand(other, profile)
            unshown = 1.0 if other.worker.command else gateway.demands.unshown_ratio(other.name, profile.node, now)
            if other.priority < spec.priority:
                cpu -= load.cpu_cores or 0.0  # it gives way
            elif not (is_full(profile) and is_short(load)):
                cpu += unshown * max(demand.cpu_cores - (load.cpu_cores or 0.0), 0.0)
            unshown_mb = unshown * max(demand.memory_mb - (load.memory_mb or 0.0), 0.0)
            is_working = other.worker.command and load.state is WorkerState.READY
            if own is not None and is_working and (is_home or gateway.demands.holds_all(other.name, profile.node, now)):
                hidden_mb += unshown_mb
            else:
                memory += unshown_mb
    if own is not None and hidden_mb > 0.0:
        memory += max(hidden_mb - _unseen_mb(spec, profile, own), 0.0)
    return Amount(cpu_cores=min(cpu, MAX_CPU_CORES), memory_mb=min(memory, MAX_MEMORY_MB))


def _unseen_mb(spec: TaskSpec, profile: Profile, own: Amount) -> float:
    """Memory in use that no worker's processes show, without the task's ``own``."""
    shown_mb = sum(load.memory_mb or 0.0 for load in profile.workers)
    load = profile.worker(spec.name)
    own_mb = max(own.memory_mb - (0.0 if load is None else load.memory_mb or 0.0), 0.0)
    return max((profile.memory_used_mb or 0.0) - shown_mb - own_mb, 0.0)


class Use(Struct, frozen=True):
    """What would be in use on a node if it had the task; ``None`` where the node does not measure it."""

    cpu_cores: float | None
    memory_mb: float | None


def predicted(profile: Profile, own: Amount, demand: Need, coming: Amount) -> Use:
    """What would be in use on the node with the task, of which ``own`` is in use now, and with what is ``coming``."""
    cpu, memory = profile.cpu_used_cores, profile.memory_used_mb
    return Use(
        cpu_cores=None if cpu is None else predicted_use(cpu + coming.cpu_cores, own.cpu_cores, demand.cpu_cores),
        memory_mb=None if memory is None else predicted_use(memory + coming.memory_mb, own.memory_mb, demand.memory_mb),
    )


def own_use(spec: TaskSpec, allocation: Allocation, profile: Profile, demand: Need, gateway: Gateway) -> Amount:
    """What of a node's use is the task's own.

    Nobody measures a worker that somebody else started. At the owner its demand is taken for its use, or the owner
    would look worse by the task's own work. So is a demand of memory, whatever is measured: not all of it shows in the
    worker's processes (a GPU's, where that is the machine's, or files that it maps), and no machine could keep a task
    whose memory counts twice there.
    """
    load = profile.worker(spec.name)
    cpu, memory = (None, None) if load is None else (load.cpu_cores, load.memory_mb)
    is_at_work = profile.node == allocation.owner and (load is None or load.state is WorkerState.READY)
    if cpu is None:
        cpu = _likely_cores(spec, profile, load, demand, gateway) if is_at_work else 0.0
    if is_at_work:
        memory = max(memory or 0.0, min(profile.memory_used_mb or 0.0, demand.memory_mb))
    return Amount(cpu_cores=cpu, memory_mb=memory or 0.0)


def _likely_cores(spec: TaskSpec, profile: Profile, load: WorkerLoad | None, demand: Need, gateway: Gateway) -> float:
    """What a worker without a figure uses at the owner: its demand, as far as the machine gives it that."""
    use = profile.cpu_used_cores or 0.0
    if load is not None and load.jobs is not None and is_short(load):
        return min(load.jobs.done_hz * load.jobs.cpu_s, use)
    threads = gateway.shares.beside_unmeasured(spec.name, profile, demand.cpu_cores)
    if threads is None:
        return min(demand.cpu_cores, use)
    own, others = threads
    return min(demand.cpu_cores, use, fair_share(profile.cpu_cores, max(own, 1.0), others))


def _coming_gpu(spec: TaskSpec, profile: Profile, bookings: Bookings | None, gateway: Gateway, now: float) -> float:
    """What other tasks will use of a node's GPU, beyond what shows: what they ask for, as far as it cannot show yet.

    Else two of them that leave one GPU at the same moment find the other one idle, and go together, again and again.
    """
    others = () if bookings is None else bookings.get(profile.node, ())
    demands = gateway.demands
    coming = (
        other.demand.gpu * demands.unshown_ratio(other.name, profile.node, now, GPU_SHOWS_S)
        for other in others
        if other.name != spec.name and not profile.has_failed(other.name)
    )
    return sum(coming, 0.0)


def predicted_gauges(
    spec: TaskSpec,
    allocation: Allocation,
    profile: Profile,
    bookings: Bookings | None,
    gateway: Gateway,
    now: float,
) -> Mapping[GaugeName, float]:
    """The node's gauges as if it had the task, with what is coming of other tasks' use of its GPU.

    None where the task goes by none. An owner keeps what it has: there what shows counts.
    """
    if not (spec.gauge_limits or allocation.tuning.weights.gauges):
        return {}
    readings, need = dict(gateway.readings(profile)), spec.demand.gpu
    if need and "gpu" in readings:  # by the fleet file: no driver tells which process uses how much
        is_owner = profile.node == allocation.owner
        own, coming = (need, 0.0) if is_owner else (0.0, _coming_gpu(spec, profile, bookings, gateway, now))
        readings["gpu"] = predicted_use(readings["gpu"] + coming, own, need)
    return readings
