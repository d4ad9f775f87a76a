"""GATEWAY, what a task needs where: learnt where it runs, scaled by speed to where it does not.

Knows: the difference between what a task uses and what it wants, by its own word where there is one (`Jobs`). Does not
know: profiles' age, who is better.

A task's need is kept as *work*: cores of a machine of speed 1. Without it a task that was measured on a slow machine
seems too large for the fast ones, and the other way round; with one figure for all of them the view from every owner is
the same but for a common factor, so a constant fleet has no limit cycle.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from zsched.core.values.fleet import Demand, TaskSpec
from zsched.core.values.model import Jobs, NodeId, Profile, TaskId, WorkerLoad, WorkerState

STARVED_CPU_RATIO = 0.9
"""On an owner busier than this a task may get less than it wants: what it uses is the least that it needs."""
UNSURE = 1.5
"""A worker that always wants to run and never had enough counts as needing so many times what it gets."""
SETTLE_S = 4.0
"""What a task uses still rises for so long after it has come, for the figures are smoothed: the least that it needs."""


CALM_WAIT_RATIO = 0.1
"""Jobs that wait for a CPU for no more of their time show how long they wait for their turn where nothing is short."""
QUEUE_RATIO = 2.0
"""Until that was seen, a job's age counts as at most so many times the time that it takes."""
SHORT_RATIO = 0.9
"""A task that gets less than this part of what was foreseen for its owner does so for a reason of that machine."""
SAME_RATIO = 0.1
"""That reason is believed in until what others use there has changed by this share of the machine."""
LEAST_FREE_CORES = 0.05
"""A job on a full machine gets this much at least, so that its time can be told."""


@dataclass(frozen=True, slots=True)
class JobNeed:
    """What one job of a task takes, as its worker said where it ran."""

    work_s: float
    """CPU time at speed 1."""
    other_s: float
    """What it waits for beside a CPU: it takes as long on every machine."""
    queue_ratio: float
    """From arrival to end, over what it takes itself, where nothing is short; at least 1."""
    is_serial: bool
    """One thread works on it: it cannot use more than a core at a time."""

    def most_cores(self, speed: float) -> float | None:
        """What the worker can use at a time on a machine of ``speed``; ``None``: any amount."""
        cpu_s = self.work_s / speed
        return cpu_s / (cpu_s + self.other_s) if self.is_serial and cpu_s > 0.0 else None

    def age_s(self, speed: float, free_cores: float) -> float:
        """How long it would take there from arrival to end, with so much not in use by others."""
        stretch = 1.0 / min(max(free_cores, LEAST_FREE_CORES), 1.0)
        return self.queue_ratio * (self.other_s + stretch * self.work_s / speed)


@dataclass(frozen=True, slots=True)
class _Shortfall:
    """What a task got on a machine beside what was foreseen for it there."""

    share: float
    """Of the share of its work, at most 1."""
    stretch: float
    """How many times as long its jobs took, at least 1."""
    others_cores: float
    """What others used there."""


@dataclass(frozen=True, slots=True)
class _Known:
    """What was learnt of a task; ``None``: nothing yet."""

    work: float | None = None
    is_sure: bool = False
    """It was measured where the task had all that it needs; otherwise the need may be larger."""
    memory_mb: float | None = None
    job: JobNeed | None = None
    owner: NodeId | None = None
    since: float = 0.0
    """When it was first looked at there."""


class Demands:
    """What the tasks need, as one node has learnt it."""

    def __init__(self) -> None:
        self._known: dict[TaskId, _Known] = {}
        self._shortfalls: dict[tuple[TaskId, NodeId], _Shortfall] = {}

    def learn(self, task: TaskId, profile: Profile, now: float, fastest: float | None = None) -> bool:
        """Note what the task's worker wants on its owner; whether that is news.

        What it uses is its need where CPU is left, and the least of it where none is. Where threads of it always want
        to run (`WorkerLoad.wanted_cores`), its need is what was measured when it had enough, if they would take that
        much; else a guess above what it gets, so that a machine that would give it more is seen to. Where the worker
        tells what it left undone (`WorkerLoad.jobs`), nothing is guessed: that is less exact than what was measured,
        for jobs are whole, but known at once. A worker that is not ready, or a figure that nobody measured, changes
        nothing: the task does not cost less because its worker restarts.

        ``fastest``: the highest speed among the candidates (``None``: the owner's).
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
            speed = speed_of(profile)
            use, most = load.cpu_cores * speed, (load.wanted_cores or 0.0) * speed
            told = _told(load, speed, max(fastest or speed, speed))
            least = max(use, known.work or 0.0)
            is_held = known.is_sure and known.work == least
            is_starved = profile.cpu_used_cores / profile.cpu_cores >= STARVED_CPU_RATIO
            if told is not None and not known.is_sure and (most > use or is_new or is_starved):
                found = replace(found, work=max(told, known.work or 0.0) if is_new else told)
            elif most > use and not (is_held and least <= most):
                found = replace(found, work=min(UNSURE * use, most), is_sure=False)
            elif most > use or is_new or is_starved:
                found = replace(found, work=least, is_sure=is_held)
            else:
                found = replace(found, work=use, is_sure=True)
        if load.jobs is not None:
            found = replace(found, job=_job(load.jobs, speed_of(profile), known.job))
        self._known[task] = found
        is_seen = load.jobs is not None and not is_new and self._note_shortfall(task, profile, load, found)
        return is_seen or (found.work, found.memory_mb, found.job) != (known.work, known.memory_mb, known.job)

    def _note_shortfall(self, task: TaskId, profile: Profile, load: WorkerLoad, found: _Known) -> bool:
        """Remember of a machine that the task gets less there than its figures say, if it does; is that news?"""
        jobs, job, used = load.jobs, found.job, profile.cpu_used_cores
        if jobs is None or job is None or used is None or load.cpu_cores is None or not found.work:
            return False
        speed, others = speed_of(profile), _others_cores(task, profile, used)
        need, free = found.work / speed, profile.cpu_cores - others
        most = job.most_cores(speed)
        foreseen = min(free / need, 1.0 if most is None else most / need, 1.0)
        is_lacking = foreseen > 0.0 and _is_told(load) and is_short(load)
        share = min(load.cpu_cores / need / foreseen, 1.0) if is_lacking else 1.0
        age_s = jobs.time_s if jobs.age_s is None else jobs.age_s
        stretch = max(age_s / max(job.age_s(speed, free), 1e-9), 1.0)
        before = self._shortfalls.pop((task, profile.node), None)
        if share >= SHORT_RATIO and stretch <= 1.0 / SHORT_RATIO:
            return before is not None
        self._shortfalls[task, profile.node] = _Shortfall(share, stretch, others)
        return before != self._shortfalls[task, profile.node]

    def job(self, task: TaskId) -> JobNeed | None:
        """What one of its jobs takes; ``None``: its worker has never told."""
        return self._known.get(task, _Known()).job

    def experience(self, task: TaskId, profile: Profile) -> tuple[float, float]:
        """What the task got on that machine beside what is foreseen: (part of the work, at most 1; times as long).

        What was seen there counts as long as others use about as much there, whoever has the task: the owner's term is
        what is measured, and it does not look better as soon as the task has left.
        """
        seen, used = self._shortfalls.get((task, profile.node)), profile.cpu_used_cores
        if seen is None or used is None:
            return 1.0, 1.0
        is_same = abs(_others_cores(task, profile, used) - seen.others_cores) <= SAME_RATIO * profile.cpu_cores
        return (seen.share, seen.stretch) if is_same else (1.0, 1.0)

    def at(self, spec: TaskSpec, profile: Profile) -> Demand:
        """What the task will use on a node: the larger of the fleet file's figure and what was learnt."""
        known = self._known.get(spec.name, _Known())
        return Demand(
            cpu_cores=max(spec.demand.cpu_cores, (known.work or 0.0) / speed_of(profile)),
            memory_mb=max(spec.demand.memory_mb, known.memory_mb or 0.0),
        )


def _others_cores(task: TaskId, profile: Profile, used_cores: float) -> float:
    return max(used_cores - profile.cores_of(task), 0.0)


def is_short(load: WorkerLoad) -> bool:
    """Whether the worker is seen to want more than it gets; one that has nothing to do uses little and lacks nothing.

    Its threads always want to run and run for less, or it leaves work undone.
    """
    jobs, use = load.jobs, load.cpu_cores or 0.0
    is_hungry = load.wanted_cores is not None and use < SHORT_RATIO * load.wanted_cores
    return is_hungry or (jobs is not None and jobs.done_hz < SHORT_RATIO * jobs.wanted_hz)


def _is_told(load: WorkerLoad) -> bool:
    """Whether the worker's own word says what it lacks of a CPU, and not only what it leaves undone."""
    jobs = load.jobs
    return jobs is not None and (jobs.wait_s is not None or load.wanted_cores is not None)


def _told(load: WorkerLoad, speed: float, fastest: float) -> float | None:
    """The work that the task needs, of what it uses and what its worker says that it left undone; ``None``: not told.

    What is left undone counts only as far as a CPU would have done it. A serial worker that skips four of five samples
    of a camera, and would skip three of five on the fastest candidate, lacks one of five. Where the kernel tells how
    long jobs have waited for a CPU, that bound is known; else only threads that always want to run show a lack.
    """
    jobs, use = load.jobs, load.cpu_cores
    if jobs is None or use is None or not _is_told(load):
        return None
    undone_hz = jobs.wanted_hz - jobs.done_hz
    if jobs.wait_s is None:
        return min(use + max(undone_hz, 0.0) * jobs.cpu_s, max(load.wanted_cores or 0.0, use)) * speed
    alone_s = _other_s(jobs) + jobs.cpu_s * speed / fastest
    if alone_s > 0.0:
        undone_hz = min(undone_hz, max(1.0 / alone_s - jobs.done_hz, 0.0))
    return max(use + undone_hz * jobs.cpu_s, 0.0) * speed


def _other_s(jobs: Jobs) -> float:
    """What a job waits for beside a CPU, on whatever machine; nothing where the kernel does not tell it apart."""
    return 0.0 if jobs.wait_s is None else max(jobs.time_s - jobs.wait_s - jobs.cpu_s, 0.0)


def _job(jobs: Jobs, speed: float, known: JobNeed | None) -> JobNeed:
    is_serial, queue_ratio = jobs.wait_s is not None, QUEUE_RATIO if known is None else known.queue_ratio
    if jobs.age_s is not None and jobs.time_s > 0.0:
        seen = max(jobs.age_s / jobs.time_s, 1.0)
        is_calm = jobs.wait_s is not None and jobs.wait_s <= CALM_WAIT_RATIO * jobs.time_s
        queue_ratio = seen if is_calm else min(seen, queue_ratio)
    work_s = jobs.cpu_s if is_serial else min(jobs.cpu_s, jobs.time_s)
    return JobNeed(work_s=work_s * speed, other_s=_other_s(jobs), queue_ratio=queue_ratio, is_serial=is_serial)


def speed_of(profile: Profile) -> float:
    """How fast one of the node's cores is; 1 where nobody has measured it."""
    return 1.0 if profile.speed is None else profile.speed
