"""Fleets whose workers somebody else runs, and when those are away: the node sees them come and go, and starts none.

Knows: which schedules have such workers, when one ends and is back. Does not know: how a node sees a worker.
"""

from __future__ import annotations

from random import Random
from typing import Final

from zsched.core.values.fleet import Fleet, Standby, WorkerSpec
from zsched.core.values.model import NodeId
from zsched.core.values.plan import ReadyWhen
from zsched.core.values.struct import replace

SHARE: Final = 0.2
"""Of the schedules without an exclusive task."""
LONGEST_S: Final = 8.0
"""Longer than a start-up deadline in the simulator: the task must have moved by then, if it can."""


def with_foreign_workers(rng: Random, fleet: Fleet) -> Fleet:
    """The same fleet, in some schedules with workers that it does not start."""
    if any(task.exclusive for task in fleet.tasks) or rng.random() > SHARE:
        return fleet
    tasks = tuple(replace(task, worker=_foreign(task.worker)) for task in fleet.tasks)
    return replace(fleet, tasks=tasks)


def _foreign(worker: WorkerSpec) -> WorkerSpec:
    """One that somebody else runs, so it is warm: no file may have a cold one."""
    return replace(worker, command=(), ready_when=ReadyWhen.MATCHING, standby=Standby.WARM)


def absences(rng: Random, fleet: Fleet, until: float) -> list[tuple[float, NodeId, float]]:
    """(at, node, seconds) of the ends of its workers; none where the fleet starts its workers itself."""
    if all(task.worker.command for task in fleet.tasks):
        return []
    candidates = sorted({name for task in fleet.tasks for name in task.candidates})
    count = rng.randint(1, 2 * len(candidates))
    return [(rng.uniform(0.0, until), rng.choice(candidates), rng.uniform(0.05, LONGEST_S)) for _ in range(count)]
