"""The most that any placing can gain: what a merger that costs nothing would bring, against fixed placement.

Knows: a bench's results, exploration in virtual time. Does not know: processes, schedules.

    python -m zsched_lab.paper.latency_floor docs/evaluation/results.json
    python -m zsched_lab.paper.latency_floor --scenario nano        # before any run: the ceiling alone, by seed

No placing can be quicker than merged maps that come at once. So the robots of every run of a block explore its office
once more in virtual time (`zsched_lab.explore.virtual`): same world, seed, speed and target, each merged map there as
soon as it is made. How much sooner they are done than under fixed placement is the most that any scheduler can gain.

Of robots that SLAM on the edges leads (`nano`) it is the ceiling of coverage instead (`zsched_lab.explore.led`): the
same loop with all the CPU that every part wants. It takes about half a minute for each run.
"""

from __future__ import annotations

import argparse
import json
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2

from zsched_lab.explore.body import Limits
from zsched_lab.explore.led import LedRun, run_led
from zsched_lab.explore.virtual import VirtualRun, run_virtual
from zsched_lab.explore.worlds import load_world
from zsched_lab.paper.claims import difference, table_of
from zsched_lab.paper.places import shipped_scenario
from zsched_lab.paper.report import groups_of
from zsched_lab.paper.robots import ODOMETRY
from zsched_lab.paper.scenario import MATRIX, Scenario, load_scenario
from zsched_lab.paper.schemes import FIXED_SCHEMES

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


def free_coverage(scenario: Json, world: str, seed: int) -> float:
    """The mean coverage over a run of led robots, were nothing ever late."""
    loop, merge = scenario["explore"], scenario["merge"]
    plan = LedRun(
        world=load_world(world.replace("{seed}", str(seed))),
        seed=seed,
        duration_s=float(loop["duration_s"]),
        warm_up_s=float(scenario["warm_up_s"]),
        merge_period_s=1.0 / float(merge["rate_hz"]),
        map_period_s=float(loop["map_period_s"]),
        min_agreeing=int(merge["min_agreeing"]),
        limits=Limits(speed=float(loop["speed"])),
        drift=ODOMETRY,
    )
    return run_led(plan).mean


def ceiling_of(scenario: Json, runs: Sequence[Json]) -> tuple[float, float, str] | None:
    """(coverage on the way under fixed placement, were nothing late, the difference in words); ``None``: too few."""
    fixed = table_of(runs, "coverage_mean", FIXED_SCHEMES)
    free = {
        run: free_coverage(scenario, str(scenario["explore"]["world"]), int(scenario["seed"]) + run) for run in fixed
    }
    found = difference(free, fixed)
    return None if found is None else (statistics.fmean(fixed.values()), statistics.fmean(free.values()), found.text())


def tell_ceiling(scenario: Scenario) -> int:
    """Print the ceiling of coverage for each seed of a scenario's main block, and their mean."""
    plain, found = asdict(scenario), []
    for run in range(scenario.blocks[scenario.main].runs):
        seed = scenario.run_seed(run)
        found.append(free_coverage(plain, scenario.explore.world, seed))
        print(f"seed {seed}: covered on the way {found[-1]:.3f}", flush=True)
    print(f"mean {statistics.fmean(found):.3f}, were nothing ever late")
    return 0


def main(arguments: list[str] | None = None) -> int:
    """Print the floor of every block of a bench's results."""
    cv2.setNumThreads(1)
    prog = "python -m zsched_lab.paper.latency_floor"
    parser = argparse.ArgumentParser(prog=prog, description=__doc__.split("\n")[0])
    parser.add_argument("results", type=Path, nargs="?", help="results.json of `zsched bench paper`")
    parser.add_argument("--scenario", help="a shipped scenario of led robots: print its ceiling, without any results")
    parser.add_argument("--block", action="append", default=[], help="only this one (repeatable)")
    given = parser.parse_args(arguments)
    if (given.results is None) == (given.scenario is None):
        parser.error("give results.json, or --scenario NAME")
    if given.scenario is not None:
        path = shipped_scenario(given.scenario)
        if path is None or (scenario := load_scenario(path)).explore.slam_share is None:
            parser.error(f"--scenario: {given.scenario!r} is no shipped scenario of led robots")
        return tell_ceiling(scenario)
    results = json.loads(given.results.read_text(encoding="utf-8"))
    is_led = results["scenario"]["explore"].get("slam_share") is not None
    unit, bound_of = ("share", ceiling_of) if is_led else ("s", floor_of)
    print(f"{'block':<15} {f'fixed {unit}':>12} {f'free {unit}':>12}  the most that any scheduler can gain")
    for title, runs in groups_of(results).items():
        name = title.partition(" ")[0]
        if (given.block and name not in given.block) or not runs:
            continue
        if (found := bound_of(results["scenario"], runs)) is not None:
            print(f"{name:<15} {found[0]:>12.3g} {found[1]:>12.3g}  {found[2]}", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
