"""GATEWAY: what a task needs on each node. Learnt where it runs, scaled by speed for the others.

Knows: the difference between a task's use and its need, also by the task's own word (`Jobs`). Does not know: profiles'
age, which node is better.

A need is kept as *work*: cores of a machine of speed 1. Otherwise a task that was measured on a slow machine would seem
too large for fast ones, and the other way round. Where the benchmark says little of the task, what the machine gives
says more (`zsched.core.scheduler.kept`).
"""

from __future__ import annotations

import math
from typing import Final

from zsched.core.gateway.job_need import JobNeed, other_s, told_job
from zsched.core.gateway.shortfall import SHORT_RATIO, is_full, is_short, shows_lack
from zsched.core.values.fleet import Demand, TaskSpec
from zsched.core.values.model import NodeId, TaskId
from zsched.core.values.profile import MAX_CPU_CORES, Jobs, Profile, Renewal, WorkerLoad, WorkerState
from zsched.core.values.struct import Struct, replace

UNSURE = 1.5
"""Need of a worker that always wants to run and never had enough: this many times its use."""
SHOWS_S: Final = 0.5
"""By this time constant a machine's figures show a task that has come: that of their means, and their way here."""
HOLDS_ALL_S: Final = 60.0
"""After so long with its task a worker has taken the memory that it works with; until then the known figure counts."""


class _Known(Struct, frozen=True):
    """What is known of a task's need; ``None``: nothing yet."""

    work: float | None = None
    is_sure: bool = False
    """It was measured with enough CPU; otherwise the need may be larger."""
    has_come: bool = False
    """From elsewhere, or nobody had it."""
    seen_at: NodeId | None = None
    """Where these figures were seen last."""
    memory_mb: float | None = None
    job: JobNeed | None = None
    """What its worker has reported; ``None``: nothing so far."""
    is_job_old: bool = False
    """The job is a worker's that is to start again, by a changed recipe."""
    is_changed: bool = False
    """The file has named another program since then; the owner may still run the one before."""
    is_unplaced: bool = False
    """Nobody has had it when it was looked at last."""
    owner: NodeId | None = None
    since: float = 0.0
    """When it was first looked at there, with its worker ready."""


_NOTHING: Final = _Known()


class Amount(Struct, frozen=True):
    """CPU and memory that are used, needed or coming."""

    cpu_cores: float
    memory_mb: float


Need = Amount | Demand


class Demands:
    """What the tasks need, as one node has learnt it."""

    def __init__(self) -> None:
        self._known: dict[TaskId, _Known] = {}

    def learn(self, task: TaskId, profile: Profile, now: float, fastest: float | None = None) -> bool:
        """Learn the task's need from its owner's profile; whether the need has changed.

        With free CPU the use is the need; without, it is a lower bound. For threads that always want to run
        (`WorkerLoad.wanted_cores`) the need is the last one measured with enough CPU, if they would take that much.
        Otherwise it is a guess above the use, so that a better machine is seen. A worker's report of work left undone
        (`WorkerLoad.jobs`) replaces the guess: jobs are whole, so it is less exact than a measurement, but it is known
        at once. A worker that is not ready, or a figure without a measurement, changes nothing: a task does not get
        cheaper because its worker restarts.

        Args:
            task: which one.
            profile: its owner's.
            now: monotonic seconds.
            fastest: the highest speed among the candidates (``None``: the owner's).
        """
        load = profile.worker(task)
        known = self._known.get(task, _NOTHING)
        if load is not None and load.state is not WorkerState.READY and known.owner == profile.node:
            # once it is ready its use rises from nothing, as after a move
            self._known[task] = replace(known, owner=None)
        if load is None or load.state is not WorkerState.READY:
            return False
        if known.owner != profile.node:
            known = _came(known, profile.node, now)
        if profile.cpu_used_cores is None:  # it is there, and shows by its memory, and says nothing of its need
            self._known[task] = known
            return False
        found, is_calm = known, not is_full(profile)
        if load.memory_mb is not None:
            is_new = now - found.since < HOLDS_ALL_S
            found = replace(found, memory_mb=max(load.memory_mb, (known.memory_mb or 0.0) if is_new else 0.0))
        speed = speed_of(profile)
        if load.cpu_cores is not None:
            is_starved = not is_calm and not _gets_all(load, load.cpu_cores)
            fastest = max(fastest or speed, speed)
            found = _with_use(found, load, load.cpu_cores, speed, fastest, is_starved=is_starved, is_calm=is_calm)
        self._known[task] = found = _with_job(found, load, speed, is_calm=is_calm)
        return (found.work, found.memory_mb, found.job) != (known.work, known.memory_mb, known.job)

    def given_ratio(self, task: TaskId, profile: Profile) -> float:
        """The part of its need that a task is seen to get where it is, in [0, 1].

        1 where nothing shows that it lacks anything.
        """
        load, work = self._there(task, profile), self._known.get(task, _NOTHING).work
        if not work or load is None or load.cpu_cores is None or not (shows_lack(load) and is_short(load)):
            return 1.0
        return min(load.cpu_cores * speed_of(profile) / work, 1.0)

    def seen_s(self, task: TaskId, profile: Profile) -> float:
        """How long a task's jobs are seen to take on a full machine where it is; 0 elsewhere.

        Where a load has ended the jobs that it held up count in their mean for some seconds.
        """
        load = self._there(task, profile)
        if load is None or load.jobs is None or not is_full(profile):
            return 0.0
        return load.jobs.time_s if load.jobs.age_s is None else load.jobs.age_s

    def _there(self, task: TaskId, profile: Profile) -> WorkerLoad | None:
        """The task's worker where it was seen last; ``None`` elsewhere."""
        return profile.worker(task) if self._known.get(task, _NOTHING).owner == profile.node else None

    def note_unplaced(self, task: TaskId) -> None:
        """Nobody has the task: who gets it next will not show it at once."""
        known = self._known.get(task, _NOTHING)
        self._known[task] = replace(known, owner=None, is_unplaced=True)

    def forget(self, task: TaskId) -> None:
        """Know nothing of a task that is no more: one of the same name that comes later is another one (0043)."""
        self._known.pop(task, None)

    def expect_another(self, task: TaskId) -> None:
        """Know nothing of a task whose program the file has changed; what its owner's one still shows counts for now.

        A recipe that changes otherwise (the session) starts the same program again.
        """
        self.forget(task)
        self._known[task] = _Known(is_changed=True)

    def is_replaced(self, task: TaskId, profile: Profile) -> bool:
        """Whether the owner's worker was seen to run by the recipe before, and now is ready by the changed one."""
        known, load = self._known.get(task, _NOTHING), profile.worker(task)
        is_ready = load is not None and load.state is WorkerState.READY and load.renewal is Renewal.NONE
        return is_ready and known.is_changed and known.is_job_old

    def job(self, task: TaskId) -> JobNeed | None:
        """One job's need; ``None``: its worker has never reported any."""
        return self._known.get(task, _NOTHING).job

    def unshown_ratio(self, task: TaskId, node: NodeId, now: float, shows_s: float = SHOWS_S) -> float:
        """The part of a task's use that a node's figures, means over about ``shows_s``, do not show yet, in [0, 1].

        All of it until the task is seen there, if it was seen elsewhere before; then less with every second.
        """
        known = self._known.get(task, _NOTHING)
        if known.owner != node:
            return 1.0 if known.is_unplaced or known.seen_at not in (None, node) else 0.0
        return math.exp((known.since - now) / shows_s) if known.has_come else 0.0

    def holds_all(self, task: TaskId, node: NodeId, now: float) -> bool:
        """Whether the task's worker there has had it for so long that it holds the memory that it works with."""
        known = self._known.get(task, _NOTHING)
        return known.owner == node and now - known.since >= HOLDS_ALL_S

    def at(self, spec: TaskSpec, profile: Profile) -> Need:
        """The task's demand on a node: the larger of the fleet file's figure and the learnt one."""
        known = self._known.get(spec.name)
        if known is None:
            return spec.demand
        cores = min((known.work or 0.0) / speed_of(profile), MAX_CPU_CORES)
        return Amount(
            cpu_cores=max(spec.demand.cpu_cores, cores),
            memory_mb=max(spec.demand.memory_mb, known.memory_mb or 0.0),
        )


def _came(known: _Known, node: NodeId, now: float) -> _Known:
    """It begins to be seen on a node: another one than before, or the same one, where its worker has started again."""
    has_come = known.is_unplaced or known.seen_at not in (None, node)
    return replace(known, owner=node, since=now, has_come=has_come, seen_at=node, is_unplaced=False)


def speed_of(profile: Profile) -> float:
    """Speed of the node's cores; 1 where nobody has measured it."""
    return 1.0 if profile.speed is None else profile.speed


def _gets_all(load: WorkerLoad, cores: float) -> bool:
    """Whether its threads are seen to wait for no CPU: then its use is its need on a full machine, too.

    Where fewer threads run or wait than run, some live for a moment only, and nobody has counted them.
    """
    if load.runnable is None or is_short(load):
        return False
    return abs(load.runnable - cores) <= (1.0 - SHORT_RATIO) * cores


def _with_use(
    known: _Known,
    load: WorkerLoad,
    cores: float,
    speed: float,
    fastest: float,
    *,
    is_starved: bool,
    is_calm: bool,
) -> _Known:
    """With the work that its use of ``cores`` shows (`Demands.learn`)."""
    use, most = cores * speed, (load.wanted_cores or 0.0) * speed
    told, least = _told(load, speed, fastest, is_calm=is_calm), max(use, known.work or 0.0)
    is_held = known.is_sure and known.work == least
    if told is not None and not known.is_sure and (most > use or is_starved):
        return replace(known, work=told)
    if most > use and not (is_held and least <= most):
        return replace(known, work=min(UNSURE * use, most), is_sure=False)
    if most > use or is_starved:
        return replace(known, work=least, is_sure=is_held)
    if is_calm and told is not None and told > use and _leaves_undone(load):
        # a worker that waits for other things, too, or whose threads take turns, never always wants to run, and quicker
        # cores would do more
        return replace(known, work=told, is_sure=False)
    return replace(known, work=use, is_sure=True)


def _leaves_undone(load: WorkerLoad) -> bool:
    """Whether it leaves work undone now: means that tell of more work than it uses are of before."""
    jobs = load.jobs
    return is_short(load) and jobs is not None and (load.cpu_cores or 0.0) >= SHORT_RATIO * jobs.done_hz * jobs.cpu_s


def _told(load: WorkerLoad, speed: float, fastest: float, *, is_calm: bool) -> float | None:
    """The work that the task needs, from its use and its worker's report of undone work; ``None``: no report.

    Undone work counts only as far as a CPU would have done it. A serial worker that skips four of five camera samples,
    and would skip three of five on the fastest candidate, lacks one of five. Where the kernel reports how long jobs
    waited for a CPU, that bound is known; of jobs of several threads on a machine with CPU to spare, too (``is_calm``):
    there no job waits for one. Elsewhere only threads that always want to run show a lack.
    """
    jobs, use = load.jobs, load.cpu_cores
    if jobs is None or use is None:
        return None
    done_hz = jobs.done_hz
    if jobs.cpu_s and jobs.time_s:
        # of jobs that are about as long as the window of their rates, the rates of one moment tell little
        done_hz = max(done_hz, min(use / jobs.cpu_s, 1.0 / jobs.time_s))
    undone_hz = jobs.wanted_hz - done_hz
    working_s, waits_s = jobs.cpu_s, other_s(jobs)
    if jobs.wait_s is None and is_calm:
        working_s = min(jobs.cpu_s, jobs.time_s)
        waits_s = jobs.time_s - working_s
    elif not shows_lack(load):
        return None
    elif jobs.wait_s is None:
        return min(use + max(undone_hz, 0.0) * jobs.cpu_s, max(load.wanted_cores or 0.0, use)) * speed
    alone_s = waits_s + working_s * speed / fastest
    if alone_s > 0.0:
        undone_hz = min(undone_hz, max(1.0 / alone_s - done_hz, 0.0))
    return max(use + undone_hz * jobs.cpu_s, 0.0) * speed


def _threads(load: WorkerLoad, jobs: Jobs) -> float | None:
    """How many of the worker's threads run or wait for a CPU while it has a job; ``None``: nobody counts them."""
    busy_ratio = min(jobs.done_hz * jobs.time_s, 1.0)
    if load.runnable is not None and busy_ratio > 0.0:
        return max(load.runnable / busy_ratio, load.wanted_cores or 0.0)
    return load.wanted_cores


def _with_job(known: _Known, load: WorkerLoad, speed: float, *, is_calm: bool) -> _Known:
    """With the job of the owner's worker: the one that it reports, or reported before it became silent.

    The job of a program that has been replaced says nothing of the one that runs now and reports none.
    """
    is_old = load.renewal is not Renewal.NONE
    if load.jobs is not None:
        job = told_job(
            load.jobs,
            speed,
            known.job,
            is_calm=is_calm,
            threads=_threads(load, load.jobs),
        )
        return replace(known, job=job, is_job_old=is_old)
    if is_old:
        return replace(known, is_job_old=True)
    return replace(known, job=None, is_job_old=False) if known.is_job_old else known
