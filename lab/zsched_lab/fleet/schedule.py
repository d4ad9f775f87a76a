"""Decides when load is injected, and where: a seeded schedule, the same for every run with the same seed.

Knows: windows of time, targets, seeds. Does not know: processes, cgroups, or who owns the task.
"""

from __future__ import annotations

import random
from dataclasses import dataclass
from enum import StrEnum

from zsched.core.values.model import NodeId
from zsched.core.values.words import check_range


class SchedulePolicy(StrEnum):
    """``push``: each window loads the node that owns the task then; ``random``: nodes are drawn beforehand."""

    PUSH = "push"
    RANDOM = "random"


@dataclass(frozen=True, slots=True, kw_only=True)
class Injection:
    """One window of load, in seconds since the run began; ``target`` ``None`` is "the task's owner at that moment"."""

    start_s: float
    end_s: float
    target: NodeId | None
    threads: int = 1

    def __post_init__(self) -> None:
        check_range("injection.start_s", self.start_s, 0.0, 86400.0)
        check_range("injection.end_s", self.end_s, self.start_s, 86400.0)


PUSH_START_RATIO = 0.14
"""The first push: late enough for a first merged map to be seen."""
PUSH_END_RATIO = 0.92
"""No push begins so late that its move would not be seen."""
PUSH_PERIOD_S = 15.0
"""From push to push at least: the load, and some seconds to look at what came of it."""
PUSH_LENGTH_S = 12.0
JITTER_S = 1.0


def push_schedule(duration_s: float, seed: int, threads: int = 1) -> tuple[Injection, ...]:
    """Windows that each load the then owner: as many as fit with `PUSH_PERIOD_S`, at least two, jittered by the seed.

    In a run shorter than 45 s the windows move together.
    """
    generator = random.Random(seed)
    first, last = PUSH_START_RATIO * duration_s, PUSH_END_RATIO * duration_s
    count = max(2, int((last - first) / PUSH_PERIOD_S))
    period = (last - first) / count
    jitter = min(JITTER_S, 0.1 * period)
    length = min(PUSH_LENGTH_S, period - jitter)
    windows = []
    for index in range(count):
        start = first + index * period + generator.uniform(0.0, jitter)
        windows.append(Injection(start_s=start, end_s=min(start + length, duration_s), target=None, threads=threads))
    return tuple(windows)


def random_schedule(duration_s: float, seed: int, nodes: tuple[NodeId, ...], threads: int = 1) -> tuple[Injection, ...]:
    """Windows of 6 to 15 s on nodes drawn uniformly (the paper injects "randomly"); one at a time, the seed decides.

    Raises `ValueError` when there are no nodes to load.
    """
    if not nodes:
        raise ValueError("nodes: there is none to load")
    generator = random.Random(seed)
    windows = []
    start = PUSH_START_RATIO * duration_s + generator.uniform(0.0, 2.0)
    while start < PUSH_END_RATIO * duration_s:
        end = min(start + generator.uniform(6.0, 15.0), duration_s)
        windows.append(Injection(start_s=start, end_s=end, target=generator.choice(sorted(nodes)), threads=threads))
        start = end + generator.uniform(1.0, 6.0)
    return tuple(windows)


def make_schedule(
    policy: SchedulePolicy, duration_s: float, seed: int, nodes: tuple[NodeId, ...], threads: int = 1
) -> tuple[Injection, ...]:
    """The schedule of ``policy`` for a run of ``duration_s`` seconds."""
    if policy is SchedulePolicy.RANDOM:
        return random_schedule(duration_s, seed, nodes, threads)
    return push_schedule(duration_s, seed, threads)
