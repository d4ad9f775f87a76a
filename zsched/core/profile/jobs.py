"""PROFILE, the task's own word: a worker's reports of its jobs, as smoothed means and rates.

Knows: sums that only rise, smoothing. Does not know: how a job is timed (`zsched.worker.jobs`), what follows from it.

Rates are smoothed like the CPU in use, and a mean per job is the quotient of two such rates. So ``done_hz`` times
``cpu_s`` is the CPU use of the jobs, in step with the measured use of the worker's processes.

A worker that is idle, and has left nothing undone since the last look, lacks nothing from then on: its earlier undone
work does not fade like a mean. Its CPU use drops at once, and a lack that fades slowly beside it would look like a
worker that gets no CPU.

A waiting job is not lost. Jobs are *left undone* when they give way to newer ones, or when more and more wait: the
fewest of the last `QUEUE_S` count, so three maps that come at once and are merged one by one are no loss.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final

from zsched.core.profile.means import STALE_S, Ewma
from zsched.core.values.events import WorkerJobs
from zsched.core.values.profile import MAX_JOB_S, MAX_JOBS_HZ, Jobs

QUEUE_S = 2.0
"""A longer wait shows that the worker is behind, and not that several jobs came at once."""
MAX_AT_ONCE = 64.0
"""No worker runs more jobs at a time: a sum of times that rises faster was made up."""
UNENDED_S = 1.0
"""For less time than this nobody need be told that no job has ended."""
LEAST_HZ = 1e-3
"""At a lower rate there are too few jobs for a mean: the last one stands."""


class JobMeter:
    """The jobs of one worker of this node."""

    def __init__(self, tau_s: float) -> None:
        """``tau_s``: the time constant of all means."""
        self.value: Jobs | None = None
        """Result of the last look."""
        self._tau_s = tau_s
        self._works_since: float | None = None
        """Since when there has been work, and no job has ended; ``None``: it was idle by its newest report."""
        self._newest: WorkerJobs | None = None
        self._heard_at = -math.inf
        self._looked: WorkerJobs | None = None
        self._looked_at = -math.inf
        self._queue: deque[tuple[float, int]] = deque()
        """(when, how many waited) of the last `QUEUE_S`, and one from before."""
        self._undone = 0
        self._means: dict[str, Ewma] = {}

    def retune(self, tau_s: float) -> None:
        """Go on with another time constant."""
        self._tau_s = tau_s
        for mean in self._means.values():
            mean.tau_s = tau_s

    def absorb(self, report: WorkerJobs, now: float) -> bool:
        """Take a worker's report in; whether it is possible after the one before."""
        newest = self._newest
        is_same_life = newest is not None and report.incarnation == newest.incarnation
        if not _is_possible(report) or (newest is not None and is_same_life and not _follows(report, newest)):
            return False
        if not is_same_life:
            self._begin(report, now)
        has_ended = newest is None or not is_same_life or report.done > newest.done
        if report.is_idle:
            self._works_since = None
        elif self._works_since is None or has_ended or now - self._heard_at > STALE_S:  # it may have been idle
            self._works_since = now
        self._newest, self._heard_at = report, now
        self._queue.append((now, report.waiting))
        return True

    def unended_s(self, now: float) -> float | None:
        """For how many seconds the worker has had work, and has ended no job; ``None``: for less than `UNENDED_S`.

        One that falls silent with work in hand counts on: a callback that keeps Python's lock silences its reports.
        """
        if self._works_since is None:
            return None
        for_s = now - self._works_since
        return min(for_s, MAX_JOB_S) if for_s >= UNENDED_S else None

    def end(self) -> None:
        """The worker has ended, whatever it had in hand; the next one begins idle."""
        self._works_since = None

    def look(self, now: float) -> None:
        """Smooth the reports since the last look, at the moment of the machine's sample."""
        newest, before, since = self._newest, self._looked, self._looked_at
        self._looked_at = now
        if newest is None or before is None:
            return
        undone = newest.skipped + self._least_waiting(now)
        was_undone, self._looked, self._undone = self._undone, newest, undone
        if now - self._heard_at > STALE_S:  # a worker that has nothing to do says nothing
            self._means.clear()
            self.value = None
        elif 0.0 < now - since < STALE_S:
            self._smooth(before, newest, undone - was_undone, since, now)
            self._evaluate(newest)

    def _begin(self, report: WorkerJobs, now: float) -> None:
        """The worker has another life; its work before the first report is no rate of now."""
        waited = report.waiting if report.done else 0
        self._looked, self._undone = report, report.skipped + waited
        self._queue = deque([(now, waited)])
        self._means.clear()
        self.value = None

    def _least_waiting(self, now: float) -> int:
        while len(self._queue) > 1 and self._queue[1][0] <= now - QUEUE_S:
            self._queue.popleft()
        return min(waiting for _, waiting in self._queue)

    def _smooth(self, before: WorkerJobs, newest: WorkerJobs, undone: int, since: float, now: float) -> None:
        risen: dict[str, float] = {"undone": float(undone), "done": float(newest.done - before.done)}
        for name in _SUMS:
            was, is_now = getattr(before, name), getattr(newest, name)
            if was is not None and is_now is not None:
                risen[name] = is_now - was
        for name in tuple(self._means):
            if name not in risen:
                del self._means[name]  # not told any more
        if risen["done"] <= 0.0 and "done" not in self._means:
            return  # nothing is known of a job yet
        for name, rise in risen.items():
            if name not in self._means:  # as what the processes use: from nothing
                self._means[name] = Ewma(self._tau_s)
                self._means[name].update(0.0, since)
            self._means[name].update(rise / (now - since), now)
        if newest.is_idle and undone <= 0:
            self._means["undone"].value = 0.0

    def _evaluate(self, newest: WorkerJobs) -> None:
        done_hz = self._rate("done")
        if done_hz is None or done_hz < LEAST_HZ:
            return

        def per_job(name: str, most: float) -> float | None:
            rate = self._rate(name)
            return None if rate is None else min(max(rate, 0.0) / done_hz, most)

        self.value = Jobs(
            time_s=per_job("time_s", MAX_JOB_S) or 0.0,
            cpu_s=per_job("cpu_s", MAX_JOB_S) or 0.0,
            wait_s=per_job("wait_s", MAX_JOB_S),
            age_s=per_job("age_s", MAX_JOB_S),
            done_hz=min(done_hz, MAX_JOBS_HZ),
            wanted_hz=min(max(done_hz + (self._rate("undone") or 0.0), 0.0), MAX_JOBS_HZ),
            backlog=newest.waiting,
            late_ratio=per_job("late", 1.0),
        )

    def _rate(self, name: str) -> float | None:
        return self._means[name].value if name in self._means else None


_SUMS: Final = ("time_s", "cpu_s", "wait_s", "age_s", "late")


def _is_possible(report: WorkerJobs) -> bool:
    """Whether a worker can have done this much since its life began."""
    most_s = MAX_AT_ONCE * (report.at_s + 1.0)
    return max(report.time_s, report.cpu_s, report.wait_s or 0.0) <= most_s and report.done <= MAX_JOBS_HZ * most_s


def _follows(report: WorkerJobs, before: WorkerJobs) -> bool:
    """Whether a worker can have come from ``before`` to ``report``: sums only rise."""
    rises = [report.at_s - before.at_s, report.done - before.done, report.skipped - before.skipped]
    for name in _SUMS:
        was, is_now = getattr(before, name), getattr(report, name)
        if was is not None and is_now is not None:
            rises.append(is_now - was)
    return min(rises) >= 0
