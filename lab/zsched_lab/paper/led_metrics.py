"""Figures of coverage over time, and of robots that SLAM on the edges leads: how long they stood, how well they knew.

Knows: the records of a run. Does not know: other runs, schemes.
"""

from __future__ import annotations

import bisect
import itertools
import math
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from zsched.core.values.model import NodeId
from zsched.tasks.map_merge.geometry import Pose2
from zsched_lab.fleet.recorder import read_records
from zsched_lab.paper.arrivals import Streams
from zsched_lab.paper.load import Window, loaded_at
from zsched_lab.paper.roles import state_of

CURVE_S = 5.0
"""Coverage over time is recorded this often."""
Json = dict[str, Any]


def coverage_figures(streams: Streams, duration_s: float, most_s: float, area_m2: float) -> Json:
    """Coverage over time: the share of the truth's known cells that the robots' newest merged map knows, their mean.

    ``coverage_curve`` is [[t_s, share], ...] every `CURVE_S` from 0 and at the end; ``coverage_mean`` its mean over
    that time (each value holds until the next), ``explored_m2`` the known area at the end. The end is ``most_s``, which
    a run may take: what a run knew when it was done after ``duration_s`` holds from there on, or a run that is done
    sooner would count for less. ``walls_mean`` is the same mean of the truth's walls that the map has where they are:
    coverage counts what is known, right or wrong. A robot without a map knows nothing.
    """
    within = [[one for one in maps if one.t_s <= duration_s] for maps in streams.maps.values()]
    by_robot = [
        ([one.t_s for one in maps], [one.known for one in maps], [one.walls for one in maps]) for maps in within
    ]
    end_s = max(duration_s, most_s)
    instants = [CURVE_S * number for number in range(int(end_s / CURVE_S) + 1)]
    instants += [end_s] if instants[-1] < end_s else []
    curve = [[t_s, statistics.fmean(held_at(times, known, t_s) for times, known, _ in by_robot)] for t_s in instants]
    return {
        "coverage_curve": [[t_s, round(share, 4)] for t_s, share in curve],
        "coverage_mean": statistics.fmean(held_mean(times, known, end_s) for times, known, _ in by_robot),
        "walls_mean": statistics.fmean(held_mean(times, walls, end_s) for times, _, walls in by_robot),
        "explored_m2": curve[-1][1] * area_m2,
    }


def held_at(times: Sequence[float], shares: Sequence[float], t_s: float) -> float:
    """The newest map's share at ``t_s``; ``shares`` are those of the maps of ``times``, 0 before the first."""
    index = bisect.bisect_right(times, t_s)
    return shares[index - 1] if index else 0.0


def held_mean(times: Sequence[float], shares: Sequence[float], duration_s: float) -> float:
    """The mean of that over [0, ``duration_s``]."""
    steps = [0.0, *(t_s for t_s in times if 0.0 < t_s < duration_s), duration_s]
    return sum((b - a) * held_at(times, shares, a) for a, b in itertools.pairwise(steps)) / duration_s


def led_figures(folder: Path, run: Mapping[str, Any]) -> Json:
    """Of robots that SLAM elsewhere leads, over the drive, their mean: how long they stood, corrections, pose errors.

    ``stopped_ratio`` of the time with a last correction older than 1 s; ``corrections_hz``; ``correction_age_max_s``;
    ``pose_error_m``: how far the belief is from the truth, its median. ``None``: no such robots.
    """
    told = [led_of(read_records(folder / "records" / f"{robot}.ndjson"), run) for robot in run["robots"]]
    names = ("stopped_ratio", "corrections_hz", "correction_age_max_s", "pose_error_m")
    known = [one for one in told if one is not None]
    return {name: statistics.fmean(one[name] for one in known) if known else None for name in names}


def led_of(records: Sequence[Json], run: Mapping[str, Any]) -> dict[str, float] | None:
    """The same of one robot; ``None`` where nothing led it."""
    zero_s, duration_s = float(run["zero_s"]), float(run["duration_s"])
    inside = [record for record in records if zero_s <= float(record["t_s"]) <= zero_s + duration_s]
    progress = [record for record in inside if record["kind"] == "progress"]
    if len(progress) < 2 or not progress[-1].get("corrections"):
        return None
    first, last = progress[0], progress[-1]
    seconds = float(last["t_s"]) - float(first["t_s"])
    return {
        "stopped_ratio": (float(last["stopped_s"]) - float(first["stopped_s"])) / seconds,
        "corrections_hz": (int(last["corrections"]) - int(first["corrections"])) / seconds,
        "correction_age_max_s": max(float(record["correction_age_s"]) for record in progress),
        "pose_error_m": statistics.median(pose_errors(records, zero_s, duration_s)),
    }


def stood_figures(
    folder: Path,
    run: Mapping[str, Any],
    slam_on: Mapping[NodeId, Callable[[float], NodeId | None]],
    owners: Callable[[float], NodeId | None],
) -> Json:
    """{state of its SLAM's edge: {"s": robots' seconds, "stood": share of them}}, over the drive.

    The states are those of `zsched_lab.paper.roles.state_of`. ``slam_on`` tells for each robot where its SLAM was when,
    ``owners`` who owned the task when. A moment counts by both its ends, so one in which a load, the task or SLAM came
    or went counts for no state. Empty: nobody led a robot.
    """
    found: dict[str, list[float]] = {}
    zero_s, duration_s = float(run["zero_s"]), float(run["duration_s"])
    loads = [
        Window(node=load["node"], start_s=float(load["start_s"]), end_s=float(load["end_s"])) for load in run["loads"]
    ]
    for robot in sorted(slam_on):
        records = read_records(folder / "records" / f"{robot}.ndjson")
        told = [record for record in records if record["kind"] == "progress" and record.get("corrections")]

        def state(t_s: float, slam: Callable[[float], NodeId | None] = slam_on[robot]) -> tuple[NodeId | None, str]:
            node = slam(t_s)
            return node, state_of(node in loaded_at(loads, t_s), node is not None and owners(t_s) == node)

        for before, after in itertools.pairwise(told):
            begin, end = float(before["t_s"]) - zero_s, float(after["t_s"]) - zero_s
            if begin >= 0.0 and end <= duration_s and state(begin) == state(end):
                row = found.setdefault(state(begin)[1], [0.0, 0.0])
                row[0] += end - begin
                row[1] += float(after["stopped_s"]) - float(before["stopped_s"])
    return {
        name: {"s": round(seconds, 1), "stood": round(stood_s / seconds, 4)}
        for name, (seconds, stood_s) in sorted(found.items())
        if seconds > 0.0
    }


def mean_stood(figures: Iterable[Json], state: str) -> tuple[float, float] | None:
    """(robots' seconds, share of them that they stood) in one state of their edge, over runs; ``None``: never there."""
    rows = [one[state] for one in figures if state in one]
    seconds = sum(float(row["s"]) for row in rows)
    return (seconds, sum(row["s"] * row["stood"] for row in rows) / seconds) if seconds > 0.0 else None


def pose_errors(records: Iterable[Json], zero_s: float, duration_s: float) -> list[float]:
    """How far (m) a robot's belief was from the truth at each record of its path over the drive; [0] without any."""
    start = Pose2()
    errors = []
    for record in records:
        if record["kind"] == "start":
            start = Pose2(x=record["x"], y=record["y"], yaw=record["yaw"])
        elif record["kind"] == "path" and zero_s <= float(record["t_s"]) <= zero_s + duration_s:
            believed = start.compose(Pose2(x=record["belief_x"], y=record["belief_y"]))
            errors.append(math.dist((believed.x, believed.y), (record["x"], record["y"])))
    return errors or [0.0]


def merge_cpu_s(nodes: Sequence[Json], merges: int) -> float | None:
    """CPU seconds of the mergers, standbys included, for each merged map of the drive; ``None``: not measured."""
    known = [record["roles"] for record in nodes if record.get("roles")]
    if len(known) < 2 or not merges:
        return None
    spent = [float(known[-1][node].get("merge", 0.0)) - float(known[0][node].get("merge", 0.0)) for node in known[0]]
    return sum(spent) / merges
