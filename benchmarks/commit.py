"""Trigger -> committed: from the first robot's proposal for a move to the commit, and until every robot knows.

``python -m benchmarks.commit [--n 200]``. Three robots and three edges on loopback. Every robot's link to the edges
follows a synthetic recording in which the best edge changes every second; with patience, bonus and cool-down at
0, and nothing foreseen, each change is a vote. Times are read from the daemons' own logs (one host, one clock, whole
milliseconds).
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
STAMP = r"^(\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3}) INFO "
PROPOSED = re.compile(STAMP + rf"zsched\.scheduler task={TASK} epoch=(\d+) propose ")
LEARNT = re.compile(STAMP + rf"zsched\.vote task={TASK} epoch=(\d+) learnt revision")


def write_trace(path: Path) -> None:
    """A recording at 5 Hz in which edge1, edge2 and edge3 are the best in turn (-45 dBm, the others -75 dBm)."""
    rows = ["time_stamp,edge1,edge2,edge3,"]
    for step in range(TRACE_S * 5):
        best = int(step / 5 / PERIOD_S) % 3
        signals = ",".join("-45" if edge == best else "-75" for edge in range(3))
        rows.append(f"{step * 200_000_000},{signals},")
    path.write_text("\n".join(rows) + "\n")


def fleet(folder: Path) -> dict[str, Any]:
    """The echo fleet with recorded links and no stickiness at all."""
    trace = folder / "links.csv"
    write_trace(trace)
    tree = echo_fleet(
        scheduling={"patience": 0, "bonus": 0, "cool_down_s": 0, "max_moves_per_minute": 1000},
        weights={"cpu": 0.0, "memory": 0.0, "network": 1.0},
        task={"link": {"foresee_s": 0}},  # a signal that jumps every second has no trend to be foreseen
    )
    tree["timing"] = {"profile": "wifi", "smoothing_s": 0.2}
    for name, node in tree["nodes"].items():
        if name.startswith("robot"):
            edges = ("edge1", "edge2", "edge3")
            node["links"] = {edge: {"trace": {"file": str(trace), "column": edge}} for edge in edges}
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


def main() -> None:
    """Print both distributions."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--n", type=int, default=200)
    arguments = parser.parse_args()
    print(machine())
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with Testbed(folder, fleet(folder)) as bed:
            bed.init()
            bed.start()
            bed.wait(
                lambda: bed.task("robot1")["epoch"] > arguments.n + 1, 30 + 3 * PERIOD_S * arguments.n, "enough moves"
            )
            robots = [bed.log(robot) for robot in bed.fleet.voters]
    proposed, learnt = stamps(PROPOSED, robots), stamps(LEARNT, robots)
    epochs = [epoch for epoch in sorted(learnt) if epoch > 1 and epoch - 1 in proposed and len(learnt[epoch]) == 3]
    committed = [min(learnt[epoch]) - min(proposed[epoch - 1]) for epoch in epochs]
    known = [max(learnt[epoch]) - min(proposed[epoch - 1]) for epoch in epochs]
    print(line("first proposal -> committed (6 nodes)", committed, "ms", GOAL))
    print(line("first proposal -> learnt by every robot", known, "ms", "-"))


if __name__ == "__main__":
    main()
