"""How often a living node is taken for dead: on busy cores, and on links that lose packets.

``python -m benchmarks.false_deaths [--minutes 10] [--timing wired|wifi] [--busy N] [--loss PERCENT]``. Needs root: six
daemons in network namespaces with echo workers. ``--busy N`` runs N endless loops beside them (the default is one per
core); ``--loss P`` drops P of 100 packets on their way into every namespace. Without faults every *gone* is a false
death, every newer epoch a needless move.

Goals: 0 false deaths in 10 minutes with all cores saturated (`wired` and `wifi`), 0 at 5 % loss (`wifi`); at 20 % the
figure.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.common import machine
from zsched.clock import monotonic_s
from zsched.core.model import PeerState
from zsched.lab import netns
from zsched.lab.netbed import Netbed
from zsched.lab.testbed import echo_fleet

SETTLE_S = 5.0
BUSY_LOOP = (sys.executable, "-c", "while True: pass")


def watch(bed: Netbed, seconds: float) -> None:
    """Let time pass; stop early when a daemon has died."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        time.sleep(min(5.0, max(end - time.monotonic(), 0.0)))
        for node in bed.names:
            if not Path(f"/proc/{bed.pid(node)}").exists():
                raise SystemExit(f"{node} has died:\n{bed.log(node)[-2000:]}")


def report(bed: Netbed, start: float, epochs: tuple[int, int], minutes: float, what: str) -> None:
    """One line of figures, then who accused whom."""
    changes = bed.changes(since=start)
    suspicions = [one for one in changes if one.after is PeerState.SUSPECT]
    deaths = [one for one in changes if one.after is PeerState.GONE]
    moves = epochs[1] - epochs[0]
    print(
        f"{what:<40} {minutes:g} min: false deaths {len(deaths)}, suspicions {len(suspicions)}, moves {moves}; "
        f"goal: {'-' if '20 %' in what else '0 false deaths'}"
    )
    for one in deaths[:10]:
        print(f"  {one.at - start:7.1f} s {one.observer} holds {one.node} for gone: {one.reason}")


def main() -> int:
    """Print the counts; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--timing", default="wifi", choices=["wifi", "wired"])
    parser.add_argument("--busy", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--loss", type=int, default=0)
    given = parser.parse_args()
    reason = netns.why_not()
    if reason is not None:
        print(f"no network namespaces here: {reason}", file=sys.stderr)
        return 1
    print(machine(), flush=True)
    tree = echo_fleet(timing=given.timing, scheduling={"time_to_trigger_s": 2, "cool_down_s": 10})
    loops: list[subprocess.Popen[bytes]] = []
    with tempfile.TemporaryDirectory() as folder, Netbed(Path(folder), tree) as bed:
        bed.init()
        bed.start()
        bed.wait_settled()
        bed.probe("robot1", put="robot1/in", hz=50, watch=["robot1/out"])
        try:
            loops += [subprocess.Popen(BUSY_LOOP) for _ in range(given.busy)]
            if given.loss:
                bed.network.lose(given.loss, *bed.names)
            watch(bed, SETTLE_S)
            start, before = monotonic_s(), bed.task("robot1")["epoch"]
            watch(bed, given.minutes * 60)
            epochs = (before, bed.task("robot1")["epoch"])
        finally:
            for loop in loops:
                loop.kill()
                loop.wait()
        report(bed, start, epochs, given.minutes, f"{given.timing}, {given.busy} busy loops, {given.loss} % loss")
    return 0


if __name__ == "__main__":
    sys.exit(main())
