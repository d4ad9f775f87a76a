"""The floor of the task latency: what a merger that costs nothing would gain over fixed placement.

Knows: a bench's results, exploration in virtual time. Does not know: processes, schedules.

    python -m zsched.lab.paper.latency_floor docs/evaluation/results.json

No placing can be quicker than merged maps that come at once. So the robots of every run of a block explore its office
once more in virtual time (`zsched.lab.explore.virtual`): same world, seed, speed and target, each merged map there as
soon as it is made. How much sooner they are done than under fixed placement is the most that any scheduler can gain.
"""

from __future__ import annotations

import argparse
import json
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2

from zsched.lab.explore.body import Limits
from zsched.lab.explore.virtual import VirtualRun, run_virtual
from zsched.lab.explore.worlds import load_world
from zsched.lab.paper.claims import difference, table_of
from zsched.lab.paper.report import groups_of
from zsched.lab.paper.scenario import MATRIX
from zsched.lab.paper.schemes import FIXED_SCHEMES

Json = Mapping[str, Any]


def free_s(scenario: Json, world: str, seed: int) -> float:
    """The task latency with a merger that costs nothing, in s; the run's whole duration where it is not reached."""
    loop = scenario["explore"]
    longest_s = float(loop["duration_s"])
    plan = VirtualRun(
        world=load_world(world.replace("{seed}", str(seed))),
        seed=seed,
        target=float(loop["target_coverage"]),
        longest_s=longest_s,
        limits=Limits(speed=float(loop["speed"])),
    )
    found = run_virtual(plan).time_s
    return longest_s if found is None else found


def floor_of(scenario: Json, runs: Sequence[Json]) -> tuple[float, float, str] | None:
    """(fixed placement's latency, the free merger's, the difference in words) of a block's runs; ``None``: too few."""
    fixed = table_of(runs, "task_latency_s", FIXED_SCHEMES)
    if not fixed:
        return None
    block = scenario["blocks"].get(next(str(figures.get("block", MATRIX)) for figures in runs), {})
    world = str(block.get("world") or scenario["explore"]["world"])
    free = {run: free_s(scenario, world, int(scenario["seed"]) + run) for run in fixed}
    found = difference(free, fixed)
    return None if found is None else (statistics.fmean(fixed.values()), statistics.fmean(free.values()), found.text())


def main(arguments: list[str] | None = None) -> int:
    """Print the floor of every block of a bench's results."""
    cv2.setNumThreads(1)
    prog = "python -m zsched.lab.paper.latency_floor"
    parser = argparse.ArgumentParser(prog=prog, description=__doc__.split("\n")[0])
    parser.add_argument("results", type=Path, help="results.json of `zsched bench paper`")
    parser.add_argument("--block", action="append", default=[], help="only this one (repeatable)")
    given = parser.parse_args(arguments)
    results = json.loads(given.results.read_text(encoding="utf-8"))
    print("block            fixed s   free s  the most that any scheduler can gain")
    for title, runs in groups_of(results).items():
        name = title.partition(" ")[0]
        if (given.block and name not in given.block) or not runs:
            continue
        if (found := floor_of(results["scenario"], runs)) is not None:
            print(f"{name:<15} {found[0]:8.1f} {found[1]:8.1f}  {found[2]}", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
