"""Turns a finished run into figures: summary.json, the printed table, map.png, timeline.png.

Knows: what the run kept (moves, loads, samples, the robots' records, the truth). Does not know: daemons, terminals.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

from rich.console import Console
from rich.table import Table

from zsched.core.values.model import NodeId, TaskId
from zsched.tasks.map_merge.cdr import CdrError, decode_grid
from zsched.tasks.map_merge.geometry import Pose2
from zsched.tasks.map_merge.grid import Grid
from zsched_lab.demo.plots import Timeline, save_map, save_timeline
from zsched_lab.fleet.view import Load, Move
from zsched_lab.maps.metrics import MapScore, pose_errors, score_map
from zsched_lab.robots.watch import RobotWatch

SUMMARY_SCHEMA = "zsched.demo/1"
Samples = Mapping[NodeId, Sequence[tuple[float, float]]]


@dataclass(frozen=True, slots=True, kw_only=True)
class RunFacts:
    """What happened; all times in seconds since the daemons were started, but `RobotWatch`'s (see ``start_s``)."""

    out: Path
    log_name: str
    mode: str
    seed: int
    policy: str
    limits: str
    start_s: float
    duration_s: float
    task: TaskId
    kinds: Mapping[NodeId, str]
    candidates: tuple[NodeId, ...]
    frames: Mapping[NodeId, Pose2]
    """The true pose of each robot's map frame in the log's frame."""
    moves: tuple[Move, ...]
    loads: tuple[Load, ...]
    cpu: Samples
    memory: Samples
    robots: tuple[RobotWatch, ...]
    truth: Path

    @property
    def title(self) -> str:
        """The run in a line."""
        robots = sum(kind == "robot" for kind in self.kinds.values())
        edges = len(self.kinds) - robots
        return f"zsched demo: {self.log_name}, {robots} robots, {edges} edges, mode {self.mode}, seed {self.seed}"

    @property
    def end_s(self) -> float:
        """The end on the daemon's clock."""
        return self.start_s + self.duration_s


@dataclass(frozen=True, slots=True, kw_only=True)
class MergedMap:
    """The last merged map that any robot holds, laid into the truth's frame."""

    robot: NodeId | None = None
    grid: Grid | None = None
    world_t_merged: Pose2 = Pose2()


def evaluate(facts: RunFacts) -> dict[str, Any]:
    """Write the figures and both pictures into ``facts.out``; returns the summary.

    Raises:
        OSError: the folder cannot be written, or the truth is missing.
    """
    truth = decode_grid(facts.truth.read_bytes())
    merged = last_map(facts)
    score = score_map(merged.grid, truth, merged.world_t_merged)
    summary = summarise(facts, merged, score)
    (facts.out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    save_map(facts.out / "map.png", truth, merged.grid, merged.world_t_merged, facts.title, caption(score))
    save_timeline(facts.out / "timeline.png", timeline(facts))
    return summary


def caption(score: MapScore) -> str:
    """The map's figures in a line."""
    return f"coverage {score.coverage:.3f},  wall F1 {score.wall_f1:.3f},  rebased SSIM {score.ssim_rebased:.3f}"


def last_map(facts: RunFacts) -> MergedMap:
    """The map of the robot that received one last."""
    heard = sorted((watch for watch in facts.robots if watch.map_times), key=lambda watch: watch.map_times[-1])
    for watch in reversed(heard):
        try:
            grid = decode_grid((facts.out / "records" / f"{watch.robot}-global_map.cdr").read_bytes())
        except (OSError, CdrError):
            continue
        return MergedMap(robot=watch.robot, grid=grid, world_t_merged=world_of(facts))
    return MergedMap()


def world_of(facts: RunFacts) -> Pose2:
    """Where the merged map's frame lies: at the log's, or (mode estimate: nobody was told) at the reference robot's."""
    reference = merger_word(facts).get("reference")
    return facts.frames.get(str(reference), Pose2()) if facts.mode == "estimate" else Pose2()


def merger_word(facts: RunFacts) -> Mapping[str, Any]:
    """The merger's newest status that any robot holds; empty when none came."""
    words = [watch.status for watch in facts.robots if isinstance(watch.status, dict)]
    return max(words, key=lambda word: int(word.get("merges") or 0), default={})


def summarise(facts: RunFacts, merged: MergedMap, score: MapScore) -> dict[str, Any]:
    """The run in figures (`summary.json`)."""
    rates = [rate for watch in facts.robots if (rate := watch.mean_hz(facts.end_s)) is not None]
    gaps = [gap for watch in facts.robots if (gap := watch.longest_gap_s(facts.end_s)) is not None]
    return {
        "schema": SUMMARY_SCHEMA,
        "log": facts.log_name,
        "mode": facts.mode,
        "seed": facts.seed,
        "schedule": facts.policy,
        "limits": facts.limits,
        "duration_s": round(facts.duration_s, 3),
        "moves": max(0, len(facts.moves) - 1),
        "merges": max((len(watch.map_times) for watch in facts.robots), default=0),
        "merge_hz": round(fmean(rates), 3) if rates else None,
        "gap_max_s": round(max(gaps), 3) if gaps else None,
        **{name: round(value, 4) for name, value in asdict(score).items()},
        "map_robot": merged.robot,
        "allocations": [allocation_figures(facts, move) for move in facts.moves],
        "loads": [
            {"node": load.node, "start_s": round(load.start_s, 3), "end_s": round(load.end_s, 3)}
            for load in facts.loads
        ],
        "nodes": {name: node_figures(facts, name) for name in sorted(facts.kinds)},
        "robots": {watch.robot: robot_figures(facts, watch) for watch in facts.robots},
    }


def allocation_figures(facts: RunFacts, move: Move) -> dict[str, Any]:
    """One allocation; ``gap_s`` is the longest silence at any robot from its last map before the move to the next."""
    gaps = [gap for watch in facts.robots if (gap := watch.gap_around_s(facts.start_s + move.t_s)) is not None]
    return asdict(move) | {"t_s": round(move.t_s, 3), "gap_s": round(max(gaps), 3) if gaps else None}


def node_figures(facts: RunFacts, node: NodeId) -> dict[str, Any]:
    """One node: kind, CPU and memory as shares of what it may use, and how long it owned the task."""
    cpu = [ratio for _, ratio in facts.cpu.get(node, ())]
    memory = [ratio for _, ratio in facts.memory.get(node, ())]
    return {
        "kind": facts.kinds[node],
        "cpu_mean": round(fmean(cpu), 3) if cpu else None,
        "cpu_peak": round(max(cpu), 3) if cpu else None,
        "memory_mean": round(fmean(memory), 3) if memory else None,
        "memory_peak": round(max(memory), 3) if memory else None,
        "owned_s": round(owned_s(facts, node), 1),
    }


def owned_s(facts: RunFacts, node: NodeId) -> float:
    """Seconds for which the node owned the task."""
    ends = [*(move.t_s for move in facts.moves[1:]), facts.duration_s]
    return sum(end - move.t_s for move, end in zip(facts.moves, ends, strict=False) if move.node == node)


def robot_figures(facts: RunFacts, watch: RobotWatch) -> dict[str, Any]:
    """One robot: what it saw of the merged map, what it sent, and what became of its own map."""
    rate, gap = watch.mean_hz(facts.end_s), watch.longest_gap_s(facts.end_s)
    word = merger_word(facts).get("robots", {}).get(watch.robot, {})
    error = errors_of(facts).get(watch.robot)
    return {
        "merges": len(watch.map_times),
        "merge_hz": None if rate is None else round(rate, 3),
        "gap_max_s": None if gap is None else round(gap, 3),
        "first_map_s": round(watch.map_times[0] - facts.start_s, 3) if watch.map_times else None,
        "scans": watch.progress.get("scans"),
        "scans_total": watch.progress.get("scans_total"),
        "maps_sent": watch.progress.get("maps_sent"),
        "bytes_sent": watch.progress.get("bytes_sent"),
        "bytes_received": watch.progress.get("bytes_received"),
        "attach": {key: word.get(key) for key in ("state", "reason", "with", "score", "overlap", "margin")},
        "pose_error_m": None if error is None else round(error[0], 3),
        "pose_error_deg": None if error is None else round(error[1], 2),
    }


def errors_of(facts: RunFacts) -> dict[NodeId, tuple[float, float]]:
    """How far each attached map frame is off, relative to the reference robot's (the first, where poses were given)."""
    word = merger_word(facts)
    robots: Mapping[str, Any] = word.get("robots") or {}
    estimated = {robot: Pose2(**said["pose"]) for robot, said in robots.items() if said.get("pose")}
    estimated = {robot: pose for robot, pose in estimated.items() if robot in facts.frames}
    reference = word.get("reference") or next(iter(sorted(estimated)), None)
    return pose_errors(estimated, facts.frames, reference) if reference in estimated else {}


def timeline(facts: RunFacts) -> Timeline:
    """What the timeline shows."""
    maps = {watch.robot: [t_s - facts.start_s for t_s in watch.map_times] for watch in facts.robots}
    return Timeline(
        title=f"{facts.title}\n{facts.limits}",
        duration_s=facts.duration_s,
        candidates=facts.candidates,
        moves=facts.moves,
        loads=facts.loads,
        cpu=facts.cpu,
        maps=maps,
    )


# --- the printed table -----------------------------------------------------------------------------------------------


def print_summary(summary: Mapping[str, Any], out: Path) -> None:
    """Print the summary for people, and where everything lies."""
    console = Console(highlight=False, width=None if sys.stdout.isatty() else 120)
    figures = Table(title="zsched demo", title_justify="left", show_header=False, box=None, padding=(0, 2, 0, 0))
    for name, value in headline(summary):
        figures.add_row(name, value)
    console.print(figures)
    console.print(allocation_table(summary))
    console.print(robot_table(summary))
    console.print(
        f"in {out}: map.png, timeline.png, run.mcap (for Foxglove), summary.json, fleet.yaml, logs/, records/",
        soft_wrap=True,
    )


def headline(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The figures everybody asks for first."""
    run = f"log {summary['log']}, mode {summary['mode']}, seed {summary['seed']}, {number(summary['duration_s'], 1)} s"
    rate, gap = number(summary["merge_hz"]), number(summary["gap_max_s"])
    coverage, walls, ssim = (number(summary[name], 3) for name in ("coverage", "wall_f1", "ssim_rebased"))
    return [
        ("run", run),
        ("moves", f"{summary['moves']} (loads injected: {len(summary['loads'])})"),
        ("merged maps", f"{summary['merges']} per robot, {rate} Hz, longest gap {gap} s"),
        ("map", f"coverage {coverage}, wall F1 {walls}, rebased SSIM {ssim}"),
        ("limits", str(summary["limits"])),
    ]


def number(value: float | None, digits: int = 2) -> str:
    """A figure, or a dash when there is none."""
    return "-" if value is None else f"{value:.{digits}f}"


def allocation_table(summary: Mapping[str, Any]) -> Table:
    """Who owned the task, from when, and why."""
    table = Table(title="allocations", title_justify="left", box=None, header_style="dim", padding=(0, 2, 0, 0))
    for column in ("epoch", "from", "node", "map gap", "why"):
        table.add_column(column)
    for move in summary["allocations"]:
        since, gap = f"{number(move['t_s'], 1)} s", "-" if move["gap_s"] is None else f"{move['gap_s']:.2f} s"
        table.add_row(str(move["epoch"]), since, str(move["node"]), gap, str(move["reason"]))
    return table


def robot_table(summary: Mapping[str, Any]) -> Table:
    """What each robot saw, and what became of its map."""
    table = Table(title="robots", title_justify="left", box=None, header_style="dim", padding=(0, 2, 0, 0))
    for column in ("robot", "maps", "rate", "longest gap", "its map", "pose error", "why"):
        table.add_column(column)
    for robot, row in summary["robots"].items():
        attach = row["attach"]
        off = "-" if row["pose_error_m"] is None else f"{row['pose_error_m']:.2f} m, {row['pose_error_deg']:.1f} deg"
        rate, gap = f"{number(row['merge_hz'])} Hz", f"{number(row['gap_max_s'])} s"
        table.add_row(
            robot, str(row["merges"]), rate, gap, str(attach["state"] or "-"), off, str(attach["reason"] or "")
        )
    return table
