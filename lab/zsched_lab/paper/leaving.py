"""How soon each scheme has left a loaded edge: from the planned start of a load to the move.

Knows: a bench's results, when load was planned. Does not know: processes, why a task moved.

    python -m zsched_lab.paper.leaving docs/evaluation/heavy-calm.json

A move counts when the edge that it leaves is loaded at that moment. The injected process takes a moment to start, and
that moment counts, too.
"""

from __future__ import annotations

import argparse
import json
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from zsched_lab.paper.load import schedule
from zsched_lab.paper.report import groups_of
from zsched_lab.paper.scenario import LoadPlan

Json = Mapping[str, Any]
GOAL_S = 3.0
"""A step is to be followed within this time."""


def left_after_s(scenario: Json, run: Json) -> list[float]:
    """Seconds from the start of a load to the move away from it, of one run's moves."""
    load, nodes = scenario["load"], list(scenario["nodes"])
    busy_s, idle_s = load["busy_s"], load["idle_s"]
    plan = LoadPlan(
        lanes=int(load["lanes"]),
        busy_s=(float(busy_s[0]), float(busy_s[1])),
        idle_s=(float(idle_s[0]), float(idle_s[1])),
        first_s=float(load["first_s"]),
    )
    windows = schedule(plan, nodes, float(scenario["duration_s"]), int(run["seed"]))
    found: list[float] = []
    for (_, owner), (moved_s, _) in zip(run["owners"], run["owners"][1:], strict=False):
        starts = [one.start_s for one in windows if one.node == owner and one.start_s <= moved_s <= one.end_s]
        found += [moved_s - max(starts)] if starts else []
    return sorted(found)


def told(scenario: Json, runs: Sequence[Json]) -> list[str]:
    """A line for each scheme that has left a loaded edge."""
    lines: list[str] = []
    for scheme in dict.fromkeys(str(run["scheme"]) for run in runs):
        times = sorted(one for run in runs if run["scheme"] == scheme for one in left_after_s(scenario, run))
        if times:
            soon = sum(one <= GOAL_S for one in times)
            spread = f"{times[0]:.1f} to {times[-1]:.1f} s, median {statistics.median(times):.1f}"
            lines.append(f"{scheme:<15} {spread}; {soon} of {len(times)} moves within {GOAL_S:g} s")
    return lines


def main(arguments: list[str] | None = None) -> int:
    """Print the times of every block of a bench's results."""
    prog = "python -m zsched_lab.paper.leaving"
    parser = argparse.ArgumentParser(prog=prog, description=__doc__.split("\n")[0])
    parser.add_argument("results", type=Path, help="results.json of `zsched bench paper`")
    results = json.loads(parser.parse_args(arguments).results.read_text(encoding="utf-8"))
    for title, runs in groups_of(results).items():
        lines = told(results["scenario"], runs)
        if lines:
            print("\n".join([title.partition(" (")[0], *lines]))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
