"""Profiles of nodes and loads of workers, with what a test does not care about filled in."""

from __future__ import annotations

from typing import Any

from zsched.core.values.model import NodeId, TaskId
from zsched.core.values.profile import DeviceSample, Profile, WorkerLoad, WorkerState

USUAL: dict[str, Any] = {
    "incarnation": 1,
    "sequence": 1,
    "cpu_cores": 4.0,
    "cpu_used_cores": 1.0,
    "memory_mb": 4000.0,
    "memory_used_mb": 1000.0,
}
SAMPLE = DeviceSample(cpu_cores=4.0, cpu_used_cores=1.0, memory_mb=4000.0, memory_used_mb=1000.0)
"""What such a node measures of itself."""


def profile_of(node: NodeId = "edge1", **options: Any) -> Profile:
    """A node of 4 cores and 4000 MiB, a quarter of both used; it runs no worker."""
    return Profile(node=node, **{**USUAL, **options})


def load_of(task: TaskId = "merge", state: WorkerState = WorkerState.READY, **options: Any) -> WorkerLoad:
    """A task's worker; nobody has measured what it uses."""
    return WorkerLoad(task=task, state=state, **options)
