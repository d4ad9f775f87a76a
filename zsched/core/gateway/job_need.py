"""GATEWAY: what one job of a task takes, as its worker tells it, or as robots see it of a foreign one.

Knows: work and waits of a job, what of a time was which. Does not know: what a task needs on the mean
(`zsched.core.gateway.demand`), how answers are measured (`zsched.core.profile.answers`).

A foreign worker tells nothing. Its processes are measured, so CPU time per answer is known. The rest of an answer's
time is a wait for other things, if the owner has had CPU to spare for some seconds. On a full machine, and soon after,
the rest is also a wait for a CPU. There the wait for other things counts as it was seen before, and what an answer
takes longer than foreseen is remembered of that machine. Elsewhere it is what was seen there
(`zsched.core.gateway.queueing`), and the owner's until then.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterable

from zsched.core.values.model import NodeId, TaskId
from zsched.core.values.profile import AnswerTime, Jobs, Profile
from zsched.core.values.struct import Struct

CALM_WAIT_RATIO = 0.1
"""Jobs that wait for a CPU for a smaller part of their time show their usual wait in the queue."""
QUEUE_RATIO = 2.0
"""Until that was seen, a job's age counts as at most this many times its own time."""
LEAST_FREE_CORES = 0.05
"""A job on a full machine gets at least this much, so that its time is finite."""
CALM_S = 6.0
"""For so long the machine must have had CPU to spare: answers' time is a mean that follows later than the machine's."""


class JobNeed(Struct, frozen=True):
    """One job's need, by its worker's report or by its answers, where it ran."""

    work_s: float
    """CPU time at speed 1."""
    other_s: float
    """Its wait for things other than a CPU; of heard answers also for each other."""
    queue_ratio: float
    """Time from arrival to end over its own time where nothing is short; at least 1."""
    is_serial: bool
    """One thread does it, so it uses at most one core at a time."""

    def most_cores(self, speed: float) -> float | None:
        """What the worker can use at a time on a machine of ``speed``; ``None``: any amount."""
        cpu_s = self.work_s / speed
        return cpu_s / (cpu_s + self.other_s) if self.is_serial and cpu_s > 0.0 else None

    def age_s(self, speed: float, free_cores: float) -> float:
        """Expected seconds from arrival to end where a job gets this many cores while it runs, at most one."""
        stretch = 1.0 / min(max(free_cores, LEAST_FREE_CORES), 1.0)
        return self.queue_ratio * (self.other_s + stretch * self.work_s / speed)


def other_s(jobs: Jobs) -> float:
    """A job's wait for things other than a CPU; 0 where the kernel does not report it."""
    return 0.0 if jobs.wait_s is None else max(jobs.time_s - jobs.wait_s - jobs.cpu_s, 0.0)


def is_calm(jobs: Jobs) -> bool:
    """Whether they show their usual wait in the queue: next to no wait for a CPU."""
    return jobs.wait_s is not None and jobs.wait_s <= CALM_WAIT_RATIO * jobs.time_s


def told_job(jobs: Jobs, speed: float, known: JobNeed | None) -> JobNeed:
    """A job by its worker's report, on a machine of ``speed``; ``known``: what was known before."""
    is_serial, queue_ratio = jobs.wait_s is not None, QUEUE_RATIO if known is None else known.queue_ratio
    if jobs.age_s is not None and jobs.time_s > 0.0:
        seen = max(jobs.age_s / jobs.time_s, 1.0)
        queue_ratio = seen if is_calm(jobs) else min(seen, queue_ratio)
    work_s = jobs.cpu_s if is_serial else min(jobs.cpu_s, jobs.time_s)
    return JobNeed(work_s=work_s * speed, other_s=other_s(jobs), queue_ratio=queue_ratio, is_serial=is_serial)


class Heard(Struct, frozen=True):
    """The answers of one task's owner, by all robots that tell of any."""

    age_s: float
    """From an input to its answer at the owner: the median of the robots', so that one bad link says nothing."""
    counts: tuple[tuple[NodeId, float], ...]
    """(robot, how many answers to its own inputs it has counted)."""

    def job(self, cpu_s: float, speed: float, known: JobNeed | None, *, is_calm: bool) -> JobNeed:
        """A job by its answers, which take ``cpu_s`` each on a machine of ``speed``.

        ``known``: what was known before. ``is_calm``: the machine has had CPU to spare for `CALM_S`.
        """
        cpu_s = min(cpu_s, self.age_s)  # several threads at once work for no longer
        waits_s = self.age_s - cpu_s
        if not is_calm:
            waits_s = min(waits_s, 0.0 if known is None else known.other_s)
        return JobNeed(work_s=cpu_s * speed, other_s=waits_s, queue_ratio=1.0, is_serial=False)


def age_of(jobs: Jobs | None, heard: Heard | None) -> float | None:
    """From a job's arrival to its end: by the worker's report, else by its answers; ``None``: nobody knows."""
    if jobs is None:
        return None if heard is None else heard.age_s
    return jobs.time_s if jobs.age_s is None else jobs.age_s


def heard_of(task: TaskId, owner: NodeId, profiles: Iterable[Profile]) -> Heard | None:
    """What these profiles tell of the answers of the task's owner; ``None``: nothing."""
    told: dict[NodeId, AnswerTime] = {}
    for profile in profiles:
        for one in profile.answers:
            if (one.task, one.owner) == (task, owner):
                told.setdefault(profile.node, one)  # each robot counts once
    if not told:
        return None
    age_s = statistics.median([one.age_s for one in told.values()])
    return Heard(age_s, tuple((robot, one.count) for robot, one in sorted(told.items())))
