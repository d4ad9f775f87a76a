"""GATEWAY, what a task needs where: learnt where it runs, scaled by speed to where it does not.

Knows: the difference between what a task uses and what it wants. Does not know: profiles' age, who is better.

A task's need is kept as *work*: cores of a machine of speed 1. Without it a task that was measured on a slow machine
seems too large for the fast ones, and the other way round; with one figure for all of them the view from every owner is
the same but for a common factor, so a constant fleet has no limit cycle.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from zsched.core.fleet import Demand, TaskSpec
from zsched.core.model import NodeId, Profile, TaskId, WorkerState

STARVED_CPU_RATIO = 0.9
"""On an owner busier than this a task may get less than it wants: what it uses is the least that it needs."""
UNSURE = 1.5
"""A worker that always wants to run and never had enough counts as needing so many times what it gets."""
SETTLE_S = 4.0
"""What a task uses still rises for so long after it has come, for the figures are smoothed: the least that it needs."""


@dataclass(frozen=True, slots=True)
class _Known:
    """What was learnt of a task; ``None``: nothing yet."""

    work: float | None = None
    is_sure: bool = False
    """It was measured where the task had all that it needs; otherwise the need may be larger."""
    memory_mb: float | None = None
    owner: NodeId | None = None
    since: float = 0.0
    """When it was first looked at there."""


class Demands:
    """What the tasks need, as one node has learnt it."""

    def __init__(self) -> None:
        self._known: dict[TaskId, _Known] = {}

    def learn(self, task: TaskId, profile: Profile, now: float) -> bool:
        """Note what the task's worker wants on its owner; whether that is news.

        What it uses is its need where CPU is left, and the least of it where none is. Where threads of it always want
        to run (`WorkerLoad.wanted_cores`), its need is what was measured when it had enough, if they would take that
        much; else a guess above what it gets, so that a machine that would give it more is seen to. A worker that is
        not ready, or a figure that nobody measured, changes nothing: the task does not cost less because its worker
        restarts.
        """
        load = profile.worker(task)
        if load is None or load.state is not WorkerState.READY or profile.cpu_used_cores is None:
            return False
        known = self._known.get(task, _Known())
        found = known if known.owner == profile.node else replace(known, owner=profile.node, since=now)
        is_new = now - found.since < SETTLE_S
        if load.memory_mb is not None:
            found = replace(found, memory_mb=max(load.memory_mb, (known.memory_mb or 0.0) if is_new else 0.0))
        if load.cpu_cores is not None:
            use, most = load.cpu_cores * speed_of(profile), (load.wanted_cores or 0.0) * speed_of(profile)
            least = max(use, known.work or 0.0)
            is_held = known.is_sure and known.work == least
            if most > use and not (is_held and least <= most):
                found = replace(found, work=min(UNSURE * use, most), is_sure=False)
            elif most > use or is_new or profile.cpu_used_cores / profile.cpu_cores >= STARVED_CPU_RATIO:
                found = replace(found, work=least, is_sure=is_held)
            else:
                found = replace(found, work=use, is_sure=True)
        self._known[task] = found
        return (found.work, found.memory_mb) != (known.work, known.memory_mb)

    def at(self, spec: TaskSpec, profile: Profile) -> Demand:
        """What the task will use on a node: the larger of the fleet file's figure and what was learnt."""
        known = self._known.get(spec.name, _Known())
        return Demand(
            cpu_cores=max(spec.demand.cpu_cores, (known.work or 0.0) / speed_of(profile)),
            memory_mb=max(spec.demand.memory_mb, known.memory_mb or 0.0),
        )


def speed_of(profile: Profile) -> float:
    """How fast one of the node's cores is; 1 where nobody has measured it."""
    return 1.0 if profile.speed is None else profile.speed
