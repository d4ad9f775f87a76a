"""CPU of one 3-robot merge by mode, side by side, on a real laser log whose maps grow while it runs.

    python benchmarks/map_merge.py [--log FILE] [--rounds N]

One log is cut into three robots with displaced frames; their grids grow in N rounds; every round the newest grids are
merged in each mode in turn (so that a busy machine hurts all of them alike). Figures are CPU of this process, one
thread, for everything a merge takes: preparing the changed maps, aligning, composing; and separately the encoding.
``estimate`` is split into merges that ran a search and merges that only tracked.
"""

from __future__ import annotations

import argparse
import platform
import time
from pathlib import Path

import cv2
import numpy as np

from zsched.tasks.map_merge.cdr import decode_grid, encode_grid
from zsched.tasks.map_merge.geometry import Pose2
from zsched.tasks.map_merge.grid import Grid
from zsched.tasks.map_merge.merger import Merger, MergeResult, MergerSettings, Mode
from zsched_lab.maps.laser_log import LaserLog, load_log, malaga_path, split_log
from zsched_lab.maps.mapping import GridMapper, displacements, truth_grid
from zsched_lab.maps.metrics import pose_errors, score_map

ROBOTS = ("robot1", "robot2", "robot3")
SEARCH_MS = "estimate, search"
Samples = dict[str, list[float]]


def main() -> None:
    """Run and print the table."""
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    arguments.add_argument("--log", type=Path, default=malaga_path(), help="CARMEN log or the Malaga CSV")
    arguments.add_argument("--rounds", type=int, default=33, help="how often the maps grow (33)")
    options = arguments.parse_args()
    cv2.setNumThreads(1)
    log = load_log(options.log)
    frames = dict(zip(ROBOTS, displacements(len(ROBOTS), seed=7), strict=True))
    samples, results = _run(log, frames, options.rounds)
    print(
        f"log {log.name}: {len(log.scans)} scans, {len(ROBOTS)} robots, {options.rounds} rounds; {platform.machine()}"
    )
    _print_costs(samples)
    _print_quality(log, frames, results)


def _run(log: LaserLog, frames: dict[str, Pose2], rounds: int) -> tuple[Samples, dict[Mode, MergeResult]]:
    poses = {Mode.KNOWN: frames, Mode.TRACK: frames, Mode.ESTIMATE: dict[str, Pose2]()}
    mergers = {mode: Merger(MergerSettings(mode=mode, poses=poses[mode])) for mode in Mode}
    mappers = {robot: GridMapper(displacement=frame, frame_id=f"{robot}/map") for robot, frame in frames.items()}
    parts = dict(zip(ROBOTS, split_log(log, len(ROBOTS)), strict=True))
    samples: Samples = {"decode a map": [], **{mode.value: [] for mode in Mode}, SEARCH_MS: [], "encode the map": []}
    results: dict[Mode, MergeResult] = {}
    for number in range(rounds):
        grids = {robot: _grown(mappers[robot], parts[robot], number, rounds, samples) for robot in ROBOTS}
        for mode, merger in mergers.items():
            for robot, grid in grids.items():
                merger.update(robot, grid)
            results[mode] = _settle(merger, mode, samples)
    return samples, results


def _grown(mapper: GridMapper, part: LaserLog, number: int, rounds: int, samples: Samples) -> Grid:
    """The robot's grid after this round, as it arrives from the wire."""
    count = len(part.scans)
    for scan in part.scans[count * number // rounds : count * (number + 1) // rounds]:
        mapper.add(scan)
    payload = encode_grid(mapper.grid(number))
    started = time.process_time()
    grid = decode_grid(payload)
    samples["decode a map"].append(1e3 * (time.process_time() - started))
    return grid


def _settle(merger: Merger, mode: Mode, samples: Samples) -> MergeResult:
    """Merge until no search waits, as the worker does within its next periods."""
    while True:
        searches = merger.searches
        started = time.process_time()
        result = merger.merge()
        spent_ms = 1e3 * (time.process_time() - started)
        is_search = mode is Mode.ESTIMATE and merger.searches > searches
        samples[SEARCH_MS if is_search else mode.value].append(spent_ms)
        if mode is Mode.KNOWN and result.grid is not None:
            started = time.process_time()
            encode_grid(result.grid)
            samples["encode the map"].append(1e3 * (time.process_time() - started))
        if not result.is_search_due:
            return result


def _print_costs(samples: Samples) -> None:
    print(f"\n{'CPU ms per merge':<20}{'n':>6}{'p50':>9}{'p90':>9}{'p99':>9}{'max':>9}")
    for name, values in samples.items():
        if values:
            p50, p90, p99 = np.percentile(values, (50, 90, 99))
            print(f"{name:<20}{len(values):>6}{p50:>9.1f}{p90:>9.1f}{p99:>9.1f}{max(values):>9.1f}")


def _print_quality(log: LaserLog, frames: dict[str, Pose2], results: dict[Mode, MergeResult]) -> None:
    truth = truth_grid(log)
    print(f"\n{'at the end':<10}{'coverage':>9}{'wall F1':>9}{'rebased':>9}{'crop':>7}  robots")
    for mode, result in results.items():
        world = frames[result.reference] if mode is Mode.ESTIMATE and result.reference else Pose2()
        score = score_map(result.grid, truth, world)
        errors = pose_errors(result.transforms, frames, result.reference or ROBOTS[0])
        figures = f"{score.coverage:>9.3f}{score.wall_f1:>9.3f}{score.ssim_rebased:>9.3f}{score.ssim_crop:>7.3f}"
        robots = []
        for status in result.statuses:
            found = f"{status.robot} {status.state.value}"
            if status.score is not None:
                found += f" score {status.score:.2f} agreeing {status.agreeing} overlap {status.overlap:.2f}"
                found += "" if status.margin is None else f" margin {status.margin:.1f}"
            if status.robot in errors:
                metres, degrees = errors[status.robot]
                found += f" off {100 * metres:.1f} cm {degrees:.2f} deg"
            robots.append(found)
        print(f"{mode.value:<10}{figures}  " + ("\n" + " " * 46).join(robots))


if __name__ == "__main__":
    main()
