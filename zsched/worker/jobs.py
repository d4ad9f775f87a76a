"""Times a worker's jobs, counts what waits and what is skipped, and lets its node know while there is work.

Knows: clocks, how often a word is worth sending. Does not know: zenoh, keys, what a job computes, what is made of it.

A job is one input sample and its callback, one request and its handler, or what the worker's author calls one (`Job`).
Two readings of the thread's CPU clock are most of what that costs; nothing is locked, for every figure has one thread
that writes it.
"""

from __future__ import annotations

import contextlib
import operator
import threading
from collections.abc import Callable
from math import inf
from time import monotonic, process_time, thread_time
from types import TracebackType
from typing import Final, Self

from zsched.core.values.events import WorkerJobs
from zsched.core.values.struct import Struct, replace
from zsched.host.guard import guarded
from zsched.host.procfs import parse_schedstat, read_file

TELL_S: Final = 0.2
"""Shortest time between two reports to the node: it measures itself as often."""
LAST_WORDS: Final = 2
"""So often it tells that it is idle."""
LONG_S: Final = 1e-3
"""Behind a job that took this long, the process's CPU clock is read as well: it costs more with more threads."""
PARALLEL, ALONE = 1.5, 1.3
"""From so many times a thread's own CPU time on, the process's time during its jobs is the jobs'; up to so many it is
somebody else's in the process."""


class JobTimer:
    """The jobs of one thread. `begin` and `end` are called in it."""

    __slots__ = (
        "_base_s",
        "_began_s",
        "_booked",
        "_booked_s",
        "_cpu_s",
        "_deadline_s",
        "_is_long",
        "_others",
        "_others_s",
        "_process_s",
        "_thread_id",
        "_waited_s",
        "age_s",
        "cpu_s",
        "done",
        "is_in_hand",
        "is_parallel",
        "late",
        "least",
        "long_process_s",
        "long_thread_s",
        "queued",
        "skipped",
        "time_s",
        "waiting",
    )

    def __init__(
        self, deadline_s: float | None = None, others: Callable[[], tuple[JobTimer, ...]] | None = None
    ) -> None:
        """``deadline_s``: a job that takes longer from arrival to end is `late`.

        ``others`` gives every timer of the process; ``None``: there is no other.
        """
        self._deadline_s, self._others = deadline_s, others
        self._others_s: dict[int, float] = {}
        """{thread: what it had run} of those that were at long jobs of their own when the job began."""
        self._began_s = self._cpu_s = self._process_s = self._waited_s = 0.0
        self._base_s: float | None = 0.0
        """What its thread had waited when it began, less what earlier ones have; ``None``: the kernel does not tell."""
        self._booked, self._booked_s = 0, 0.0
        """(`done`, what was waited until then) when a job had last ended."""
        self._thread_id = 0
        self._is_long = False
        self.is_in_hand = False
        self.is_parallel = False
        """Its jobs have helpers in other threads of the process."""
        self.done = self.late = self.skipped = 0
        self.waiting = self.least = 0
        """How many wait for their turn: now, and at least since the node was told."""
        self.queued: Callable[[], int] | None = None
        """Tells how many wait, where nobody counts them as they come."""
        self.time_s = self.cpu_s = self.age_s = 0.0
        self.long_thread_s = self.long_process_s = 0.0

    def begin(self) -> None:
        """A job begins."""
        thread_id = threading.get_native_id()
        if thread_id != self._thread_id:  # the first job, or that of a thread that has an ended one's identity
            told_s = _waited_s(thread_id)
            self._base_s = None if told_s is None else told_s - self._waited_s
            self._thread_id = thread_id
        self.is_in_hand = True
        if self._is_long:
            self._others_s = self._run_by_others()
            self._process_s = process_time()
        self._began_s = monotonic()
        self._cpu_s = thread_time()

    def end(self, came_s: float | None = None) -> None:
        """It ends; ``came_s``: when it came, by ``time.monotonic``."""
        cpu_s = thread_time() - self._cpu_s
        now = monotonic()
        took_s = now - self._began_s
        if self._is_long:
            process_s = process_time() - self._process_s - self._others_risen_s()
            self.long_thread_s += cpu_s
            self.long_process_s += process_s
            if self.is_parallel:
                cpu_s = max(cpu_s, process_s)
        self._is_long = took_s >= LONG_S
        age_s = took_s if came_s is None else now - came_s
        self.time_s += took_s
        self.cpu_s += cpu_s
        self.age_s += age_s
        if self._deadline_s is not None and age_s > self._deadline_s:
            self.late += 1
        self.is_in_hand = False
        self.done += 1

    def _run_by_others(self) -> dict[int, float]:
        timers = () if self._others is None else self._others()
        threads = {timer._thread_id for timer in timers if timer._is_long} - {self._thread_id}  # noqa: SLF001
        return {thread: times[0] for thread in threads if (times := _times_s(thread)) is not None}

    def _others_risen_s(self) -> float:
        """What other threads have run since this job began, for jobs of their own."""
        now = ((before_s, _times_s(thread)) for thread, before_s in self._others_s.items())
        return sum(times[0] - before_s for before_s, times in now if times is not None)

    def look_for_helpers(self) -> None:
        """Judge by the long jobs since the last look whether other threads of the process work on them (any thread)."""
        thread_s, process_s = self.long_thread_s, self.long_process_s
        if thread_s >= LONG_S:
            self.is_parallel = process_s > (ALONE if self.is_parallel else PARALLEL) * thread_s
            self.long_thread_s, self.long_process_s = thread_s / 2, process_s / 2

    def waited_s(self) -> float | None:
        """How long its thread has waited for a CPU in jobs that have ended; ``None``: the kernel does not tell.

        A job's wait comes with its other times. One that rose while a long job runs would fade before the job counts,
        and pass for a wait for something else. Of a thread that has ended: as far as it was seen.
        """
        base_s, thread_id = self._base_s, self._thread_id
        if base_s is None:
            return None
        told_s = _waited_s(thread_id) if thread_id else None
        if told_s is not None:
            self._waited_s = max(told_s - base_s, self._waited_s)
        if self.done != self._booked:
            self._booked, self._booked_s = self.done, self._waited_s
        return self._booked_s


def _waited_s(thread_id: int) -> float | None:
    """The run-queue delay of a thread of this process."""
    times = _times_s(thread_id)
    return None if times is None else times[1]


def _times_s(thread_id: int) -> tuple[float, float] | None:
    """How long a thread of this process has run, and has waited to run; ``None``: not told, or it has ended."""
    return parse_schedstat(read_file(f"/proc/self/task/{thread_id}/schedstat"))


class Job:
    """A job that is not a callback's (`zsched.worker.Worker.job`): a context manager, for one thread."""

    def __init__(self, timer: JobTimer, wake: Callable[[], None], came_s: float | None) -> None:
        self._timer, self._wake, self._came_s = timer, wake, came_s

    def __enter__(self) -> Self:
        self._timer.begin()
        self._wake()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._timer.end(self._came_s)


class JobBook:
    """All jobs of one worker. ``tell`` runs in a thread of its own while there is work."""

    def __init__(
        self, task: str, incarnation: str, tell: Callable[[WorkerJobs], None], deadline_s: float | None = None
    ) -> None:
        self._task, self._incarnation, self._tell, self._deadline_s = task, incarnation, tell, deadline_s
        self._since_s = monotonic()
        self._lock = threading.Lock()
        self._timers: list[JobTimer] = []
        self._own: dict[int, JobTimer] = {}
        """{thread: what its author calls jobs}; once there is one, callbacks are none any more."""
        self._is_asleep = False
        self._wake = threading.Event()
        self._closed = threading.Event()
        self._told = (0, 0)
        self._before: _Sums | None = None
        self._has_thread = False

    def timer(self) -> JobTimer:
        """For a thread that is about to serve callbacks."""
        timer = JobTimer(self._deadline_s, self._at_work)
        with self._lock:
            self._timers.append(timer)
        return timer

    def job(self, skipped: int, came_s: float | None) -> Job:
        """One job of the calling thread; ``skipped``: this many before it were left undone for it.

        Raises:
            ValueError: ``skipped`` is no whole number from 0 on, or ``came_s`` no time that has been.
        """
        count = _whole(skipped)
        if came_s is not None and not -inf < came_s <= monotonic():  # nor is `nan` such a time
            raise ValueError(f"came_s is {came_s!r}, which has not been: give it of time.monotonic, not time.time")
        thread = threading.get_ident()
        with self._lock:
            timer = self._own.get(thread)
            if timer is None:
                if not self._own:  # sums only rise: what callbacks have done until now stays in them
                    self._before = _Sums()
                    for one in self._timers:
                        self._before.add(one)
                timer = self._own[thread] = JobTimer(self._deadline_s, self._at_work)
        timer.skipped += count
        return Job(timer, self.wake, came_s)

    def wake(self) -> None:
        """There is work (any thread)."""
        if self._is_asleep or not self._has_thread:
            self._rouse()

    def close(self) -> None:
        """Tell nothing any more."""
        self._closed.set()
        self._wake.set()

    def _rouse(self) -> None:
        with self._lock:
            is_first, self._has_thread = not self._has_thread, True
        self._is_asleep = False
        self._wake.set()
        if is_first and not self._closed.is_set():
            try:
                guarded(self._run, name="zsched jobs").start()
            except RuntimeError:  # no thread is to be had: the next job tries again
                self._has_thread = False

    def _run(self) -> None:
        """Tell, every `TELL_S` while there is work, and twice behind it; then sleep until there is some.

        Twice, for a word may be lost, and a worker whose last one is not idle is taken for one that hangs.
        """
        left = 0
        while not self._closed.wait(TELL_S):
            report, counts = self.report(), self._counts()
            left = LAST_WORDS if self._is_busy() or counts != self._told else left - 1
            if left > 0:
                self._told = counts
                with contextlib.suppress(Exception):  # the session closes
                    self._tell(report)
                continue
            self._wake.clear()
            self._is_asleep = True
            if not self._is_busy() and self._counts() == counts:  # or it came just now
                self._wake.wait()
            self._is_asleep = False

    def _counts(self) -> tuple[int, int]:
        timers = self._at_work()
        return sum(timer.done for timer in timers), sum(timer.skipped for timer in timers)

    def _at_work(self) -> tuple[JobTimer, ...]:
        """Whose jobs count."""
        with self._lock:
            return tuple(self._own.values()) or tuple(self._timers)

    def _is_busy(self) -> bool:
        return any(timer.is_in_hand or timer.waiting for timer in self._at_work())

    def report(self) -> WorkerJobs:
        """What has been done so far; every waiting figure begins again."""
        sums = _Sums() if self._before is None else replace(self._before)
        waiting = 0
        for timer in self._at_work():
            timer.look_for_helpers()
            sums.add(timer)
            if timer.queued is not None:
                timer.waiting = timer.queued()
            waiting += timer.least
            timer.least = timer.waiting
        return WorkerJobs(
            task=self._task,
            incarnation=self._incarnation,
            at_s=round(monotonic() - self._since_s, 4),
            done=sums.done,
            skipped=sums.skipped,
            waiting=waiting,
            time_s=round(sums.time_s, 6),
            cpu_s=round(sums.cpu_s, 6),
            wait_s=None if sums.wait_s is None else round(sums.wait_s, 6),
            age_s=round(sums.age_s, 6),
            late=None if self._deadline_s is None else sums.late,
            is_idle=not self._is_busy(),
        )


def _whole(skipped: int) -> int:
    try:
        count = operator.index(skipped)
    except TypeError:
        count = -1
    if count < 0:
        raise ValueError(f"skipped is {skipped!r}, which is no whole number (int) from 0 on")
    return count


class _Sums(Struct):
    """Over timers."""

    done: int = 0
    skipped: int = 0
    late: int = 0
    time_s: float = 0.0
    cpu_s: float = 0.0
    wait_s: float | None = 0.0
    age_s: float = 0.0

    def add(self, timer: JobTimer) -> None:
        self.done += timer.done
        self.skipped += timer.skipped
        self.late += timer.late
        self.time_s += timer.time_s
        self.cpu_s += timer.cpu_s
        self.age_s += timer.age_s
        waited_s = None if timer.is_parallel else timer.waited_s()
        self.wait_s = None if self.wait_s is None or waited_s is None else self.wait_s + waited_s
