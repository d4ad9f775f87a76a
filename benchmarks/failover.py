"""Owner killed (its daemon, SIGKILL) -> first message through the new owner, as a robot's application sees it.

``python -m benchmarks.failover [--n 40] [--timing wifi|wired] [--robots 3] [--edges 3]``. Daemons on loopback with echo
workers and a price of 0; the application publishes at 200 Hz on its own key. Reported is the time from the kill to
the first echo of a message that was sent after it: detection, vote, commit, handover, and one round trip through the
new worker.
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from pathlib import Path

from benchmarks.common import Pinger, line, machine
from zsched_lab.fleet.testbed import Json, Testbed, echo_fleet

GOAL = "p99 300 ms"


def measure(bed: Testbed, pinger: Pinger) -> float:
    """One cycle: kill the owner, wait for echoes, bring it back; milliseconds."""
    owner = bed.wait_settled()
    start = time.monotonic()
    bed.kill(owner)
    after = bed.wait(lambda: pinger.first_after(start), 20, "an echo after the kill")
    bed.start(owner)
    bed.wait(lambda: bed.status(owner), 20, f"{owner} back")
    bed.wait(lambda: _sees_ready(bed.status(owner), owner), 20, f"the worker on {owner}")
    ready_at = time.monotonic()
    bed.wait(lambda: _is_ready(bed, owner, ready_at), 20, f"everybody knows of the worker on {owner}")
    return ((after or start) - start) * 1000


def _is_ready(bed: Testbed, node: str, ready_at: float) -> bool:
    """Whether everybody has heard of the node's worker since it is ready: else the next kill finds no candidate.

    What they know may be the node's last word before it was killed; and who has not heard it again confirms nothing.
    """
    return all(_sees_ready(bed.status(one), node, time.monotonic() - ready_at) for one in bed.names if one != node)


def _sees_ready(status: Json, node: str, within_s: float = math.inf) -> bool:
    (seen,) = [one for one in status["nodes"] if one["name"] == node]
    states = [worker["state"] for worker in seen["workers"]]
    age_s = 0.0 if seen["age_s"] is None else seen["age_s"]
    return bool(seen["state"] == "alive" and states == ["ready"] and age_s < within_s)


def main() -> None:
    """Print the distribution."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--n", type=int, default=40)
    parser.add_argument("--timing", default="wifi", choices=["wifi", "wired"])
    parser.add_argument("--robots", type=int, default=3)
    parser.add_argument("--edges", type=int, default=3)
    arguments = parser.parse_args()
    print(machine())
    tree = echo_fleet(robots=arguments.robots, edges=arguments.edges, timing=arguments.timing)
    with tempfile.TemporaryDirectory() as folder, Testbed(Path(folder), tree) as bed:
        bed.init()
        bed.start()
        bed.wait_settled()
        pinger = Pinger(bed, "robot1", hz=200)
        bed.wait(lambda: len(pinger.received) > 50, 20, "echoes")
        times = []
        for number in range(arguments.n):
            times.append(measure(bed, pinger))
            print(f"  {number + 1}/{arguments.n}: {times[-1]:.0f} ms", flush=True)
        pinger.stop()
    print(line(f"owner killed -> first message ({arguments.timing})", times, "ms", GOAL))


if __name__ == "__main__":
    main()
