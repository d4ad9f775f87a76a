"""Half an hour of random moves under ten streams: loss, memory, descriptors and threads over time.

``python -m benchmarks.soak [--minutes 30] [--seed 1]``. Three edges with echo workers, ten reliable streams of 20 to
200 Hz and 100 B to 20 kB, a move to a random other edge every 1 to 5 s, now and then a killed worker or a killed relay
(of an edge). A second application receives all answers and freezes for seconds at a time; what it may have missed is
counted, and the first one misses nothing by it. Every minute: private memory, descriptors and threads of the robot's
relay and of the workers, and whether its counters account for every sample (`zsched.core.hop.books`). The exit code is
1 if they do not, or if at the end more samples have not come back than the counters tell of.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.bystander import Bystander
from benchmarks.common import machine
from benchmarks.rig import Load, Rig, Traffic, routes
from zsched.core.values.plan import StreamClass
from zsched_lab.fleet.relays import ROBOT
from zsched_lab.fleet.waiting import until

EDGES = ("edge1", "edge2", "edge3")


def main() -> int:
    """Print one line a minute and the sums; 1 when a sample is in no counter, or was lost without being in one."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--no-faults", action="store_true")
    options = parser.parse_args()
    print(machine())
    random_ = random.Random(options.seed)
    with tempfile.TemporaryDirectory() as folder, Rig(Path(folder), EDGES) as rig:
        with Bystander(rig.endpoint(ROBOT), f"{ROBOT}/*/out", options.seed) as bystander:
            broken = _run(rig, random_, options.minutes * 60, has_faults=not options.no_faults)
            drops = [dict(count.drops) for name, count in rig.counts().items() if "/out/" in name]
        missed, overflow = (sum(one.get(reason, 0) for one in drops) for reason in ("slow_reader", "overflow"))
        print(f"a second application froze {bystander.freezes} times and may have missed {missed}; overflow {overflow}")
    print(f"looks at which a stream's counters did not account for every sample, and silent losses: {broken}")
    return 1 if broken else 0


def _run(rig: Rig, random_: random.Random, seconds: float, *, has_faults: bool) -> int:
    """Move the streams for ``seconds``; returns the looks at unbalanced books plus the streams that lost silently."""
    loads = tuple(
        Load(name=f"s{n}", hz=random_.choice([20, 50, 100, 200]), size=random_.choice([100, 1000, 20_000]))
        for n in range(10)
    )
    for edge in EDGES:
        rig.start_worker(edge)
    session = rig.application()
    traffics = [Traffic(session, load) for load in loads]
    now = routes("edge1", 1, loads, StreamClass.RELIABLE)
    rig.move(now)
    until(lambda: all(traffic.is_connected for traffic in traffics), "the application sees the relay")
    for traffic in traffics:
        traffic.start()
    end, next_line = time.monotonic() + seconds, 0.0
    moves = crashes = broken = 0
    while time.monotonic() < end:
        if time.monotonic() >= next_line:
            broken += _line(rig, traffics, moves, crashes)
            next_line = time.monotonic() + 60
        time.sleep(random_.uniform(1, 5))
        is_crash = has_faults and random_.random() < 0.05
        owner = random_.choice([edge for edge in EDGES if edge != now.owner])
        if is_crash:
            crashes += 1
            rig.workers[now.owner].kill()
            rig.workers[now.owner].wait(5)
        elif has_faults and random_.random() < 0.03:
            os.kill(rig.relays[now.owner].pid or 0, signal.SIGKILL)
        new = routes(owner, now.epoch + 1, loads, StreamClass.RELIABLE)
        rig.move(new, now, is_crash=is_crash)
        if is_crash:
            rig.start_worker(now.owner)
        now, moves = new, moves + 1
    for traffic in traffics:
        traffic.stop()
    time.sleep(2)
    broken += _line(rig, traffics, moves, crashes)
    silent = rig.silent_losses(traffics)
    print("".join(f"SILENT {one}\n" for one in silent), end="")
    print(f"reported 'at most N lost': {sum(rig.left_behind())} samples in {len(rig.left_behind())} slots")
    return broken + len(silent)


def _line(rig: Rig, traffics: list[Traffic], moves: int, crashes: int) -> bool:
    """Print how things are; whether the books of a stream are not balanced."""
    lost, doubled, reordered = (sum(part) for part in zip(*(traffic.result() for traffic in traffics), strict=True))
    parts = [f"{name} {mb:.1f} MB {fds} fd {threads} thr" for name, (mb, fds, threads) in rig.memory().items()]
    sent = sum(len(traffic.sent) for traffic in traffics)
    clock = time.strftime("%H:%M:%S")
    print(f"{clock} moves {moves} crashes {crashes} sent {sent} open {lost} doubled {doubled} reordered {reordered}")
    print("         " + " | ".join(parts), flush=True)
    missing = rig.unaccounted()
    print("".join(f"{clock} BROKEN {one}\n" for one in missing), end="", flush=True)
    return bool(missing)


if __name__ == "__main__":
    sys.exit(main())
