"""Owner killed (its daemon, SIGKILL) -> every robot knows a successor, while every fsync of every node is slow.

``python -m benchmarks.slow_disk [--ms 0 100 200 1000] [--n 3] [--robots 3] [--edges 3]``. Daemons on loopback with echo
workers; a library between the daemons and the C library holds up each fsync (`zsched_lab.fleet.slow_disk`, needs a C
compiler). Reported is the time from the kill until all robots have learnt another living owner, and until the streams
of all of them are switched to it.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from pathlib import Path

from benchmarks.common import machine
from zsched_lab.fleet.slow_disk import SlowDisk
from zsched_lab.fleet.testbed import Testbed, echo_fleet

MOST_S = 90.0


def measure(bed: Testbed, disk: SlowDisk, ms: int) -> tuple[float, float]:
    """One kill: seconds until all robots know a successor, and until their streams are switched to it."""
    owner = bed.wait_whole()
    disk.take(ms)
    robots = tuple(node.name for node in bed.fleet.nodes if node.name.startswith("robot"))
    start = time.monotonic()
    bed.kill(owner)
    bed.wait(lambda: all(bed.task(one)["owner"] not in {owner, None} for one in robots), MOST_S, "a successor")
    known_s = time.monotonic() - start
    bed.wait(lambda: bed.owner(*robots) not in {owner, None}, MOST_S, "switched streams")
    switched_s = time.monotonic() - start
    disk.take(0)
    return known_s, switched_s


def main() -> None:
    """Print a line for each delay."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--ms", type=int, nargs="+", default=[0, 100, 200, 1000])
    parser.add_argument("--n", type=int, default=3)
    parser.add_argument("--robots", type=int, default=3)
    parser.add_argument("--edges", type=int, default=3)
    arguments = parser.parse_args()
    print(machine())
    tree = echo_fleet(robots=arguments.robots, edges=arguments.edges)
    for ms in arguments.ms:
        with tempfile.TemporaryDirectory() as folder:
            disk = SlowDisk(Path(folder))
            with disk.under(), Testbed(Path(folder), tree) as bed:
                bed.init()
                bed.start()
                times = [measure(bed, disk, ms) for _ in range(arguments.n)]
        known, switched = zip(*times, strict=True)
        shown = ", ".join(f"{one:.2f}" for one in known)
        print(
            f"fsync + {ms} ms: successor known after {statistics.median(known):.2f} s ({shown}), "
            f"streams switched after {statistics.median(switched):.2f} s, at most {max(switched):.2f} s",
            flush=True,
        )


if __name__ == "__main__":
    main()
