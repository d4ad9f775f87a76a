"""GATEWAY: beside whom a task runs on a machine, and whether that is still so.

Knows: what others use of a machine, how large it is. Does not know: needs, speeds, time.
"""

from __future__ import annotations

from typing import Final, Self

from zsched.core.values.model import TaskId
from zsched.core.values.profile import Profile
from zsched.core.values.struct import Struct

STARVED_CPU_RATIO: Final = 0.9
"""On a busier owner a task may get less than it wants: its use is only a lower bound of its need."""
SAME_RATIO: Final = 0.1
"""Others are the same as long as their use differs by at most this share of the machine."""


class Company(Struct, frozen=True):
    """What others used on a machine beside a task."""

    others_cores: float
    taken_cores: float
    """What the task may have taken from them: its use of a full machine, else 0. They may use that, too, without it."""
    machine_cores: float

    @classmethod
    def of(cls, task: TaskId, profile: Profile) -> Self | None:
        """The task's company on the node of ``profile``; ``None``: nobody has measured it."""
        others = others_cores(task, profile)
        taken = profile.cores_of(task) if is_full(profile) else 0.0
        return None if others is None else cls(others, taken, profile.cpu_cores)

    def is_next_to_nobody(self, profile: Profile) -> bool:
        """Whether others use so little there that they slow nothing down."""
        return self.others_cores + self.taken_cores <= SAME_RATIO * profile.cpu_cores

    def is_still(self, task: TaskId, profile: Profile) -> bool:
        """Whether others use about as much as then, of as large a machine."""
        others, slack = others_cores(task, profile), SAME_RATIO * profile.cpu_cores
        if others is None or self.machine_cores != profile.cpu_cores:
            return False
        return -slack <= others - self.others_cores <= slack + self.taken_cores


def others_cores(task: TaskId, profile: Profile) -> float | None:
    """Cores that others than the task use on the node of ``profile``; ``None``: not measured."""
    used = profile.cpu_used_cores
    return None if used is None else max(used - profile.cores_of(task), 0.0)


def is_full(profile: Profile) -> bool:
    """Whether so little CPU is free that a task's use tells no more what it needs."""
    return profile.cpu_used_cores is not None and profile.cpu_used_cores / profile.cpu_cores >= STARVED_CPU_RATIO
