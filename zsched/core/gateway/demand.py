"""GATEWAY: what a task needs on each node. Learnt where it runs, scaled by speed for the others.

Knows: the difference between a task's use and its need, also by the task's own word (`Jobs`). Does not know: profiles'
age, which node is better.

A need is kept as *work*: cores of a machine of speed 1. Otherwise a task that was measured on a slow machine would seem
too large for fast ones, and the other way round. What a move shows of the task's own speed on a machine is kept for
that machine (`zsched.core.gateway.task_speed`), so the need there is the same from every owner, and an unchanging fleet
has no limit cycle (docs/decisions/0118).
"""

from __future__ import annotations

import math
from collections.abc import Container
from typing import Final, Self

from zsched.core.gateway.company import is_full
from zsched.core.gateway.job_need import CALM_S, JobNeed, other_s, told_job
from zsched.core.gateway.shortfall import SHORT_RATIO, Shortfalls, is_short, shows_lack
from zsched.core.gateway.task_speed import MOST_RATIO, TaskSpeeds, speed_of
from zsched.core.values.fleet import Demand, TaskSpec
from zsched.core.values.model import NodeId, TaskId
from zsched.core.values.profile import MAX_CPU_CORES, Jobs, Profile, Renewal, WorkerLoad, WorkerState
from zsched.core.values.struct import Struct, replace

UNSURE = 1.5
"""Need of a worker that always wants to run and never had enough: this many times its use."""
SETTLE_S = 4.0
"""After a move, or a worker's start, the smoothed use rises for so long: it is only a lower bound of the need."""
SHOWS_S: Final = 0.5
"""By this time constant a machine's figures show a task that has come: that of their means, and their way here."""
HOLDS_ALL_S: Final = 60.0
"""After so long with its task a worker has taken the memory that it works with."""
COMPARED_S = 12.0
"""What differs so soon after a move is the machine's doing; what changes later is the task's."""
RECENT_S = 60.0
"""Older figures say nothing of the machine to which a task has come: the task may have changed since."""


class _Most(Struct, frozen=True):
    """The most of some figures within the last `RECENT_S`, to half of that."""

    now: float
    """Of this half..."""
    since: float
    """...which began then."""
    before: float = 0.0
    """Of the half before."""

    @property
    def value(self) -> float:
        """The most of both."""
        return max(self.now, self.before)

    def with_one(self, value: float, at: float) -> Self:
        """With one more figure."""
        age_s = at - self.since
        if age_s < RECENT_S / 2:
            return replace(self, now=max(self.now, value))
        return replace(self, now=value, since=at, before=self.now if age_s < RECENT_S else 0.0)


class _Before(Struct, frozen=True):
    """What another machine had shown of a task when it came, if any had; ``None``: nothing sure."""

    work: float | None = None
    job_work_s: float | None = None
    """CPU time of its largest jobs there: a machine is not slower for a job that is."""


class _Known(Struct, frozen=True):
    """What is known of a task's need; ``None``: nothing yet."""

    work: float | None = None
    is_sure: bool = False
    """It was measured with enough CPU; otherwise the need may be larger."""
    job_work_s: _Most | None = None
    """CPU time of a job at speed 1, of all its threads; ``None``: its worker is silent."""
    before: _Before | None = None
    """``None``: it has not come from elsewhere."""
    job_least_s: float | None = None
    """The least CPU time of a job here, as long as that is compared with what it took before."""
    seen_at: NodeId | None = None
    """Where these figures were seen last..."""
    seen_s: float = 0.0
    """...and when."""
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
    full_at: float = -math.inf
    """When the owner's machine last had no CPU to spare."""


class Demands:
    """What the tasks need, as one node has learnt it."""

    def __init__(self) -> None:
        self._known: dict[TaskId, _Known] = {}
        self.shortfalls = Shortfalls()
        """What machines did not keep."""
        self._speeds = TaskSpeeds()

    def learn(
        self,
        task: TaskId,
        profile: Profile,
        now: float,
        fastest: float | None = None,
        fair_cores: float = 0.0,
    ) -> bool:
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
            fair_cores: what a fair scheduler gives the task there while a job runs, >= 0; 0: nobody counts threads.
        """
        self.shortfalls.end_doubts(task, now)
        load = profile.worker(task)
        known = self._known.get(task, _Known())
        if load is not None and load.state is not WorkerState.READY and known.owner == profile.node:
            # once it is ready its use rises from nothing, as after a move
            self._known[task] = replace(known, owner=None)
        if load is None or load.state is not WorkerState.READY:
            return False
        if known.owner != profile.node:
            known = _came(known, profile.node, now)
        found = replace(known, seen_s=now)
        if profile.cpu_used_cores is None:  # it is there, and shows by its memory, and says nothing of its need
            self._known[task] = known
            return False
        if is_full(profile):
            found = replace(found, full_at=now)
        is_new, is_calm = now - found.since < SETTLE_S, now - found.full_at > CALM_S
        before = found.before if now - found.since < COMPARED_S else None
        jobs = load.jobs
        if before is not None and jobs is not None and jobs.cpu_s:
            least_s = min(jobs.cpu_s, found.job_least_s or jobs.cpu_s)
            found = replace(found, job_least_s=least_s)
            self._compare_jobs(task, profile, least_s, before)
        if load.memory_mb is not None:
            found = replace(found, memory_mb=max(load.memory_mb, (known.memory_mb or 0.0) if is_new else 0.0))
        if load.cpu_cores is not None:
            speed = self._speeds.of(task, profile, is_there=True)
            fastest = max(fastest or speed, speed)
            is_starved = is_full(profile) and not _gets_all(load, load.cpu_cores)
            found = _with_use(
                found, load, load.cpu_cores, speed, fastest, is_new=is_new, is_starved=is_starved, is_calm=is_calm
            )
            if before is not None:
                found = self._compared(task, profile, found, before, is_new=is_new, has_jobs=jobs is not None)
        speed = self._speeds.of(task, profile, is_there=True)
        is_known_calm = is_calm and now - found.since > CALM_S
        found = _with_job(found, load, speed, is_new=is_new, is_calm=is_calm, is_known_calm=is_known_calm)
        self._known[task] = found
        is_seen = False
        if not is_new and jobs is not None and found.job is not None and found.work:
            is_seen = self.shortfalls.note(
                task,
                profile,
                found.job,
                jobs.time_s if jobs.age_s is None else jobs.age_s,
                need_cores=found.work / speed,
                speed=speed,
                fair_cores=fair_cores,
                now=now,
            )
        return is_seen or (found.work, found.memory_mb, found.job) != (known.work, known.memory_mb, known.job)

    def note_unplaced(self, task: TaskId) -> None:
        """Nobody has the task: who gets it next will not show it at once."""
        known = self._known.get(task, _Known())
        self._known[task] = replace(known, owner=None, is_unplaced=True)

    def forget(self, task: TaskId) -> None:
        """Know nothing of a task that is no more: one of the same name that comes later is another one (0043)."""
        self._known.pop(task, None)
        self._speeds.forget(task)
        self.shortfalls.forget(task)

    def keep(self, nodes: Container[NodeId]) -> None:
        """Know nothing of other nodes: one of the same name that comes later is another one."""
        self._speeds.keep(nodes)
        self.shortfalls.keep(nodes)

    def expect_another(self, task: TaskId) -> None:
        """Know nothing of a task whose program the file has changed; what its owner's one still shows counts for now.

        A recipe that changes otherwise (the session) starts the same program again.
        """
        self.forget(task)
        self._known[task] = _Known(is_changed=True)

    def is_replaced(self, task: TaskId, profile: Profile) -> bool:
        """Whether the owner's worker was seen to run by the recipe before, and now is ready by the changed one."""
        known, load = self._known.get(task, _Known()), profile.worker(task)
        is_ready = load is not None and load.state is WorkerState.READY and load.renewal is Renewal.NONE
        return is_ready and known.is_changed and known.is_job_old

    def _compare_jobs(self, task: TaskId, profile: Profile, least_s: float, before: _Before) -> None:
        """What a job takes here and took where the task came from tells its speed, also of one that is short.

        A task's jobs differ, and may grow while it moves: it is slower here only if the least that they take exceeds
        the most that they took there in the last minute. It is never faster than the benchmark says. A job that takes
        less here may do so because others slowed it down where it came from, or because its worker begins with nothing.
        Then all other machines would seem too slow for as long as the task stays, and nothing but a move would tell.
        """
        if not before.job_work_s:
            return
        self._speeds.note(task, profile, min(before.job_work_s / least_s, speed_of(profile)))

    def _compared(
        self, task: TaskId, profile: Profile, found: _Known, before: _Before, *, is_new: bool, has_jobs: bool
    ) -> _Known:
        """The need that a task came with, if that was sure: one that is short here for more is slower here.

        While its use still rises, or bursts at its start, what it came with counts. Where it lacks nothing its use may
        have changed for many reasons, and no machine is judged by it. Nor where it ``has_jobs``: these tell the speed,
        and it may be short for there being more of them. Nor by more than a machine can differ: it came with nothing to
        do.
        """
        if before.work is None or found.work is None:
            return found
        as_before = replace(found, work=before.work, is_sure=True)
        if is_new:
            return as_before
        if found.is_sure or has_jobs or found.work <= before.work:
            return found
        speed = self._speeds.of(task, profile, is_there=True) * before.work / found.work
        if speed * MOST_RATIO < speed_of(profile):
            return found
        self._speeds.note(task, profile, speed)
        return as_before

    def job(self, task: TaskId) -> JobNeed | None:
        """One job's need; ``None``: its worker has never reported any."""
        return self._known.get(task, _Known()).job

    def unshown_ratio(self, task: TaskId, node: NodeId, now: float, shows_s: float = SHOWS_S) -> float:
        """The part of a task's use that a node's figures, means over about ``shows_s``, do not show yet, in [0, 1].

        All of it until the task is seen there, if it was seen elsewhere before; then less with every second.
        """
        known = self._known.get(task, _Known())
        if known.owner != node:
            return 1.0 if known.is_unplaced or known.seen_at not in (None, node) else 0.0
        return 0.0 if known.before is None else math.exp((known.since - now) / shows_s)

    def holds_all(self, task: TaskId, node: NodeId, now: float) -> bool:
        """Whether the task's worker there has had it for so long that it holds the memory that it works with."""
        known = self._known.get(task, _Known())
        return known.owner == node and now - known.since >= HOLDS_ALL_S

    def speed(self, task: TaskId, profile: Profile) -> float:
        """The task's speed on a node, > 0: the benchmark's, or what was seen when the task came there."""
        is_there = self._known.get(task, _Known()).owner == profile.node
        return self._speeds.of(task, profile, is_there=is_there)

    def at(self, spec: TaskSpec, profile: Profile) -> Demand:
        """The task's demand on a node: the larger of the fleet file's figure and the learnt one."""
        known = self._known.get(spec.name, _Known())
        cores = min((known.work or 0.0) / self.speed(spec.name, profile), MAX_CPU_CORES)
        return Demand(
            cpu_cores=max(spec.demand.cpu_cores, cores),
            memory_mb=max(spec.demand.memory_mb, known.memory_mb or 0.0),
        )


def _came(known: _Known, node: NodeId, now: float) -> _Known:
    """It begins to be seen on a node: another one than before, or the same one, where its worker has started again."""
    before = _Before() if known.is_unplaced else None
    if known.seen_at not in (None, node) and now - known.seen_s <= RECENT_S:
        most = known.job_work_s
        before = _Before(known.work if known.is_sure else None, None if most is None else most.value)
    found = replace(known, owner=node, since=now, before=before, job_least_s=None, seen_at=node)
    return replace(found, full_at=-math.inf, is_unplaced=False)


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
    is_new: bool,
    is_starved: bool,
    is_calm: bool,
) -> _Known:
    """With the work that its use of ``cores`` shows (`Demands.learn`)."""
    use, most = cores * speed, (load.wanted_cores or 0.0) * speed
    told, least = _told(load, speed, fastest, is_calm=is_calm), max(use, known.work or 0.0)
    is_held = known.is_sure and known.work == least
    if told is not None and not known.is_sure and (most > use or is_new or is_starved):
        return replace(known, work=max(told, known.work or 0.0) if is_new else told)
    if most > use and not (is_held and least <= most):
        return replace(known, work=min(UNSURE * use, most), is_sure=False)
    if most > use or is_new or is_starved:
        return replace(known, work=least, is_sure=is_held)
    if is_calm and told is not None and told > use and is_short(load):
        # a worker that waits for other things, too, or whose threads take turns, never always wants to run, and quicker
        # cores would do more; what a load held up is undone for some seconds behind its end
        return replace(known, work=told, is_sure=False)
    return replace(known, work=use, is_sure=True)


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


def _with_jobs_work(known: _Known, work_s: float) -> _Most:
    """With what a job takes now."""
    if known.job_work_s is None:
        return _Most(work_s, known.seen_s)
    return known.job_work_s.with_one(work_s, known.seen_s)


def _threads(load: WorkerLoad, jobs: Jobs) -> float | None:
    """How many of the worker's threads run or wait for a CPU while it has a job; ``None``: nobody counts them."""
    busy_ratio = min(jobs.done_hz * jobs.time_s, 1.0)
    if load.runnable is not None and busy_ratio > 0.0:
        return max(load.runnable / busy_ratio, load.wanted_cores or 0.0)
    return load.wanted_cores


def _with_job(
    known: _Known, load: WorkerLoad, speed: float, *, is_new: bool, is_calm: bool, is_known_calm: bool
) -> _Known:
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
            is_known_calm=is_known_calm,
            used_cores=load.cpu_cores,
            threads=_threads(load, load.jobs),
        )
        # a worker that has just come may begin with nothing, and its first jobs be small by that
        is_first = is_new and known.before is not None
        job_work_s = known.job_work_s if is_first else _with_jobs_work(known, load.jobs.cpu_s * speed)
        return replace(known, job=job, job_work_s=job_work_s, is_job_old=is_old)
    silent = known if is_new else replace(known, job_work_s=None)
    if is_old:
        return replace(silent, is_job_old=True)
    return replace(silent, job=None, is_job_old=False) if known.is_job_old and not is_new else silent
