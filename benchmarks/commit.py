"""Trigger -> committed: from the first robot's proposal for a move to the commit, and until every robot knows.

``python -m benchmarks.commit [--n 200] [--robots 3] [--edges 3] [--period 1.0]``. Real daemons on loopback, each with
its relay, and with its worker on edges. Every robot's link to the edges follows a synthetic recording in which the
best edge changes every period; with price and bonus at 0 each change is a vote.
Times are read from the daemons' own logs (one host, one clock, whole milliseconds). The last line says how much of all
cores the machine used meanwhile: near 100 % the figures are of the cores, not of zsched.
"""

from __future__ import annotations

import argparse
import re
import tempfile
from datetime import datetime
from pathlib import Path
from typing import Any

from benchmarks.common import line, machine
from zsched_lab.fleet.testbed import TASK, Testbed, echo_fleet

GOAL = "p99 50 ms"
PERIOD_S = 1.0
TRACE_S = 600
SETTLE_S = 30.0
START_S = 3.0
"""For each node, at most."""
STAMP = r"^(\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3}) INFO "
PROPOSED = re.compile(STAMP + rf"zsched\.scheduler task={TASK} epoch=(\d+) propose ")
LEARNT = re.compile(STAMP + rf"zsched\.vote task={TASK} epoch=(\d+) learnt revision")


def write_trace(path: Path, edges: tuple[str, ...], period_s: float) -> None:
    """A recording at 5 Hz in which the edges are the best in turn (-45 dBm, the others -75 dBm)."""
    rows = [f"time_stamp,{','.join(edges)},"]
    for step in range(TRACE_S * 5):
        best = int(step / 5 / period_s) % len(edges)
        signals = ",".join("-45" if number == best else "-75" for number in range(len(edges)))
        rows.append(f"{step * 200_000_000},{signals},")
    path.write_text("\n".join(rows) + "\n")


def fleet(folder: Path, robots: int, edges: int, period_s: float) -> dict[str, Any]:
    """The echo fleet with recorded links and no stickiness at all."""
    trace, names = folder / "links.csv", tuple(f"edge{number}" for number in range(1, edges + 1))
    write_trace(trace, names, period_s)
    tree = echo_fleet(
        robots=robots,
        edges=edges,
        scheduling={"price_s": 0, "bonus": 0},
        weights={"cpu": 0.0, "memory": 0.0, "network": 1.0},
    )
    tree["timing"] = {"profile": "wifi", "smoothing_s": 0.2}
    for name, node in tree["nodes"].items():
        if name.startswith("robot"):
            node["links"] = {edge: {"trace": {"file": str(trace), "column": edge}} for edge in names}
    return tree


def stamps(pattern: re.Pattern[str], logs: list[str]) -> dict[int, list[float]]:
    """{epoch: times in ms} of every log line that matches."""
    found: dict[int, list[float]] = {}
    for log in logs:
        for text in log.splitlines():
            match = pattern.match(text)
            if match:
                moment = datetime.strptime(match[1] + "000", "%Y-%m-%d %H:%M:%S,%f").timestamp()  # noqa: DTZ007 - only differences count
                found.setdefault(int(match[2]), []).append(moment * 1000)
    return found


def busy() -> tuple[float, float]:
    """Ticks that all cores were busy, and idle, since the machine started."""
    words = Path("/proc/stat").read_text().splitlines()[0].split()[1:9]
    ticks = [float(word) for word in words]
    idle = ticks[3] + ticks[4]  # idle, iowait
    return sum(ticks) - idle, idle


def main() -> None:
    """Print both distributions."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--n", type=int, default=200)
    parser.add_argument("--robots", type=int, default=3)
    parser.add_argument("--edges", type=int, default=3)
    parser.add_argument("--period", type=float, default=PERIOD_S, help="seconds between two changes of the best edge")
    arguments = parser.parse_args()
    robots, nodes = arguments.robots, arguments.robots + arguments.edges
    print(machine())
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with Testbed(folder, fleet(folder, robots, arguments.edges, arguments.period)) as bed:
            bed.init()
            bed.start()
            bed.wait_whole(SETTLE_S + START_S * nodes)
            first, begin = int(bed.task("robot1")["epoch"]), busy()
            bed.wait(
                lambda: bed.task("robot1")["epoch"] > first + arguments.n,
                SETTLE_S + 3 * arguments.period * arguments.n,
                "enough moves",
            )
            used = [now - before for now, before in zip(busy(), begin, strict=True)]
            logs = [bed.log(robot) for robot in bed.fleet.voters]
    proposed, learnt = stamps(PROPOSED, logs), stamps(LEARNT, logs)
    epochs = [
        epoch for epoch in sorted(learnt) if epoch > first and epoch - 1 in proposed and len(learnt[epoch]) == robots
    ]
    committed = [min(learnt[epoch]) - min(proposed[epoch - 1]) for epoch in epochs]
    known = [max(learnt[epoch]) - min(proposed[epoch - 1]) for epoch in epochs]
    print(line(f"first proposal -> committed ({nodes} nodes)", committed, "ms", GOAL))
    print(line("first proposal -> learnt by every robot", known, "ms", "-"))
    print(f"cores busy meanwhile: {100 * used[0] / sum(used):.0f} %, other work of the machine included")


if __name__ == "__main__":
    main()
