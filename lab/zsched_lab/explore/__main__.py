"""``python -m zsched_lab.explore``: what a late merged map costs, measured in virtual time over several seeds.

Knows: runs, delays, the table, the picture. Does not know: zenoh, daemons: see `zsched_lab.explore.robot` for those.

Prints one line per run as NDJSON with ``--json``, else a table of the time to the target coverage, for each delay with
its mean and the difference to the first delay over the same seeds (paired, with a 95 % bootstrap interval).
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from zsched.core.values.errors import ConfigError
from zsched.core.values.exits import EXIT_CONFIG
from zsched_lab.explore.body import Limits
from zsched_lab.explore.picture import Picture, save_pictures
from zsched_lab.explore.virtual import VirtualResult, VirtualRun, run_virtual
from zsched_lab.explore.worlds import load_world
from zsched_lab.maps.metrics import score_map

RESAMPLES = 10_000

Times = dict[float, list[float]]
"""{delay_s: time to the target (s), one per seed; the whole duration where it was not reached}."""


def paired_interval(later: Sequence[float], sooner: Sequence[float]) -> tuple[float, float]:
    """The 95 % bootstrap interval of the mean of paired differences."""
    differences = np.subtract(later, sooner)
    draws = np.random.default_rng(0).integers(0, differences.size, (RESAMPLES, differences.size))
    low, high = np.percentile(differences[draws].mean(axis=1), (2.5, 97.5))
    return float(low), float(high)


def figures(run: VirtualRun, result: VirtualResult) -> dict[str, object]:
    """One run in figures."""
    score = score_map(result.merged, run.world.truth())
    return {
        "world": run.world.name,
        "seed": run.seed,
        "delay_s": run.delay_s,
        "time_s": result.time_s,
        "way_m": round(result.way_m, 1),
        "goals": result.goals,
        "coverage": round(score.coverage, 4),
        "wall_f1": round(score.wall_f1, 4),
        "ssim_rebased": round(score.ssim_rebased, 4),
    }


def table(times: Mapping[float, Sequence[float]]) -> list[str]:
    """The times as lines."""
    first, base = next(iter(times.items()))
    lines = [
        f"{'delay':>7}  {'mean':>7}  {'median':>7}  {'min':>6}  {'max':>6}  later than {first:g} s [95 % interval]"
    ]
    for delay, values in times.items():
        line = f"{delay:5.1f} s  {statistics.fmean(values):5.1f} s  {statistics.median(values):5.1f} s"
        line += f"  {min(values):4.1f} s  {max(values):4.1f} s"
        if delay != first:
            low, high = paired_interval(values, base)
            share = statistics.fmean(values) / statistics.fmean(base) - 1.0
            mean = statistics.fmean(values) - statistics.fmean(base)
            line += f"  {mean:+.1f} s [{low:+.1f}, {high:+.1f}], {share:+.0%}"
        lines.append(line)
    return lines


def parser() -> argparse.ArgumentParser:
    """The arguments."""
    arguments = argparse.ArgumentParser(prog="python -m zsched_lab.explore", description=__doc__.split("\n")[0])
    add = arguments.add_argument
    add("--world", default="office:1", help="turtlebot3, office:SEED[:LENGTH] or a map_server .yaml (office:1)")
    add("--delays", default="0,5", help="seconds from a merge to the robots, comma-separated (0,5)")
    add("--seeds", type=int, default=5, help="runs per delay, with the seeds 1.. (5)")
    add("--robots", type=int, default=3)
    add("--target", type=float, default=0.9, help="coverage of the merged map (0.9)")
    add("--longest", type=float, default=300.0, help="virtual seconds after which a run ends anyway (300)")
    add("--speed", type=float, default=Limits().speed, help="m/s at most")
    add("--json", action="store_true", help="one line of JSON per run instead of the table")
    add("--png", type=Path, help="draw the first seed's runs into this file")
    return arguments


def main(arguments: list[str] | None = None) -> int:
    """Run all; 0, or 78 when the world cannot be read."""
    cv2.setNumThreads(1)
    given = parser().parse_args(arguments)
    delays = [float(delay) for delay in given.delays.split(",")]
    try:
        world = load_world(given.world)
        world.starts(given.robots)
    except ConfigError as error:
        sys.stderr.write(f"explore: {error}\n")
        return EXIT_CONFIG
    times: Times = {delay: [] for delay in delays}
    pictures = []
    for seed in range(1, given.seeds + 1):
        for delay in delays:
            run = VirtualRun(
                world=world,
                seed=seed,
                robots=given.robots,
                delay_s=delay,
                target=given.target,
                longest_s=given.longest,
                limits=Limits(speed=given.speed),
            )
            result = run_virtual(run)
            times[delay].append(given.longest if result.time_s is None else result.time_s)
            if given.json:
                print(json.dumps(figures(run, result)), flush=True)
            if seed == 1:
                title = f"merged map {delay:g} s late: {times[delay][-1]:.1f} s"
                pictures.append(
                    Picture(title=title, merged=result.merged, paths=result.paths, coverage=result.coverage)
                )
    if not given.json:
        print("\n".join(table(times)))
    if given.png is not None:
        title = f"{world.name}, {given.robots} robots, to {given.target:.0%} of the world, seed 1, virtual time"
        save_pictures(given.png, world.truth(), pictures, title)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
