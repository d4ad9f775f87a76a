"""GATEWAY: what others than a task use of a machine, and whether it is full.

Knows: profiles. Does not know: needs, speeds, time.
"""

from __future__ import annotations

from typing import Final

from zsched.core.values.model import TaskId
from zsched.core.values.profile import Profile

STARVED_CPU_RATIO: Final = 0.9
"""On a busier owner a task may get less than it wants: its use is only a lower bound of its need."""


def others_cores(task: TaskId, profile: Profile) -> float | None:
    """Cores that others than the task use on the node of ``profile``; ``None``: not measured."""
    used = profile.cpu_used_cores
    return None if used is None else max(used - profile.cores_of(task), 0.0)


def is_full(profile: Profile) -> bool:
    """Whether so little CPU is free that a task's use tells no more what it needs."""
    return profile.cpu_used_cores is not None and profile.cpu_used_cores / profile.cpu_cores >= STARVED_CPU_RATIO
