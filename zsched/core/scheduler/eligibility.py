"""SCHEDULER: whether a node may have a task, and which filter keeps it out.

Knows: the chain of filters: leases, workers' states, memory that is not there, gauges' limits. Does not know: what the
node is worth (`zsched.core.scheduler.scoring`), who reaches it, what others say (`zsched.core.scheduler.standing`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from collections.abc import Set as AbstractSet
from typing import Final

from zsched.core.scheduler.usage import Use
from zsched.core.values.fleet import Standby, TaskSpec
from zsched.core.values.gauges import BY_NAME, possible
from zsched.core.values.model import NodeId, PeerState
from zsched.core.values.profile import Profile, Renewal, WorkerState
from zsched.core.values.struct import Struct, field
from zsched.core.values.veto import Filter, Veto
from zsched.core.values.words import GaugeName


def is_out(spec: TaskSpec, profile: Profile) -> bool:
    """Whether a node cannot have the task until an operator or a restart changes something there."""
    return profile.draining or profile.has_failed(spec.name)


def has_living_owner(spec: TaskSpec, owner_state: PeerState, profile: Profile | None, *, is_spared: bool) -> bool:
    """Whether a task has an owner that lives, and whose worker has not failed, for all that is known of it.

    Args:
        spec: the task.
        owner_state: how the owner is seen; nobody's is unknown.
        profile: the owner's newest fresh one.
        is_spared: it counts as alive though it is silent.
    """
    is_down = profile is not None and profile.has_failed(spec.name)
    return (owner_state is PeerState.ALIVE or is_spared) and not is_down


def may_return(spec: TaskSpec, profile: Profile | None) -> bool:
    """Whether a task that left its owner might soon come back, for all that the owner tells: then margins count.

    Not to one that stops or gives it away. ``profile``: its newest fresh one.
    """
    if profile is None:
        return True
    load = profile.worker(spec.name)
    return not profile.draining and (load is None or load.renewal is not Renewal.LEAVES)


def may_get(spec: TaskSpec, state: WorkerState | None) -> bool:
    """Whether a node that is not the owner may get the task by its worker there; ``None``: no worker is known.

    What somebody else starts is there or is not, cold or warm.
    """
    if state is None:
        return not spec.worker.command
    if state is WorkerState.READY:
        return True
    return bool(spec.worker.command) and spec.worker.standby is Standby.COLD and state is not WorkerState.FAILED


class Doubts(Struct, frozen=True, kw_only=True):
    """Doubts about nodes that are too young, or not enough, to take a task from them."""

    in_grace: AbstractSet[NodeId] = frozenset()
    """Suspect, but not for long enough to tell a lost beat from a lost node: an owner among them counts as alive."""
    unproven: Mapping[NodeId, str] = field(default_factory=dict)
    """{candidate: why it may not get the task} of those that were gone (`zsched.core.scheduler.probation`)."""
    unseen: AbstractSet[NodeId] = frozenset()
    """Not reached by this robot's streams, though by its questions (`zsched.core.scheduler.unseen`)."""
    left: AbstractSet[NodeId] = frozenset()
    """They are to hand over the task (an operator's order, a worker that is not ready in time): an owner among them
    does not get it back."""
    unfit: Mapping[NodeId, Veto] = field(default_factory=dict)
    """{candidate: why it may not have the task, though it has it} of an exclusive task (`zsched.core.vote.lease`)."""


NO_DOUBTS = Doubts()


class Case(Struct, frozen=True, kw_only=True):
    """One candidate as one robot sees it."""

    spec: TaskSpec
    node: NodeId
    is_owner: bool
    state: PeerState
    doubts: Doubts = NO_DOUBTS
    profile: Profile | None = None
    """Its newest fresh one."""
    needed_mb: float = 0.0
    """Memory without which the task is not placed there."""
    use: Use = Use(cpu_cores=None, memory_mb=None)
    """What will be in use there, ``needed_mb`` included."""
    gauges: Mapping[GaugeName, float] = field(default_factory=dict)
    """What its gauges will read."""
    is_kept: bool = True
    """The owner keeps the task, or may have it back (`may_return`)."""


def _heard(case: Case) -> str:
    return "not heard yet" if case.state is PeerState.UNKNOWN else ""  # we may have just started


def _lease(case: Case, which: Filter = Filter.LEASE) -> str:
    veto = case.doubts.unfit.get(case.node)
    return veto.why if veto is not None and veto.filter is which else ""


def _rests(case: Case) -> str:
    """Beats tell who hears whom, but of an elector that this node does not hear nothing: its owner knows better."""
    is_resting = case.is_owner and case.profile is not None and case.profile.rests(case.spec.name)
    return "it says that it has no lease" if is_resting else ""


def _streams(case: Case) -> str:
    return "" if case.is_owner else case.doubts.unproven.get(case.node, "")


def _worker(case: Case) -> str:
    """Why its worker cannot do the task."""
    load = None if case.profile is None else case.profile.worker(case.spec.name)
    if load is None:
        return "runs no worker for it" if case.spec.worker.command else ""
    if may_get(case.spec, load.state):
        return ""
    why = f"worker {load.state}{': ' if load.reason else ''}{load.reason}"
    return "" if case.is_owner and load.state is not WorkerState.FAILED else why


def _memory(case: Case) -> str:
    return "" if case.profile is None else lacks_memory(case.profile, case.needed_mb, case.use)


Check = Callable[[Case], str]
CHAIN: dict[Filter, Check] = {
    Filter.HEARD: _heard,
    Filter.LEASE: _lease,
    Filter.TERMS: lambda case: _lease(case, Filter.TERMS),
    Filter.RESTS: _rests,
    Filter.STREAMS: _streams,
    Filter.PROFILE: lambda case: "" if case.profile is not None else "no fresh profile",
    Filter.DRAIN: lambda case: "draining" if case.profile is not None and case.profile.draining else "",
    Filter.WORKER: _worker,
    Filter.MEMORY: _memory,
    Filter.LIMIT: lambda case: _beyond_limits(case, has_margin=False),
    # a task that nobody keeps goes to a machine inside the margin, too: it could move back to no other one
    Filter.MARGIN: lambda case: _beyond_limits(case, has_margin=True) if case.is_kept and not case.is_owner else "",
}
"""What one robot looks at by itself, in order: {filter: why it keeps the candidate out, or nothing}."""


def chain_of(spec: TaskSpec, doubts: Doubts) -> list[tuple[Filter, Check]]:
    """`CHAIN` without the filters that keep out no node of these, whatever its profile."""
    idle = [
        *(() if doubts.unfit else (Filter.LEASE, Filter.TERMS)),
        *(() if doubts.unproven else (Filter.STREAMS,)),
        *(() if spec.gauge_limits else (Filter.LIMIT, Filter.MARGIN)),
    ]
    return [(name, check) for name, check in CHAIN.items() if name not in idle]


def veto(case: Case, chain: Iterable[tuple[Filter, Check]]) -> Veto | None:
    """Why the node may not have the task; ``None``: it may, as far as one robot sees."""
    for name, check in chain:
        if why := check(case):
            return Veto(name, why)
    return None


def lacks_memory(profile: Profile, needed_mb: float, use: Use) -> str:
    """Why the machine's memory cannot hold ``use``, of which ``needed_mb`` is the task's; empty when it can."""
    used = use.memory_mb
    if used is None or used <= profile.memory_mb:
        return ""
    return f"needs {needed_mb:.0f} MiB, has {max(profile.memory_mb - used + needed_mb, 0.0):.0f} free"


FOR_COMERS: Final = frozenset({Filter.MEMORY, Filter.MARGIN})
"""They may go by what counts only while the task has an owner: learnt memory, a gauge's margin."""
OF_MACHINE: Final = frozenset({Filter.MEMORY, Filter.LIMIT, Filter.MARGIN})
"""What a machine lacks: memory, or a gauge within its limit."""


def is_far_beyond(spec: TaskSpec, gauges: Mapping[GaugeName, float]) -> bool:
    """Whether an owner is beyond a limit by more than its margin: a machine just inside is better, and not for long.

    Whatever is nearer to the limit than that would soon be left for it again.
    """
    return any(BY_NAME[name].is_far_beyond(gauges.get(name), limit) for name, limit in _limits(spec))


def _limits(spec: TaskSpec) -> Iterator[tuple[GaugeName, float]]:
    """Where nothing says how much of a GPU the task uses, a limit of the GPU only asks for one."""
    for name, limit in spec.gauge_limits:
        yield name, limit if name != "gpu" or spec.demand.gpu else BY_NAME[name].high


def _beyond_limits(case: Case, *, has_margin: bool) -> str:
    """Why the machine's gauges forbid the task; empty: they do not."""
    if case.profile is None:
        return ""
    spec, told = case.spec, dict(possible(case.profile.gauges))
    faults = (
        BY_NAME[name].fault(
            case.gauges.get(name),
            limit,
            has_margin=has_margin,
            is_reckoned=name == "gpu" and bool(spec.demand.gpu) and not case.is_owner,
            is_old=name not in told,
        )
        for name, limit in _limits(spec)
    )
    return next((fault for fault in faults if fault), "")
