"""Decides what a task gets on a machine that it shares: cores and memory by fair shares, then service and late jobs.

Knows: cores, speed, processes, jobs. Does not know: histories, owners, how anybody decides.

Time is a fluid here: within 0.2 s nothing waits for anything. A job is a given number of CPU seconds on a machine of
speed 1; on a machine of speed 0.5 it costs twice as many.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from zsched_lab.decisions.loads import Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Machine:
    """An edge: cores, how much faster than speed 1 each of them is, MiB."""

    cores: float
    speed: float
    memory_mb: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Work:
    """A task: jobs a second, CPU seconds of each at speed 1, and how many processes do them."""

    name: str
    cpu_s: float
    rate_hz: float
    memory_mb: float
    processes: int
    deadline_s: float
    """A job that takes longer comes too late."""
    slow_s: float
    """A job that takes longer is slow, in time or not."""

    def demand(self, machine: Machine) -> float:
        """Cores of ``machine`` that it takes to do every job.

        >>> slow = Machine(cores=4.0, speed=0.5, memory_mb=4000.0)
        >>> Work(name="a", cpu_s=0.4, rate_hz=2.0, memory_mb=10.0, processes=2, deadline_s=1.0, slow_s=1.0).demand(slow)
        1.6
        """
        return self.cpu_s * self.rate_hz / machine.speed


def share_out(capacity: float, wanted: Array, heads: Array) -> Array:
    """Fair shares: nobody gets more than it wants, and what is short is divided by heads. [S, N] each.

    With one task among n processes that want a core each this is what a fair scheduler (CFS) gives:
    ``min(demand, max(free, fair share))``.

    >>> share_out(4.0, np.array([[3.0, 8.0]]), np.array([[3.0, 8.0]])).round(2).tolist()
    [[1.09, 2.91]]
    >>> share_out(4.0, np.array([[3.0, 2.0]]), np.array([[3.0, 2.0]])).round(2).tolist()
    [[2.4, 1.6]]
    >>> share_out(4.0, np.array([[0.3, 8.0]]), np.array([[1.0, 8.0]])).round(2).tolist()
    [[0.3, 3.7]]
    """
    rows = np.arange(len(wanted))
    full_at = np.divide(wanted, heads, out=np.zeros_like(wanted), where=heads > 0)
    left = np.full(len(wanted), capacity)
    hungry = heads.sum(axis=1)
    got = np.zeros_like(wanted)
    for turn in np.argsort(full_at, axis=1, kind="stable").T:
        head = heads[rows, turn]
        each = np.divide(left, hungry, out=np.zeros_like(left), where=hungry > 0)
        mine = np.minimum(wanted[rows, turn], head * each)
        got[rows, turn] = mine
        left, hungry = left - mine, hungry - head
    return got


def alone_s(cpu_s: float, processes: int, machine: Machine) -> float:
    """How long a job of ``cpu_s`` takes by this many processes on a machine that is idle.

    >>> alone_s(0.4, 3, Machine(cores=2.0, speed=0.5, memory_mb=4000.0))
    0.4
    """
    return cpu_s / machine.speed / min(processes, machine.cores)


@dataclass(frozen=True, slots=True, kw_only=True)
class Shared:
    """What a machine shows and gives in S situations while some tasks (M of them) are on it."""

    cores_wanted: Array
    """[S]: by everybody together; more than the machine has when it is short."""
    memory_wanted: Array
    cores: Array
    """[S, M]: what each of the tasks gets."""
    memory: Array
    service: Array
    """[S, M]: the share of its jobs that each of the tasks does."""
    missed: Array
    """[S, M]: the share of its jobs that are not done, or too late."""
    slow: Array
    """[S, M]: the share of its jobs that are not done, or slow."""


def share(
    machine: Machine, works: tuple[Work, ...], others: Array, others_mb: Array, activity: Array | None = None
) -> Shared:
    """What ``works`` get on ``machine`` beside ``others``.

    Args:
        machine: the machine.
        works: the tasks that run on it.
        others: [S, N, 2]: cores that others want, and by how many processes.
        others_mb: [S, N]: memory of others.
        activity: [S, M]: the share of its jobs that comes to each task; a task to which none comes lacks nothing
            (``None``: all jobs, always).

    A task that lacks memory pages, and does its jobs by the share of memory that it gets: the scarcer of CPU and
    memory decides.
    """
    count = len(others)
    comes = np.ones((count, len(works))) if activity is None else activity
    is_active = comes > 0.0
    needed = comes * np.array([work.demand(machine) for work in works])
    processes = np.array([float(work.processes) for work in works])
    wanted = np.concatenate([others[:, :, 0], np.minimum(needed, processes)], axis=1)
    heads = np.concatenate([others[:, :, 1], np.where(is_active, processes, 0.0)], axis=1)
    cores = share_out(machine.cores, wanted, heads)[:, others.shape[1] :]
    needed_mb = np.array([work.memory_mb for work in works])
    wanted_mb = np.concatenate([others_mb, np.tile(needed_mb, (count, 1))], axis=1)
    memory = share_out(machine.memory_mb, wanted_mb, (wanted_mb > 0).astype(float))[:, others_mb.shape[1] :]
    paged = memory / needed_mb if works else memory
    served = np.divide(cores, needed, out=np.ones_like(cores), where=is_active)
    service = np.where(is_active, np.minimum(served, paged), 1.0) if works else cores
    missed, slow = np.ones_like(service), np.ones_like(service)
    for index, work in enumerate(works):
        # While a job runs, all of its processes do: it wants more cores than on the mean.
        at_work = wanted.copy()
        at_work[:, others.shape[1] + index] = processes[index]
        runs_on = share_out(machine.cores, at_work, heads)[:, others.shape[1] + index] * paged[:, index]
        for out, within_s in ((missed, work.deadline_s), (slow, work.slow_s)):
            is_over = work.cpu_s / machine.speed > within_s * runs_on
            out[:, index] = np.where(is_over & is_active[:, index], 1.0, 1.0 - service[:, index])
    return Shared(
        cores_wanted=wanted.sum(axis=1),
        memory_wanted=wanted_mb.sum(axis=1),
        cores=cores,
        memory=memory,
        service=service,
        missed=missed,
        slow=slow,
    )
