"""Values of a task's register, with what a test does not care about filled in."""

from __future__ import annotations

from typing import Any

from support.fleets import tuning_of
from zsched.core.values.model import Allocation, NodeId, TaskId


def allocation_of(
    revision: int = 1,
    owner: NodeId | None = "edge1",
    epoch: int | None = None,
    *,
    task: TaskId = "merge",
    **options: Any,
) -> Allocation:
    """A revision of the task; its epoch is the same number if none is given, its weights 0.5 for CPU and memory."""
    chosen = revision if epoch is None else epoch
    return Allocation(task=task, revision=revision, epoch=chosen, owner=owner, **{"tuning": tuning_of(), **options})
