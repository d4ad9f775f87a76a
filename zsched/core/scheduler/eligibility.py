"""SCHEDULER: whether a node may have a task, by its own profile, and why not.

Knows: workers' states, memory that is not there, gauges' limits. Does not know: what the node is worth
(`zsched.core.scheduler.scoring`), who reaches it, doubts.
"""

from __future__ import annotations

from collections.abc import Mapping

from zsched.core.scheduler.usage import Use
from zsched.core.values.fleet import Standby, TaskSpec
from zsched.core.values.gauges import BY_NAME, possible
from zsched.core.values.model import Allocation, PeerState
from zsched.core.values.profile import Profile, Renewal, WorkerState
from zsched.core.values.words import GaugeName

_NEEDS = "needs "
_BACK = ", back from "


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
    starts_then = bool(spec.worker.command) and spec.worker.standby is Standby.COLD
    return state is WorkerState.READY or (starts_then and state is not WorkerState.FAILED)


def refusal(
    spec: TaskSpec,
    allocation: Allocation,
    profile: Profile,
    needed_mb: float,
    use: Use,
    gauges: Mapping[GaugeName, float],
    *,
    is_kept: bool = True,
) -> str:
    """Why the node may not have the task; empty when it may.

    ``needed_mb``: memory without which the task is not placed, as it is part of ``use``. ``is_kept``: the owner keeps
    the task, or may have it back (`may_return`).
    """
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
    return lacks_memory(profile, needed_mb, use) or _beyond_limits(
        spec, profile, gauges, is_owner=is_owner, is_kept=is_kept
    )


def lacks_memory(profile: Profile, needed_mb: float, use: Use) -> str:
    """Why the machine's memory cannot hold ``use``, of which ``needed_mb`` is the task's; empty when it can."""
    used = use.memory_mb
    if used is None or used <= profile.memory_mb:
        return ""
    return f"{_NEEDS}{needed_mb:.0f} MiB, has {max(profile.memory_mb - used + needed_mb, 0.0):.0f} free"


def is_for_comers(reason: str) -> bool:
    """Whether a refusal may be by what counts only while the task has an owner: learnt memory, a gauge's margin.

    >>> [is_for_comers(why) for why in ("needs 6144 MiB, has 5120 free", "worker starting")]
    [True, False]
    """
    return reason.startswith(_NEEDS) or _BACK in reason


def is_far_beyond(spec: TaskSpec, gauges: Mapping[GaugeName, float]) -> bool:
    """Whether an owner is beyond a limit by more than its margin: a machine just inside is better, and not for long.

    Whatever is nearer to the limit than that would soon be left for it again.
    """
    return any(BY_NAME[name].is_far_beyond(gauges.get(name), limit) for name, limit in _owner_limits(spec).items())


def _owner_limits(spec: TaskSpec) -> dict[GaugeName, float]:
    """An owner whose GPU may be busy with the task alone, for all that is known, is not left for that."""
    limits = dict(spec.gauge_limits)
    if "gpu" in limits and not spec.demand.gpu:
        limits["gpu"] = BY_NAME["gpu"].high
    return limits


def is_of_machine(reason: str) -> bool:
    """Whether a refusal says what the machine lacks: memory, or a gauge within its limit.

    >>> [is_of_machine(why) for why in ("battery is at 18 %, limit 20 %", "no fresh profile")]
    [True, False]
    """
    return reason.startswith((_NEEDS, *(f"{name} " for name in BY_NAME)))


def _beyond_limits(
    spec: TaskSpec, profile: Profile, gauges: Mapping[GaugeName, float], *, is_owner: bool, is_kept: bool
) -> str:
    """Why the machine's gauges forbid the task; empty: they do not.

    A task that nobody keeps goes to a machine inside the margin, too: there is no other one that it could move back to.
    """
    told = dict(possible(profile.gauges)) if spec.gauge_limits else {}
    added = {"gpu"} if spec.demand.gpu and not is_owner else set[str]()
    limits = _owner_limits(spec) if is_owner else dict(spec.gauge_limits)
    faults = (
        BY_NAME[name].fault(
            gauges.get(name),
            limit,
            has_margin=is_kept and not is_owner,
            is_reckoned=name in added,
            is_old=name not in told,
        )
        for name, limit in limits.items()
    )
    return next((fault for fault in faults if fault), "")
