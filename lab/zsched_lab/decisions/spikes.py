"""Measures spikes of real readings on the demo's edges: ``python -m zsched_lab.decisions.spikes FILE``.

Knows: the demo as a child, the production's device profiler, which looks at every edge's control group from outside.
Does not know: what the figures are used for (they are `zsched_lab.decisions.loads.SPIKES`).

An edge of the demo is a control group with daemon, relay, worker and load. A spike is short; a step of load is none.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import psutil

from zsched.host.machine.device_profiler import DeviceProfiler
from zsched_lab.decisions.loads import Array

PERIOD_S: Final = 0.2
MEDIAN_S: Final = 11.0
LEAST: Final = 0.25
"""A spike is at least so much of the machine above the median of the readings about it: four times their scatter."""
LONGEST_S: Final = 2.0
"""What lasts longer is a load."""
EDGES: Final = ("edge1", "edge2", "edge3")
LEVELS: Final = ((0.0, 0.25), (0.25, 0.75), (0.75, 1.01))
"""Medians, as shares of the machine: at rest, at work, loaded."""
SKIP_S: Final = (15.0, 10.0)
"""Starts and ends of programs are left out."""
QUARTERS: Final = (0.0, 0.25, 0.5, 0.75, 1.0)
UP_S: Final = 30.0
"""The demo's edges run within this time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Spike:
    """Readings above their median: which is the first, how many, and the mean of what they are above it."""

    begin: int
    count: int
    height: float


def medians(read: Array) -> Array:
    """The median of the readings about each."""
    half = round(MEDIAN_S / PERIOD_S / 2)
    return np.array([np.median(read[max(index - half, 0) : index + half + 1]) for index in range(len(read))])


def spikes(read: Array) -> list[Spike]:
    """The short excursions of shares of a machine.

    >>> [(one.count, one.height) for one in spikes(np.array([0.1] * 30 + [0.5, 0.7] + [0.1] * 30 + [1.0] * 40))]
    [(2, 0.5)]
    """
    above = read - medians(read)
    found = []
    begin = None
    for index, is_high in enumerate([*(above >= LEAST).tolist(), False]):
        if is_high and begin is None:
            begin = index
        elif not is_high and begin is not None:
            if (index - begin) * PERIOD_S <= LONGEST_S:
                height = float(above[begin:index].mean())
                found.append(Spike(begin=begin, count=index - begin, height=round(height, 3)))
            begin = None
    return found


def daemons(parent: int) -> dict[str, int]:
    """{edge: process id of its daemon} among the descendants of ``parent``."""
    found: dict[str, int] = {}
    for child in psutil.Process(parent).children(recursive=True):
        try:
            words = child.cmdline()
        except psutil.Error:
            continue
        if "up" in words and "--node" in words and (node := words[words.index("--node") + 1]) in EDGES:
            found.setdefault(node, child.pid)
    return found


def watch(pids: Mapping[str, int], demo: subprocess.Popen[bytes]) -> dict[str, list[float]]:
    """CPU readings of every edge, as shares of its quota, until one of them ends."""
    profilers = {node: DeviceProfiler(pid=str(pid)) for node, pid in pids.items()}
    read: dict[str, list[float]] = {node: [] for node in pids}
    while demo.poll() is None and all(psutil.pid_exists(pid) for pid in pids.values()):
        for node, profiler in profilers.items():
            sample = profiler.sample({})
            if sample.cpu_used_cores is not None:
                read[node].append(round(min(sample.cpu_used_cores / sample.cpu_cores, 1.0), 3))
        time.sleep(PERIOD_S)
    return read


def measure(seconds: float) -> dict[str, list[float]]:
    """The readings of one demo. Raises `SystemExit` when its edges do not come up."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "zsched.cli", "demo", "--headless", "--duration", f"{seconds:g}"]
        demo = subprocess.Popen([*command, "--out", f"{folder}/out"], stdout=subprocess.DEVNULL)
        try:
            end = time.monotonic() + UP_S
            while len(pids := daemons(demo.pid)) < len(EDGES):
                if demo.poll() is not None or time.monotonic() > end:
                    sys.exit("the demo's edges did not come up")
                time.sleep(PERIOD_S)
            return watch(pids, demo)
        finally:
            demo.terminate()
            demo.wait(60)


def describe(read: Mapping[str, Sequence[float]]) -> str:
    """One line per level of use: how often, how high, how long (least, quartiles, most)."""
    lines = []
    first, last = (round(skip_s / PERIOD_S) for skip_s in SKIP_S)
    shares = {node: np.asarray(values[first:-last]) for node, values in read.items() if len(values) > first + last}
    for low, high in LEVELS:
        total_s, found = 0.0, []
        for values in shares.values():
            middle = medians(values)
            is_here = (low <= middle) & (middle < high)
            total_s += float(is_here.sum()) * PERIOD_S
            found += [one for one in spikes(values) if is_here[one.begin]]
        said = f"median {low:g} to {min(high, 1.0):g}: {total_s / 60:.1f} min, {len(found)} spikes"
        if found:
            heights = np.quantile([one.height for one in found], QUARTERS)
            lengths_s = np.quantile([one.count * PERIOD_S for one in found], QUARTERS)
            said += f", one in {total_s / len(found):.1f} s"
            said += f"; height {' '.join(f'{one:.2f}' for one in heights)}"
            said += f"; length, s {' '.join(f'{one:.1f}' for one in lengths_s)}"
        lines.append(said)
    return "\n".join(lines)


def main() -> None:
    """Measure and print; with ``--show`` print what was measured before."""
    parser = argparse.ArgumentParser(prog="python -m zsched_lab.decisions.spikes", description=__doc__)
    parser.add_argument("--seconds", type=float, default=300.0, help="of the demo (default 300)")
    parser.add_argument("file", type=Path, help="of the readings")
    parser.add_argument("--show", action="store_true", help="measure nothing: describe the file")
    given = parser.parse_args()
    if not given.show:
        given.file.write_text(json.dumps(measure(given.seconds)), encoding="utf-8")
    print(describe(json.loads(given.file.read_text(encoding="utf-8"))))


if __name__ == "__main__":
    main()
