"""GATEWAY: how fast a task's own work goes on each machine: the benchmark's speed, corrected by what was seen there.

Knows: ratios of a task's speed to the benchmark's. Does not know: needs, owners, time.

A benchmark of one kind of work says little of another kind (memory-bound, vectorised). As long as only it counts, the
same task needs something else by each owner's figures, and two machines may hand it to each other for ever: from either
one the other one looks better (docs/decisions/0118).
"""

from __future__ import annotations

from collections.abc import Container
from typing import Final

from zsched.core.gateway.company import Company
from zsched.core.values.model import NodeId, TaskId
from zsched.core.values.profile import Profile
from zsched.core.values.struct import Struct

MOST_RATIO: Final = 8.0
"""A task is at most so many times as fast or slow as the benchmark says; beyond it some figure is wrong."""


class _Seen(Struct, frozen=True):
    """How a task's speed on a machine compares with the benchmark's."""

    ratio: float
    speed: float
    """The benchmark's: after another one this is void."""
    company: Company | None
    """Beside whom; ``None``: next to nobody, so it is the machine's own."""


class TaskSpeeds:
    """How fast tasks go on machines, as one node has seen it."""

    def __init__(self) -> None:
        self._seen: dict[tuple[TaskId, NodeId], _Seen] = {}

    def of(self, task: TaskId, profile: Profile, *, is_there: bool = False) -> float:
        """The task's speed on the node of ``profile``, > 0; the benchmark's where nothing else has been seen.

        Others slow a task down by more than the CPU that they take (caches, hyperthreads), so what was seen beside them
        counts while they use about as much. Where the task ``is_there`` it counts in any case: only a move measures it
        anew, and until then the need and this figure belong together.
        """
        speed, seen = speed_of(profile), self._seen.get((task, profile.node))
        if seen is None or seen.speed != speed:
            return speed
        is_same = seen.company is None or seen.company.is_still(task, profile)
        return speed * seen.ratio if is_there or is_same else speed

    def note(self, task: TaskId, profile: Profile, speed: float) -> None:
        """The task was seen to go at this speed on the node of ``profile``."""
        benchmark, company = speed_of(profile), Company.of(task, profile)
        if company is not None:
            ratio = min(max(speed / benchmark, 1.0 / MOST_RATIO), MOST_RATIO)
            is_own = company.is_next_to_nobody(profile)
            self._seen[task, profile.node] = _Seen(ratio, benchmark, None if is_own else company)

    def keep(self, nodes: Container[NodeId]) -> None:
        """Know nothing of other nodes."""
        self._seen = {key: seen for key, seen in self._seen.items() if key[1] in nodes}

    def forget(self, task: TaskId) -> None:
        """Know nothing of a task that is no more."""
        self._seen = {key: seen for key, seen in self._seen.items() if key[0] != task}


def speed_of(profile: Profile) -> float:
    """Speed of the node's cores; 1 where nobody has measured it."""
    return 1.0 if profile.speed is None else profile.speed
