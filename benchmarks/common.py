"""What the benchmarks share: percentiles, result lines, a quiet machine, processes, an application, revisions."""

from __future__ import annotations

import os
import statistics
import subprocess
import threading
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

import psutil
import zenoh

from zsched.core.values.model import NodeId
from zsched_lab.fleet.testbed import Testbed

REPO = Path(__file__).parents[1]


def percentile(values: Sequence[float], share: float) -> float:
    """The ``share`` (0..1) quantile of ``values`` (at least one), by linear interpolation."""
    ordered = sorted(values)
    at = share * (len(ordered) - 1)
    low = int(at)
    high = min(low + 1, len(ordered) - 1)
    return ordered[low] + (at - low) * (ordered[high] - ordered[low])


def line(name: str, values: Sequence[float], unit: str, goal: str) -> str:
    """One result: name, n, p50, p90, p99, max, goal."""
    figures = " ".join(f"p{round(100 * share)} {percentile(values, share):8.1f}" for share in (0.5, 0.9, 0.99))
    return f"{name:<52} n={len(values):<4} {figures} max {max(values):8.1f} {unit:<3} goal: {goal}"


def machine() -> str:
    """The machine and how busy it was before anything was started."""
    busy = psutil.cpu_percent(interval=1.0)
    warning = "  (BUSY: figures are not to be trusted)" if busy > 15 else ""
    return f"# {os.cpu_count()} cores, {busy:.0f} % in use before the start{warning}"


def mean(values: Sequence[float]) -> float:
    """Arithmetic mean."""
    return statistics.fmean(values)


def median_us(runs: Iterable[Sequence[float]], share: float) -> float:
    """The median of several runs' quantiles of delays in s, in microseconds; 0: nothing came."""
    values = [percentile(delays, share) for delays in runs if delays]
    return statistics.median(values) * 1e6 if values else 0.0


def cpu_s(pid: int | None) -> float:
    """The CPU seconds of a process so far; of none: 0."""
    if not pid:
        return 0.0
    times = psutil.Process(pid).cpu_times()
    return float(times.user + times.system)


def read(process: subprocess.Popen[str]) -> str:
    """The next line that a process prints."""
    assert process.stdout is not None
    return process.stdout.readline().strip()


def ask(process: subprocess.Popen[str], word: str) -> str:
    """What a process prints when it is told a word."""
    assert process.stdin is not None
    process.stdin.write(word + "\n")
    process.stdin.flush()
    return read(process)


class Pinger:
    """A robot's application: numbered messages out on its own key, echoes back, with the time of each."""

    def __init__(self, bed: Testbed, robot: NodeId, hz: float) -> None:
        self.sent_at: list[float] = []
        self.received: list[tuple[int, float]] = []
        session = bed.app(robot)
        self._publisher = session.declare_publisher(f"{robot}/in")
        self._subscriber = session.declare_subscriber(f"{robot}/out", self._on_sample)
        self._period_s = 1.0 / hz
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _on_sample(self, sample: zenoh.Sample) -> None:
        self.received.append((int(sample.payload.to_bytes()[:10]), time.monotonic()))

    def _run(self) -> None:
        while not self._stop.wait(self._period_s):
            self.sent_at.append(time.monotonic())
            self._publisher.put(f"{len(self.sent_at) - 1:010d}".encode())

    def first_after(self, moment: float) -> float | None:
        """When the first echo of a message that was *sent* after ``moment`` came back, or ``None``."""
        times = [at for number, at in self.received[-2000:] if self.sent_at[number] > moment]
        return min(times, default=None)

    def stop(self) -> None:
        """Stop sending."""
        self._stop.set()
        self._thread.join(5)


def unpacked(revision: str, folder: Path, *paths: str) -> Path:
    """This clone as it was at a git revision (only ``paths``, if any), in the new folder ``folder``, which it returns.

    Raises:
        subprocess.CalledProcessError: there is no such revision or path.
    """
    folder.mkdir()
    archive = subprocess.run(["git", "-C", str(REPO), "archive", revision, *paths], capture_output=True, check=True)
    subprocess.run(["tar", "-x", "-C", str(folder)], input=archive.stdout, check=True)
    return folder
