"""How many fault schedules the simulator plays a minute: ``python -m benchmarks.simulate [--runs 300] [--jobs 2]``.

Schedules of 30 virtual seconds with 3 to 7 nodes, as CI plays them. One line per fleet size with the time of one
schedule on one core, then the rate with all processes.
"""

from __future__ import annotations

import argparse
import os
import time

from benchmarks.common import line, machine
from zsched_lab.sim.simulate import Job, play_all
from zsched_lab.sim.swarm import MAX_NODES, MIN_NODES

GOAL = "3000 in 240 s on 2 cores: 160 ms of a core each"
MILLISECONDS = 1000.0


def one_by_one(nodes: int, runs: int) -> list[float]:
    """CPU time of each schedule, in milliseconds."""
    took = []
    for seed in range(runs):
        began_at = time.process_time()
        Job(seed=seed, nodes=nodes).play()
        took.append((time.process_time() - began_at) * MILLISECONDS)
    return took


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.simulate", description=__doc__)
    parser.add_argument("--runs", type=int, default=300)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    given = parser.parse_args()
    print(machine())
    for nodes in range(MIN_NODES, MAX_NODES + 1):
        print(line(f"one schedule, {nodes} nodes", one_by_one(nodes, max(given.runs // 10, 2)), "ms", GOAL), flush=True)
    began_at = time.monotonic()
    results = [result for _, result in play_all((Job(seed=seed) for seed in range(given.runs)), given.jobs)]
    took_s = time.monotonic() - began_at
    violations = sum(bool(result.violation) for result in results)
    print(f"{60 * given.runs / took_s:.0f} schedules a minute with {given.jobs} processes, {violations} violations;")
    print(f"{sum(result.events for result in results) / took_s:.0f} events a second")


if __name__ == "__main__":
    main()
