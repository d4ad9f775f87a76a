"""What a stalled target costs the others: another target's stream, and the control session.

``python -m benchmarks.isolation [--seconds 6] [--classes best_effort latest reliable]``. One robot feeds two owners
over one relay: a bulk stream (64 KiB at 200 Hz) to ``edge1``, a small one (100 Hz, echoed) to ``edge2``. Three phases:
*alone*, without the bulk stream; *bulk*; *stalled*: the bulk stream's worker is stopped for 2 s, runs for 1 s, and so
on (its link ends after zenoh's lease). Shown: the small stream's way there and back and its longest pause, and the time
in which another robot's status came over the control network (a query, answered by its decision loop).
"""

from __future__ import annotations

import argparse
import signal
import time
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import psutil
import zenoh

from benchmarks.common import machine, percentile
from zsched.host import paths as places
from zsched.host.operator_client import ask
from zsched_lab.fleet.pace import at_pace
from zsched_lab.fleet.testbed import ECHO, Testbed, echo_fleet

CLASSES = ("best_effort", "latest", "reliable")
BULK, BULK_HZ, SMALL_HZ, ASK_HZ = 65536, 200.0, 100.0, 20.0
STOPPED_S, RUNNING_S = 2.0, 1.0


def fleet(stream_class: str) -> dict[str, Any]:
    """Three robots, two edges; task ``echo`` on edge1, task ``small`` on edge2."""
    tree = echo_fleet(robots=3, edges=2, stream_class=stream_class, task={"candidates": ["edge1"], "outputs": []})
    small = echo_fleet(robots=1, edges=1)["tasks"]["echo"]
    small["candidates"] = ["edge2"]
    small["inputs"] = [{"from": "{robot}/small", "to": "{target}/small/{robot}/in", "class": stream_class}]
    small["outputs"] = [{"from": "{target}/small/{epoch}/{robot}/out", "to": "{robot}/back", "class": stream_class}]
    tree["tasks"]["small"] = {**small, "worker": {"command": list(ECHO)}}
    return tree


class Small:
    """The stream that must not notice: sent at its pace, echoed; (sent at, back at) in seconds."""

    def __init__(self, session: zenoh.Session) -> None:
        self._sent: list[float] = []
        self.back: list[tuple[float, float]] = []
        self._publisher = session.declare_publisher("robot1/small")
        self._subscriber = session.declare_subscriber("robot1/back", self._take)

    def put(self) -> None:
        """Send one."""
        self._sent.append(time.monotonic())
        self._publisher.put(str(len(self._sent) - 1).encode())

    def _take(self, sample: zenoh.Sample) -> None:
        self.back.append((self._sent[int(sample.payload.to_bytes())], time.monotonic()))


def worker_of(bed: Testbed, node: str) -> psutil.Process:
    """The echo worker that owns ``node``'s task (both run everywhere as candidates of their own only)."""
    found = [
        one for one in psutil.Process(bed.pid(node)).children(recursive=True) if "zsched.tasks.echo" in one.cmdline()
    ]
    return found[0]


def measure(bed: Testbed, small: Small, bulk: zenoh.Publisher, phase: str, seconds: float) -> str:
    """One phase; a line of figures in ms."""
    waits: list[float] = []

    def control() -> None:
        start = time.monotonic()
        answer = ask(places.socket_path(bed.folder, "robot1"), {"verb": "status", "node": "robot2"}, 5.0)
        waits.append(time.monotonic() - start if "error" not in answer else 5.0)

    begin = time.monotonic()
    target = worker_of(bed, "edge1")
    bulk_hz = 0.01 if phase == "alone" else BULK_HZ
    payload = bytes(BULK)
    try:
        with at_pace(SMALL_HZ, small.put), at_pace(bulk_hz, lambda: bulk.put(payload)), at_pace(ASK_HZ, control):
            while time.monotonic() < begin + seconds:
                if phase != "stalled":
                    time.sleep(0.1)
                    continue
                target.send_signal(signal.SIGSTOP)
                time.sleep(STOPPED_S)
                target.send_signal(signal.SIGCONT)
                time.sleep(RUNNING_S)
    finally:
        target.send_signal(signal.SIGCONT)
    mine = [pair for pair in small.back if pair[0] >= begin]
    ways = [1000 * (back - sent) for sent, back in mine]
    pause = 1000 * max((later - earlier for (_, earlier), (_, later) in pairwise(mine)), default=0.0)
    control_ms = [1000 * wait for wait in waits]
    return (
        f"{percentile(ways, 0.5):>9.1f} {percentile(ways, 0.99):>9.1f} {pause:>10.0f} "
        f"{percentile(control_ms, 0.5):>11.1f} {percentile(control_ms, 0.99):>11.1f}   {len(ways)}, {len(waits)}"
    )


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=6.0)
    parser.add_argument("--classes", nargs="+", default=CLASSES, choices=CLASSES)
    options = parser.parse_args()
    print(machine())
    print("class        phase     p50 ms    p99 ms   pause ms  control p50 control p99   n", flush=True)
    for stream_class in options.classes:
        with TemporaryDirectory() as folder, Testbed(Path(folder), fleet(stream_class)) as bed:
            bed.init()
            bed.start()
            bed.wait_settled()
            session = bed.app("robot1")
            small, bulk = Small(session), bed.app("robot1").declare_publisher("robot1/in")
            bed.wait(lambda small=small: small.put() or len(small.back) > 10, 20, "echoes")  # type: ignore[misc]
            for phase in ("alone", "bulk", "stalled"):
                figures = measure(bed, small, bulk, phase, options.seconds)
                print(f"{stream_class:<12} {phase:<8} {figures}", flush=True)


if __name__ == "__main__":
    main()
