"""Measures how much real readings scatter about a steady load: ``python -m zsched_lab.decisions.scatter``.

Knows: a control group with a quota, a neural network that runs in it at a fixed rate, the production's device profiler.
Does not know: what the figures are used for (they are the defaults of `zsched_lab.decisions.loads.Scatter`).
"""

from __future__ import annotations

import argparse
import contextlib
import os
import subprocess
import sys
import time

import numpy as np

from zsched.core.values.errors import AdapterError
from zsched.host.machine.device_profiler import DeviceProfiler
from zsched_lab.decisions.loads import Array
from zsched_lab.fleet.groups import LimitedGroup

PERIOD_S = 0.2
QUOTA_CORES = 0.5
RATES_HZ = (0.0, 2.0, 4.0)
"""Frames per second of the network (0: idle)."""


def describe(read: Array) -> tuple[float, float, float, float]:
    """(mean, standard deviation about an 11 s mean, correlation with the reading before, largest) of readings."""
    window = min(len(read), round(11.0 / PERIOD_S))
    mean = np.convolve(read, np.ones(window) / window, mode="same") / np.convolve(
        np.ones(len(read)), np.ones(window) / window, mode="same"
    )
    rest = read - mean
    spread = float(rest.std())
    keep = float((rest[1:] * rest[:-1]).mean() / rest.var()) if spread > 0.0 else 0.0
    return float(read.mean()), spread, keep, float(read.max())


def watch(seconds: float, rate_hz: float) -> tuple[Array, Array]:
    """CPU and memory readings, as shares of a group of `QUOTA_CORES`, while the network runs at ``rate_hz`` in it."""
    group = LimitedGroup.create(f"scatter-{os.getpid()}", cpu_cores=QUOTA_CORES, memory_mb=768)
    command = [
        sys.executable,
        "-m",
        "zsched_lab.fleet.neural_load",
        "--hz",
        f"{rate_hz:g}",
        "--duration",
        str(seconds + 20),
    ]
    load = subprocess.Popen(command, stdout=subprocess.DEVNULL) if rate_hz else None
    try:
        if load is not None:
            group.add(load.pid)
        group.add(os.getpid())
        time.sleep(6.0 if load is not None else 1.0)  # the network loads its model
        profiler = DeviceProfiler()
        cpu, memory = [], []
        for _ in range(round(seconds / PERIOD_S)):
            read = profiler.sample({})
            if read.cpu_used_cores is not None and read.memory_used_mb is not None:
                cpu.append(read.cpu_used_cores / read.cpu_cores)
                memory.append(read.memory_used_mb / read.memory_mb)
            time.sleep(PERIOD_S)
        return np.asarray(cpu), np.asarray(memory)
    finally:
        if load is not None:
            load.terminate()
            load.wait(10)


def main() -> None:
    """Measure and print, one line per rate. Each rate runs in a child, which leaves its group behind empty."""
    parser = argparse.ArgumentParser(prog="python -m zsched_lab.decisions.scatter", description=__doc__)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--rate", type=float, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if (reason := LimitedGroup.why_not()) is not None:
        sys.exit(f"no control group: {reason}")
    if given.rate is None:
        for rate_hz in RATES_HZ:
            _measure(rate_hz, given.seconds)
        return
    for metric, read in zip(("cpu", "memory"), watch(given.seconds, given.rate), strict=True):
        mean, spread, keep, most = describe(read)
        print(
            f"{metric:<7} at {given.rate:g} Hz: mean {mean:.3f} scatter {spread:.4f} correlation {keep:+.2f} "
            f"largest {most:.3f} n={len(read)}"
        )


def _measure(rate_hz: float, seconds: float) -> None:
    command = [sys.executable, "-m", "zsched_lab.decisions.scatter", "--rate", str(rate_hz), "--seconds", str(seconds)]
    child = subprocess.Popen(command)
    try:
        child.wait(seconds + 60)
    finally:
        child.kill()
        child.wait()
        with contextlib.suppress(AdapterError, OSError):
            LimitedGroup.create(f"scatter-{child.pid}", cpu_cores=QUOTA_CORES, memory_mb=768).remove()


if __name__ == "__main__":
    main()
