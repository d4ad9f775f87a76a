"""GATEWAY: what one job of a task takes, as its worker tells it.

Knows: work and waits of a job, what of a time was which. Does not know: what a task needs on the mean
(`zsched.core.gateway.demand`).

Jobs that come irregularly wait for each other, and the more of its time a worker is busy the longer, by more than the
time of a job: ``u / (1 - u)`` times it, and some factor for how irregular they are (Kingman 1961, "The single server
queue in heavy traffic"). That factor is the task's, and what it is seen to be on its owner counts on every machine. A
queue that was taken along as it is would make a slow machine look as quick as its owner (docs/decisions/0118).
"""

from __future__ import annotations

from zsched.core.values.profile import Jobs
from zsched.core.values.struct import Struct

CALM_WAIT_RATIO = 0.1
"""Jobs that wait for a CPU for a smaller part of their time show their usual wait in the queue."""
RANDOM_QUEUEING = 1.0
"""Until it was seen, jobs count as coming at random."""
LEAST_FREE_CORES = 0.05
"""A job on a full machine gets at least this much, so that its time is finite."""
BUSY_FROM, BUSY_TO = 0.01, 0.9
"""The part of its time that a worker is busy: beyond these nobody knows how long its queue is."""
MOST_QUEUE_RATIO = 20.0
"""No queue makes a job's age more than this many times its own time: whatever was told, it is much too late then."""


class JobNeed(Struct, frozen=True):
    """One job's need, by its worker's report, where it ran."""

    work_s: float
    """CPU time at speed 1."""
    other_s: float
    """Its wait for things other than a CPU and its turn, the same on every machine."""
    queueing: float
    """How irregularly jobs come: their wait for each other is so many times `crowd` of their time, >= 0."""
    hz: float
    """How often they come, > 0."""
    holds_turn: bool = False
    """Its worker is busy while it waits for other things, too, and takes the next one behind it."""
    is_guess: bool = False
    """A job of several threads that was seen on full machines only: how long it takes alone is a guess."""

    def age_s(self, speed: float, free_cores: float) -> float:
        """Expected seconds from arrival to end where a job gets this many cores while it runs, at most one."""
        stretch = 1.0 / min(max(free_cores, LEAST_FREE_CORES), 1.0)
        held_s, beside_s = (self.other_s, 0.0) if self.holds_turn else (0.0, self.other_s)
        cpu_s = self.work_s / speed
        queue_ratio = min(1.0 + self.queueing * crowd(self.hz * (held_s + cpu_s)), MOST_QUEUE_RATIO)
        return beside_s + queue_ratio * (held_s + stretch * cpu_s)


def crowd(busy: float) -> float:
    """How many jobs wait, on the mean, for a worker that is ``busy`` for this part of its time, if they come at random.

    >>> round(crowd(0.5), 3), round(crowd(7.0), 3)
    (1.0, 9.0)
    """
    busy = min(max(busy, BUSY_FROM), BUSY_TO)
    return busy / (1.0 - busy)


def other_s(jobs: Jobs) -> float:
    """A job's wait for things other than a CPU; 0 where the kernel does not report it."""
    return 0.0 if jobs.wait_s is None else max(jobs.time_s - jobs.wait_s - jobs.cpu_s, 0.0)


def told_job(
    jobs: Jobs,
    speed: float,
    known: JobNeed | None,
    *,
    is_calm: bool,
    threads: float | None = None,
) -> JobNeed:
    """A job by its worker's report, on a machine of ``speed``.

    ``known``: what was known before. ``threads``: how many of its threads work on a job at once, as far as that is
    seen. ``is_calm``: the machine has CPU to spare.

    A job of several threads does not tell how long it waits for a CPU, and on a full machine its whole time is no work.
    What of its time is no CPU time is a wait for other things, a GPU perhaps, where the machine had CPU to spare.
    """
    cpu_s, waits_s = jobs.cpu_s, other_s(jobs)
    is_guess = jobs.wait_s is None and not is_calm and (known is None or known.is_guess)
    if jobs.wait_s is None:
        cpu_s = _at_once(jobs.cpu_s, jobs.time_s, speed, known, is_calm=is_calm)
        if is_guess:  # alone they would share its work
            cpu_s = min(cpu_s, jobs.cpu_s / max(threads or 1.0, 1.0))
        waits_s = _for_others(jobs.time_s - cpu_s, known, is_calm=is_calm)
    crowded = crowd(jobs.wanted_hz * (waits_s + cpu_s))
    queueing = RANDOM_QUEUEING if known is None else known.queueing
    if jobs.age_s is not None and jobs.time_s > 0.0:
        seen = (min(max(jobs.age_s / jobs.time_s, 1.0), MOST_QUEUE_RATIO) - 1.0) / crowded
        waits_little = is_calm if jobs.wait_s is None else jobs.wait_s <= CALM_WAIT_RATIO * jobs.time_s
        queueing = seen if waits_little else min(seen, queueing)
    return JobNeed(
        work_s=cpu_s * speed,
        other_s=waits_s,
        queueing=queueing,
        hz=max(jobs.wanted_hz, jobs.done_hz),
        holds_turn=True,
        is_guess=is_guess,
    )


def _at_once(cpu_s: float, time_s: float, speed: float, known: JobNeed | None, *, is_calm: bool) -> float:
    """For how long a job works whose threads spend ``cpu_s`` in all: several at once work for no longer than it takes.

    On a full machine it takes longer by waits for a CPU, so what was known counts as the most.
    """
    cpu_s = min(cpu_s, time_s)
    return cpu_s if is_calm or known is None else min(cpu_s, known.work_s / speed)


def _for_others(rest_s: float, known: JobNeed | None, *, is_calm: bool) -> float:
    """What of a job's time that is no work is a wait for other things; on a full machine that of before, at most."""
    if is_calm:
        return max(rest_s, 0.0)
    return 0.0 if known is None else min(max(rest_s, 0.0), known.other_s)
