"""What the timing of a worker's jobs costs: ``python -m benchmarks.jobs [--jobs 200000] [--rounds 7]``.

A callback that does nothing is called with and without a timer around it, in turns, and so is one that takes a few
milliseconds (of such jobs the process's clock is read as well). CPU time of this thread per job, the least of the
rounds; then the CPU time of one report.
"""

from __future__ import annotations

import argparse
import threading
import time
from collections.abc import Callable

from benchmarks.common import machine
from zsched.worker.jobs import JobBook, JobTimer

GOAL_US = 2.0
THREADS = 20
"""A worker has about so many, zenoh's among them."""


def nothing() -> None:
    """The least job."""


def plain(count: int, job: Callable[[], None]) -> float:
    """CPU seconds of ``count`` jobs."""
    began_s = time.thread_time()
    for _ in range(count):
        job()
    return time.thread_time() - began_s


def timed(count: int, job: Callable[[], None], timer: JobTimer) -> float:
    """The same, each of them timed."""
    began_s = time.thread_time()
    for _ in range(count):
        timer.begin()
        job()
        timer.end(0.0)
    return time.thread_time() - began_s


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.jobs", description=__doc__.partition("\n")[0])
    parser.add_argument("--jobs", type=int, default=200_000)
    parser.add_argument("--rounds", type=int, default=7)
    given = parser.parse_args()
    stop = threading.Event()
    for _ in range(THREADS):
        threading.Thread(target=stop.wait, daemon=True).start()
    print(machine())
    for name, is_long in (("a job of nothing", False), ("behind a job of 1 ms and more", True)):
        costs = []
        for _ in range(given.rounds):
            timer = JobTimer(1.0)
            if is_long:
                timer = _Long(1.0)
            bare_s = plain(given.jobs, nothing)
            costs.append((timed(given.jobs, nothing, timer) - bare_s) / given.jobs * 1e6)
        print(f"{name}: {min(costs):.2f} us a job (goal: under {GOAL_US:g})")
    book = JobBook("task", "1", lambda _word: None)
    for _ in range(3):
        timer = book.timer()
        timer.begin()
        timer.end()
    began_s = time.thread_time()
    for _ in range(1000):
        book.report()
    print(f"a report of three threads' jobs: {(time.thread_time() - began_s) * 1e3:.0f} us, at most five a second")
    stop.set()


class _Long(JobTimer):
    """Takes every job for a long one."""

    __slots__ = ()

    def begin(self) -> None:
        """As it is behind a job of a millisecond."""
        self._is_long = True
        super().begin()


if __name__ == "__main__":
    main()
