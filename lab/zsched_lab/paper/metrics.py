"""Turns one run's folder into figures, each by one definition (docs/evaluation/README.md has them all).

Knows: the records of a run, the truth of its log. Does not know: other runs, whether a figure is good.

Times are seconds since the robots started. A map counts when a robot received it, not when a node sent it.
"""

from __future__ import annotations

import bisect
import heapq
import itertools
import json
import statistics
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from numpy.typing import NDArray

from zsched.core.values.model import NodeId
from zsched.tasks.map_merge.cdr import CdrError, decode_grid
from zsched.tasks.map_merge.geometry import Pose2
from zsched.tasks.map_merge.grid import Grid
from zsched_lab.demo.plots import wider
from zsched_lab.fleet.recorder import read_records
from zsched_lab.fleet.view import Load
from zsched_lab.maps.metrics import score_map
from zsched_lab.paper.arrivals import Arrival, Streams
from zsched_lab.paper.led_metrics import coverage_figures, led_figures, merge_cpu_s, stood_figures
from zsched_lab.paper.load import Window, loaded_at
from zsched_lab.paper.oracle import changes, utilities
from zsched_lab.paper.robots import slam_task
from zsched_lab.paper.roles import role_figures
from zsched_lab.paper.scenario import Scenario

WASTED_S = 30.0
"""A move back to the node that was left within this time was for nothing."""
WORLD = Pose2()
HELD_EVERY_S = 5.0
FRESH_S = 0.5
"""A robot is served while its newest merged map is at most this old (chosen in ``heavy_all``, before its runs)."""
Json = dict[str, Any]
WALL_M = 0.1
"""So far may a wall be off: two cells of `nano`'s maps, twice the error of a robot's pose."""


class Truth:
    """The grid of the whole log, and how much of it a map knows."""

    def __init__(self, grid: Grid) -> None:
        self.grid = grid
        rows, columns = np.nonzero(grid.known)
        self._x = grid.origin.x + (columns + 0.5) * grid.resolution
        self._y = grid.origin.y + (rows + 0.5) * grid.resolution
        rows, columns = np.nonzero(grid.occupied)
        self._wall_x = grid.origin.x + (columns + 0.5) * grid.resolution
        self._wall_y = grid.origin.y + (rows + 0.5) * grid.resolution
        self.area_m2 = self._x.size * grid.resolution**2
        """What can be known."""

    def coverage(self, payload: bytes, world_t_map: Pose2 = WORLD) -> float:
        """Share of the known cells that the map in ``payload`` knows; 0 for what is no map.

        Looked up at the middle of each of the truth's cells. ``world_t_map``: the pose of the map's frame in the truth.
        """
        grid = grid_of(payload)
        if grid is None or not self._x.size:
            return 0.0
        return _share(grid, grid.known, *_seen_from(world_t_map, self._x, self._y))

    def walls(self, payload: bytes, world_t_map: Pose2 = WORLD) -> float:
        """Share of the truth's walls that the map has within `WALL_M` of where they are; 0 for what is no map.

        A map whose parts lie in the wrong places knows as much as a right one, and has hardly a wall in its place.
        """
        grid = grid_of(payload)
        if grid is None or not self._wall_x.size:
            return 0.0
        x, y = _seen_from(world_t_map, self._wall_x, self._wall_y)
        return _share(grid, wider(grid.occupied, round(WALL_M / grid.resolution)), x, y)


def _seen_from(frame: Pose2, x: NDArray[Any], y: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """The same points (m) in ``frame``, a pose in the world."""
    if frame == WORLD:
        return x, y
    points = frame.inverse().apply(np.column_stack((x, y)))
    return points[:, 0], points[:, 1]


def _share(grid: Grid, cells: NDArray[np.bool_], x: NDArray[Any], y: NDArray[Any]) -> float:
    """The share of these points (m) whose cell of ``grid`` is one of ``cells``."""
    columns = np.floor((x - grid.origin.x) / grid.resolution).astype(np.int64)
    rows = np.floor((y - grid.origin.y) / grid.resolution).astype(np.int64)
    inside = (columns >= 0) & (columns < grid.width) & (rows >= 0) & (rows < grid.height)
    return float(cells[rows[inside], columns[inside]].sum()) / x.size


def measure(folder: Path, scenario: Scenario, truth: Truth) -> Json:
    """All figures of the run in ``folder``.

    Raises:
        OSError: the folder holds no finished run.
        ValueError: its records are damaged.
    """
    run: Json = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    streams = read_streams(folder, run, truth)
    nodes = read_records(folder / "records" / "nodes.ndjson")
    duration_s = float(run["duration_s"])
    owners = owners_within(run["allocations"], duration_s)
    reached = {
        robot: covered_s(folder / "records" / f"{robot}.ndjson", float(run["zero_s"]))
        or reached_s(maps, scenario.target_coverage)
        for robot, maps in streams.maps.items()
    }
    done = [t_s for t_s in reached.values() if t_s is not None]
    is_done = len(done) == len(run["robots"]) and max(done, default=duration_s) <= duration_s
    per_edge = {node: edge_figures(node, nodes, streams, owners, duration_s) for node in run["shares"]}
    return {
        **{
            key: run[key]
            for key in ("scheme", "family", "block", "level", "run", "seed", "host", "mode", "input", "links")
        },
        **{key: run.get(key) for key in ("version", "machine")},  # runs may be made on several days and machines
        "nodes": per_edge,
        **over_nodes(per_edge),
        **stream_figures(streams, len(run["robots"]), duration_s),
        "task_latency_s": max(done) if is_done else duration_s,
        "is_done": is_done,
        "duration_s": duration_s,
        **map_figures(streams, truth, len(run["robots"])),
        **coverage_figures(streams, duration_s, scenario.duration_s, truth.area_m2),
        **led_figures(folder, run),
        "stood_by_state": stood_figures(
            folder, run, slam_places(run, scenario.explore.slam_on), partial(owner_at, owners)
        ),
        "merge_cpu_s": merge_cpu_s(nodes, len(streams.stamps)),
        "roles": role_figures(nodes, run["shares"], partial(owner_at, owners)),
        "other_moves": sum(
            len(owners_within(own, duration_s)) - 1 for own in (run.get("others") or {}).values() if own
        ),
        **move_figures(run, streams, owners),
        "regret": regret(scenario, run, owners),
    }


def brief(figures: Mapping[str, Any]) -> str:
    """One run in a line."""
    latency = f"{figures['task_latency_s']:.1f} s" if figures["is_done"] else "not done"
    pressure = figures["host"]["pressure"]
    short = "-" if pressure is None else f"{pressure:.2f}"
    return (
        f"{figures['map_hz']:.2f} maps/s, {figures['throughput_mb_s']:.1f} MB/s, task {latency}, "
        f"{figures['moves']} moves, pressure {short}"
    )


# --- streams ---------------------------------------------------------------------------------------------------------


def read_streams(folder: Path, run: Mapping[str, Any], truth: Truth) -> Streams:
    """The maps of a run, out of its MCAP files; only those whose payload is needed later are kept."""
    offset_ns = int(run["zero_wall_ns"])
    found = Streams(maps={robot: [] for robot in run["robots"]}, sent={robot: [] for robot in run["robots"]})
    known: dict[int, tuple[float, float]] = {}
    newest: dict[NodeId, int] = {}
    instants = held_instants(float(run["duration_s"]))
    frames = Frames(folder, run)
    for topic, log_ns, sent_ns, data in messages(sorted(folder.glob("streams*.mcap"))):
        robot, _, name = topic.partition("/")
        t_s = (log_ns - offset_ns) / 1e9
        if name == "map":
            found.sent[robot].append((t_s, len(data)))
        if name != "global_map":
            continue
        while instants and instants[0] <= t_s:
            keep(found, newest, instants.pop(0))
        key = hash(data)
        if key not in known:
            found.frames[key] = frames.at(log_ns)
            known[key] = truth.coverage(data, found.frames[key]), truth.walls(data, found.frames[key])
        newest[robot] = key
        if 0.0 <= t_s <= float(run["duration_s"]):
            found.stamps.add(key)
        found.payloads[key] = data
        found.maps[robot].append(Arrival(t_s, (log_ns - sent_ns) / 1e9, len(data), *known[key]))
        drop_unheld(found, newest)
    for instant in instants:
        keep(found, newest, instant)
    return found


class Frames:
    """In which frame merged maps lie: the truth's, or that of a robot whose start the merger was not told.

    The merger tells by its status which robot is its reference, from its first merge on.
    """

    def __init__(self, folder: Path, run: Mapping[str, Any]) -> None:
        untold = {robot: Pose2(**pose) for robot, pose in (run.get("untold_frames") or {}).items()}
        self._since: list[tuple[int, Pose2]] = []
        if not untold:
            return
        for topic, log_ns, _, data in messages(sorted(folder.glob("streams*.mcap"))):
            if topic.endswith("/status") and (reference := json.loads(data).get("reference")) is not None:
                self._since.append((log_ns, untold.get(reference, WORLD)))

    def at(self, log_ns: int) -> Pose2:
        """The frame, as a pose in the truth, of a map that came then; before the first word it is the first word's."""
        index = bisect.bisect_right(self._since, log_ns, key=lambda one: one[0])
        return self._since[max(index - 1, 0)][1] if self._since else WORLD


def held_instants(duration_s: float) -> list[float]:
    """When it is looked at what the robots hold: every few seconds, and at the end."""
    count = int(duration_s / HELD_EVERY_S)
    before = [HELD_EVERY_S * number for number in range(1, count + 1)]
    return [*(instant for instant in before if instant < duration_s), duration_s]


def keep(found: Streams, newest: Mapping[NodeId, int], instant: float) -> None:
    """Remember which maps the robots hold at ``instant``."""
    found.held[instant] = list(newest.values())


def drop_unheld(found: Streams, newest: Mapping[NodeId, int]) -> None:
    """Forget payloads that nobody holds: a run has hundreds of megabytes of them."""
    wanted = set(newest.values()) | {key for keys in found.held.values() for key in keys}
    for key in [key for key in found.payloads if key not in wanted]:
        del found.payloads[key]


def messages(paths: Iterable[Path]) -> Iterator[tuple[str, int, int, bytes]]:
    """(topic, log time, publish time, payload) of all files by log time."""
    return heapq.merge(*(one_files(path) for path in paths), key=lambda message: message[1])


def one_files(path: Path) -> Iterator[tuple[str, int, int, bytes]]:
    """The same of one file."""
    with path.open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages():
            yield channel.topic, message.log_time, message.publish_time, message.data


def covered_s(path: Path, zero_s: float) -> float | None:
    """When an exploring robot's own referee found that its map covers the target, by which its run ends; else ``None``.

    It and `Truth.coverage` differ by a cell here and there, enough for 0.7999 and 0.8001.
    """
    if not path.exists():
        return None
    return next((float(r["t_s"]) - zero_s for r in read_records(path) if r["kind"] == "covered"), None)


def reached_s(maps: Iterable[Arrival], target: float) -> float | None:
    """When a robot first held a map that covers ``target``; ``None``: never."""
    return next((arrival.t_s for arrival in maps if arrival.known >= target), None)


def stream_figures(streams: Streams, robots: int, duration_s: float) -> Json:
    """Throughput, map frequency, latency per merged map; within the robots' drive."""
    inside = [arrival for maps in streams.maps.values() for arrival in maps if 0.0 <= arrival.t_s <= duration_s]
    sent = [size for own in streams.sent.values() for t_s, size in own if 0.0 <= t_s <= duration_s]
    latencies = sorted(arrival.latency_s for arrival in inside)
    received = sum(arrival.size for arrival in inside)
    return {
        "throughput_mb_s": (received + sum(sent)) / duration_s / 1e6,
        "received_mb_s": received / duration_s / 1e6,
        "map_hz": len(inside) / robots / duration_s,
        "mb_per_map": received / len(inside) / 1e6 if inside else None,
        **{f"merge_latency_p{p}_s": percentile(latencies, p / 100) for p in (50, 95, 99)},
        "served_ratio": sum(served_s(maps, duration_s) for maps in streams.maps.values()) / robots / duration_s,
    }


def served_s(maps: Sequence[Arrival], duration_s: float) -> float:
    """Seconds of the drive in which one robot's newest merged map is at most `FRESH_S` old by its newest input.

    So a map counts from its arrival until `FRESH_S` after that input's stamp, and an older one that overtakes it adds
    nothing. This is the age of information (Kaul, Yates, Gruteser, INFOCOM 2012) held against a deadline.

    >>> served_s([Arrival(0.25, 0.125, 1, 0.0), Arrival(2.0, 0.25, 1, 0.0), Arrival(5.0, 0.75, 1, 0.0)], 10.0)
    0.625
    """
    served, until = 0.0, 0.0
    for arrival in maps:
        end = min(arrival.t_s - arrival.latency_s + FRESH_S, duration_s)
        served += max(end - max(arrival.t_s, until, 0.0), 0.0)
        until = max(until, end)
    return served


def percentile(ordered: Sequence[float], share: float) -> float | None:
    """Nearest rank in sorted values; ``None`` of nothing.

    >>> percentile([1.0, 2.0, 3.0, 4.0], 0.5)
    2.0
    """
    if not ordered:
        return None
    rank = max(1, -(-round(share * 1e6) * len(ordered) // 1_000_000))
    return ordered[min(rank, len(ordered)) - 1]


# --- nodes -----------------------------------------------------------------------------------------------------------


def edge_figures(
    node: NodeId, nodes: Sequence[Json], streams: Streams, owners: Sequence[tuple[float, NodeId]], duration_s: float
) -> Json:
    """One node: CPU and memory, peak and mean, as shares of what it may use; its throughput; how long it owned."""
    inside = [record for record in nodes if 0.0 <= record["t_s"] <= duration_s]
    cpu = [min(r[node]["cpu_ratio"], 1.0) for r in inside if node in r and r[node]["cpu_ratio"] is not None]
    memory = [r[node]["memory_ratio"] for r in inside if node in r and r[node]["memory_ratio"] is not None]
    seconds = pairs(cpu)
    moved = sum(size for t_s, size in transfers(streams) if 0.0 <= t_s <= duration_s and owner_at(owners, t_s) == node)
    return {
        "cpu_peak": max(seconds, default=None),
        "cpu_mean": statistics.fmean(cpu) if cpu else None,
        "memory_peak": max(memory, default=None),
        "memory_mean": statistics.fmean(memory) if memory else None,
        "throughput_mb_s": moved / duration_s / 1e6,
        "owned_s": owned_s(owners, node, duration_s),
    }


def pairs(values: Sequence[float]) -> list[float]:
    """Means of two and two: half seconds to seconds; an odd one at the end is left out."""
    return [statistics.fmean(values[index : index + 2]) for index in range(0, len(values) - 1, 2)]


def over_nodes(per_edge: Mapping[NodeId, Mapping[str, Any]]) -> Json:
    """The same over all nodes: means, and how far apart the nodes are (0: the work is spread evenly)."""
    found: Json = {}
    for name in ("cpu_peak", "cpu_mean", "memory_peak", "memory_mean"):
        values = [figures[name] for figures in per_edge.values() if figures[name] is not None]
        found[name] = statistics.fmean(values) if values else None
        found[f"{name}_spread"] = max(values) - min(values) if values else None
    return found


def transfers(streams: Streams) -> Iterator[tuple[float, int]]:
    """(when, bytes) of everything between robots and owner, both ways."""
    for maps in streams.maps.values():
        yield from ((arrival.t_s, arrival.size) for arrival in maps)
    for own in streams.sent.values():
        yield from own


def owners_within(allocations: Iterable[Mapping[str, Any]], duration_s: float) -> list[tuple[float, NodeId]]:
    """(from when, owner) of the robots' drive; the owner when they started has it from 0.

    What was decided before, while the workers started, and after the drive is nobody's merit or fault.
    """
    made = [(float(move["t_s"]), str(move["node"])) for move in allocations]
    before = [node for t_s, node in made if t_s <= 0.0]
    return [*((0.0, node) for node in before[-1:]), *((t_s, node) for t_s, node in made if 0.0 < t_s <= duration_s)]


def owner_at(owners: Sequence[tuple[float, NodeId]], t_s: float) -> NodeId | None:
    """Who owned the task at ``t_s``; ``None`` before the first."""
    index = bisect.bisect_right([start for start, _ in owners], t_s)
    return owners[index - 1][1] if index else None


def slam_places(
    run: Mapping[str, Any], slam_on: Mapping[NodeId, NodeId]
) -> dict[NodeId, Callable[[float], NodeId | None]]:
    """Where each robot's SLAM was when: with its task's owner where it is a task of the fleet, else where it stays."""
    tasks = run.get("others") or {}
    told = {robot: tasks.get(slam_task(robot)) for robot in slam_on}
    return {
        robot: partial(owner_at, owners_within(own, float(run["duration_s"])) if own else [(0.0, slam_on[robot])])
        for robot, own in told.items()
    }


def owned_s(owners: Sequence[tuple[float, NodeId]], node: NodeId, duration_s: float) -> float:
    """Seconds within the run for which ``node`` owned the task."""
    ends = [*(start for start, _ in owners[1:]), duration_s]
    return sum(
        max(min(end, duration_s) - start, 0.0)
        for (start, owner), end in zip(owners, ends, strict=True)
        if owner == node
    )


# --- maps, moves, regret ---------------------------------------------------------------------------------------------


def map_figures(streams: Streams, truth: Truth, robots: int) -> Json:
    """The last map that the robots held, and (``held_``) what they held on the way, against the truth of the end.

    A robot without a map counts as one with a blank map.
    """
    blank = score_map(None, truth.grid)
    held = {key for keys in streams.held.values() for key in keys}
    scored = {key: score_map(grid_of(streams.payloads[key]), truth.grid, streams.frames[key]) for key in held}
    by_instant = [
        [*(scored[key] for key in keys), *[blank] * (robots - len(keys))] for _, keys in sorted(streams.held.items())
    ]
    on_way = [statistics.fmean(one.ssim_rebased for one in scores) for scores in by_instant]
    names = ("ssim_rebased", "wall_f1", "coverage", "ssim_crop")
    final = by_instant[-1] if by_instant else []
    means = {name: statistics.fmean(getattr(one, name) for one in final) if final else None for name in names}
    return {**means, "held_ssim_rebased": statistics.fmean(on_way) if on_way else None}


def grid_of(payload: bytes) -> Grid | None:
    """The map, or ``None`` for what is none (it scores as a blank)."""
    try:
        return decode_grid(payload)
    except CdrError:
        return None


def move_figures(run: Mapping[str, Any], streams: Streams, owners: Sequence[tuple[float, NodeId]]) -> Json:
    """Moves, wasted ones, the silence around each, and what was lost and dropped in the streams.

    The relays count losses from their start on, so they are shared out over all moves, earlier ones included.
    ``drops`` is {reason: messages}: some reasons are by the rules, such as ``cut``, the old owner's behind a move.
    """
    moves = [start for start, _ in owners[1:]]
    in_all = max(len(run["allocations"]) - 1, 0)
    gaps = [gap for t_s in moves if (gap := gap_around(streams, t_s, float(run["duration_s"]))) is not None]
    counts = [count for node in run["robots"] for count in (run["streams"].get(node) or [])]
    drops = sum((Counter(count.get("drops") or {}) for count in counts), Counter[str]())
    lost = sum(int(count.get("lost") or 0) + int(count.get("at_most_lost") or 0) for count in counts)
    return {
        "moves": len(moves),
        "wasted_moves": wasted(owners),
        "move_gap_mean_s": statistics.fmean(gaps) if gaps else None,
        "move_gap_max_s": max(gaps, default=None),
        "gap_max_s": max((gap for maps in streams.maps.values() for gap in silences(maps)), default=None),
        "lost": lost,
        "lost_per_move": lost / in_all if in_all else None,
        "dropped": drops.total(),
        "drops": dict(sorted(drops.items())),
        "owners": [[round(start, 3), node] for start, node in owners],
    }


def wasted(owners: Sequence[tuple[float, NodeId]]) -> int:
    """Moves back to the node that was left, within `WASTED_S`.

    >>> wasted([(0.0, "a"), (5.0, "b"), (9.0, "a"), (50.0, "b")])
    1
    """
    triples = zip(owners, owners[1:], owners[2:], strict=False)
    return sum(before[1] == after[1] and after[0] - left[0] < WASTED_S for before, left, after in triples)


def gap_around(streams: Streams, t_s: float, end_s: float) -> float | None:
    """The longest silence at any robot from its last map before ``t_s`` to the next one, or to the run's end."""
    found = []
    for maps in streams.maps.values():
        times = [arrival.t_s for arrival in maps]
        index = bisect.bisect_right(times, t_s)
        if index > 0:
            found.append((times[index] if index < len(times) else max(end_s, t_s)) - times[index - 1])
    return max(found, default=None)


def silences(maps: Sequence[Arrival]) -> Iterator[float]:
    """Seconds between one robot's merged maps."""
    return (after.t_s - before.t_s for before, after in itertools.pairwise(maps))


def regret(scenario: Scenario, run: Mapping[str, Any], owners: Sequence[tuple[float, NodeId]]) -> float | None:
    """What the owners' utility lacked to the best node's in hindsight, as a share of the latter, over the run.

    Both by the load as it was really injected (`zsched_lab.paper.oracle`); ``None`` without nodes that differ.
    """
    level, duration_s = scenario.levels[run["level"]], float(run["duration_s"])
    windows = tuple(Window(**asdict(Load(**load))) for load in run["loads"])
    steps = sorted({*changes(windows, duration_s), *(start for start, _ in owners if start < duration_s), duration_s})
    best = had = 0.0
    for start, end in itertools.pairwise(steps):
        scored = utilities(scenario, level, loaded_at(windows, start))
        owner = owner_at(owners, start)
        if not scored:
            return None
        best += (end - start) * max(scored.values())
        had += (end - start) * (scored.get(owner, 0.0) if owner is not None else 0.0)
    return (best - had) / best if best > 0 else None
