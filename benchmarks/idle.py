"""What a daemon and its relay cost while nothing happens: memory and CPU of every node in a fleet of six.

``python -m benchmarks.idle [--seconds 60]``. Workers are not counted. PSS shares the pages that the processes have in
common; on a robot that runs one node the private part (USS) plus the libraries counts, which RSS bounds.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import psutil

from benchmarks.common import machine, mean
from zsched_lab.fleet.testbed import Testbed, echo_fleet

MIB = 1024 * 1024


@dataclass(frozen=True, slots=True)
class Usage:
    """One process: MiB, and percent of one core over the whole time."""

    rss: float
    pss: float
    uss: float
    cpu: float


def relay_of(pid: int) -> psutil.Process:
    """The relay process of a daemon."""
    for child in psutil.Process(pid).children():
        if "zsched.relay" in child.cmdline():
            return child
    raise RuntimeError(f"daemon {pid} has no relay")


def measure(processes: list[psutil.Process], seconds: float) -> list[Usage]:
    """Memory now and CPU over ``seconds`` of every process."""
    before = [sum(process.cpu_times()[:2]) for process in processes]
    time.sleep(seconds)
    usages = []
    for process, start in zip(processes, before, strict=True):
        memory = process.memory_full_info()
        cpu = 100 * (sum(process.cpu_times()[:2]) - start) / seconds
        usages.append(Usage(memory.rss / MIB, memory.pss / MIB, memory.uss / MIB, cpu))
    return usages


def show(name: str, usages: list[Usage]) -> str:
    """One line of means, with the largest PSS and CPU."""
    parts = [f"{field} {mean([getattr(usage, field) for usage in usages]):5.1f}" for field in ("rss", "pss", "uss")]
    largest, busiest = max(usage.pss for usage in usages), max(usage.cpu for usage in usages)
    cpu = mean([usage.cpu for usage in usages])
    return f"{name:<22} {'  '.join(parts)} MiB (largest pss {largest:.1f})   cpu {cpu:.2f} % (largest {busiest:.2f})"


def main() -> None:
    """Print daemon, relay and their sum per node."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    arguments = parser.parse_args()
    print(machine())
    with tempfile.TemporaryDirectory() as folder, Testbed(Path(folder), echo_fleet()) as bed:
        bed.init()
        bed.start()
        bed.wait_settled()
        time.sleep(5)  # the start's own work must not count
        daemons = [psutil.Process(bed.pid(node)) for node in bed.names]
        relays = [relay_of(daemon.pid) for daemon in daemons]
        usages = measure(daemons + relays, arguments.seconds)
    half = len(usages) // 2
    robots = sum(name.startswith("robot") for name in bed.names)
    nodes = [
        Usage(d.rss + r.rss, d.pss + r.pss, d.uss + r.uss, d.cpu + r.cpu)
        for d, r in zip(usages[:half], usages[half:], strict=True)
    ]
    print(f"means of {half} nodes ({robots} robots), {arguments.seconds:g} s")
    print(show("daemon", usages[:half]))
    print(show("relay", usages[half:]))
    print(show("node (daemon + relay)", nodes) + "   goal: pss 50 MB, cpu 1 %")


if __name__ == "__main__":
    main()
