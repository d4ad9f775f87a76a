"""Estimates what placing can gain: what a merger that costs nothing would bring, against fixed placement.

Knows: a bench's results, exploration in virtual time. Does not know: processes, schedules.

    python -m zsched_lab.paper.latency_floor docs/evaluation/results.json
    python -m zsched_lab.paper.latency_floor --scenario nano        # before any run: the ceiling alone, by seed

The robots of every run of a block explore its office once more in virtual time (`zsched_lab.explore.virtual`), each
merged map there as soon as it is made: same world, speed, target, rate and cells of the merger, and warm-up. A robot's
first turn decides much, so every office is explored `TRAJECTORIES` times, by different noise of lasers and odometry.

It is an estimate of a mean, and no bound. Real robots drive by other moments of their maps, so each scheme has
trajectories of its own, and a scheme of few runs may be below it by luck. Poses are given, also where the real merger
corrects them. Steps take 0.1 s, so no merge is sooner. Its interval is over the offices.

Of robots that SLAM on the edges leads (`nano`) it is coverage instead (`zsched_lab.explore.led`): the same loop with
all the CPU that every part wants, once for each seed. A run takes a quarter of a minute, a led one half a minute.
"""

from __future__ import annotations

import argparse
import json
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
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
from zsched_lab.paper.scenario import MATRIX, MergeTask, Scenario, load_scenario
from zsched_lab.paper.schemes import FIXED_SCHEMES

Json = Mapping[str, Any]
TRAJECTORIES = 5
"""An office's robots explore it so many times."""
NEXT_NOISE = 1_000_003
"""From one trajectory's seed to the next: far from the seeds of other offices."""


def free_s(scenario: Json, block: Json, seed: int) -> float:
    """The task latency with a merger that costs nothing, in s, the mean over `TRAJECTORIES`.

    One that does not reach the target counts with the run's whole duration.
    """
    loop, longest_s = scenario["explore"], float(scenario["explore"]["duration_s"])
    merge = MergeTask(**{**scenario.get("merge", {}), **(block.get("merge") or {})})
    world = str(block.get("world") or loop["world"])
    plan = VirtualRun(
        world=load_world(world.replace("{seed}", str(seed))),
        seed=seed,
        target=float(loop["target_coverage"]),
        longest_s=longest_s,
        warm_up_s=float(scenario.get("warm_up_s", 0.0)),
        merge_period_s=1.0 / merge.rate_hz,
        resolution_m=merge.resolution_m,
        limits=Limits(speed=float(loop["speed"])),
    )
    times = [run_virtual(replace(plan, seed=seed + NEXT_NOISE * number)).time_s for number in range(TRAJECTORIES)]
    return statistics.fmean(longest_s if time_s is None else time_s for time_s in times)


def floor_of(scenario: Json, runs: Sequence[Json]) -> tuple[float, float, str] | None:
    """(fixed placement's latency, the free merger's, the difference in words) of a block's runs; ``None``: too few."""
    fixed = table_of(runs, "task_latency_s", FIXED_SCHEMES)
    if not fixed:
        return None
    block = scenario["blocks"].get(next(str(figures.get("block", MATRIX)) for figures in runs), {})
    free = {run: free_s(scenario, block, int(scenario["seed"]) + run) for run in fixed}
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
        first=loop.get("first") or {},
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
    """Print the coverage with all the CPU that is wanted, for each seed of a scenario's main block, and their mean."""
    plain, found = asdict(scenario), []
    for run in range(scenario.blocks[scenario.main].runs):
        seed = scenario.run_seed(run)
        found.append(free_coverage(plain, scenario.explore.world, seed))
        print(f"seed {seed}: covered on the way {found[-1]:.3f}", flush=True)
    print(f"mean {statistics.fmean(found):.3f}, were nothing ever late")
    return 0


def main(arguments: list[str] | None = None) -> int:
    """Print the estimate of every block of a bench's results."""
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
    unit, free_of = ("share", ceiling_of) if is_led else ("s", floor_of)
    print(f"{'block':<15} {f'fixed {unit}':>12} {f'free {unit}':>12}  what a free merger gains, an estimate")
    for title, runs in groups_of(results).items():
        name = title.partition(" ")[0]
        if (given.block and name not in given.block) or not runs:
            continue
        if (found := free_of(results["scenario"], runs)) is not None:
            print(f"{name:<15} {found[0]:>12.3g} {found[1]:>12.3g}  {found[2]}", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
