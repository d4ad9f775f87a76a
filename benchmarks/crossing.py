"""What a crossing costs a sample, from an application of one cell to one of another: real daemons on loopback.

``python -m benchmarks.crossing [--n 500] [--gateways edge1 edge2]``. Two cells of a robot and two edges each; the input
and the output are ``reliable``. Paced: one sample at a time, 10 ms apart (1 MiB: 50 ms). Flat out: as fast as the
publisher is let.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

import zenoh

from benchmarks.common import machine, percentile
from zsched.clock import monotonic_s
from zsched_lab.fleet.crossing import CAME, GIVING, SENT, TAKING, cell, let_cross, relays
from zsched_lab.fleet.testbed import Testbed

KIB, MIB = 1 << 10, 1 << 20
WAIT_S = 120.0


class Run:
    """Samples with a number, when each was put, and when it came."""

    def __init__(self, writer: zenoh.Session, reader: zenoh.Session) -> None:
        self.came: dict[int, float] = {}
        self._subscriber = reader.declare_subscriber(CAME, self._take)
        self._publisher = writer.declare_publisher(SENT, congestion_control=zenoh.CongestionControl.BLOCK)

    def _take(self, sample: zenoh.Sample) -> None:
        self.came[int.from_bytes(sample.payload.to_bytes()[:8], "big")] = monotonic_s()

    def measure(self, bed: Testbed, size: int, count: int, pause_s: float) -> tuple[list[float], float]:
        """(seconds that each sample took, seconds of all)."""
        self.came.clear()
        put: list[float] = []
        for number in range(count):
            put.append(monotonic_s())
            self._publisher.put(number.to_bytes(8, "big") + bytes(size - 8))
            time.sleep(pause_s)
        bed.wait(lambda: len(self.came) == count, WAIT_S, f"{count} samples")
        return [self.came[number] - at for number, at in enumerate(put)], max(self.came.values()) - put[0]


def main() -> int:
    """The table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--n", type=int, default=500, help="samples of 1 KiB; a tenth of it of 1 MiB")
    parser.add_argument("--gateways", nargs="+", default=["edge1", "edge2"], help="nodes of the cell that takes")
    given = parser.parse_args()
    print(machine())
    print("| payload | how | n | p50, ms | p99, ms | samples/s | MB/s |")
    print("| --- | --- | ---: | ---: | ---: | ---: | ---: |")
    here, there = cell(GIVING), cell(TAKING)
    let_cross(here, there, gateways=relays(there, *given.gateways))
    with ExitStack() as stack:
        beds = []
        for tree in (there, here):
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix=f"zsched-{tree['fleet']}-")))
            beds.append(stack.enter_context(Testbed(folder, tree)))
            beds[-1].init()
            beds[-1].start()
        for bed in beds:
            bed.wait_whole()
        run = Run(beds[1].app("robot1"), beds[0].app("robot1"))
        run.measure(beds[0], KIB, 20, 0.05)
        for name, size, count, pause_s in (
            ("1 KiB", KIB, given.n, 0.01),
            ("1 KiB", KIB, 4 * given.n, 0.0),
            ("1 MiB", MIB, given.n // 10, 0.05),
            ("1 MiB", MIB, given.n // 5, 0.0),
        ):
            delays, took_s = run.measure(beds[0], size, count, pause_s)
            how = "paced" if pause_s else "flat out"
            times = " | ".join(f"{1e3 * percentile(delays, share):.1f}" for share in (0.5, 0.99))
            print(f"| {name} | {how} | {count} | {times} | {count / took_s:.0f} | {count * size / took_s / 1e6:.1f} |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
