"""Draws the run's two pictures: the merged map beside the truth, and the timeline of owner, loads and map rate.

Knows: grids on one canvas, series of points in time. Does not know: processes, files of records, how maps were aligned.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from zsched.core.values.model import NodeId
from zsched.tasks.map_merge.compose import compose, extent_of
from zsched.tasks.map_merge.geometry import Pose2
from zsched.tasks.map_merge.grid import Grid, Mask
from zsched_lab.fleet.view import Load, Move

Picture = npt.NDArray[np.float32]
"""height x width x 3, RGB in [0, 1], row 0 at the bottom."""

DPI = 110
PANEL_PIXELS = 620
"""Width of one of the map's panels."""
TOLERANCE_CELLS = 2
"""Walls that lie so near each other agree (the tolerance of the wall F1)."""
# Okabe & Ito's colours: told apart by colour-blind readers too.
COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#F0E442", "#000000")
WALL, FREE, UNKNOWN = "#1a1a1a", "#f4f4f0", "#b9bcc0"
MISSING_WALL, EXTRA_WALL, MISSING_FREE, EXTRA_FREE = "#0072B2", "#D55E00", "#bfdcec", "#f6d5bd"
DIFFERENCE_LEGEND = (
    (WALL, "wall in both"),
    (MISSING_WALL, "wall missing"),
    (EXTRA_WALL, "wall too much"),
    (MISSING_FREE, "free, not seen"),
    (EXTRA_FREE, "free too much"),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Timeline:
    """What the timeline shows; all times in seconds since the start."""

    title: str
    duration_s: float
    candidates: tuple[NodeId, ...]
    moves: tuple[Move, ...]
    loads: tuple[Load, ...]
    cpu: Mapping[NodeId, Sequence[tuple[float, float]]]
    """(t_s, ratio) per node."""
    maps: Mapping[NodeId, Sequence[float]]
    """When each robot received a merged map."""


# --- the map ---------------------------------------------------------------------------------------------------------


def save_map(path: Path, truth: Grid, merged: Grid | None, truth_t_merged: Pose2, title: str, caption: str) -> None:
    """Write the picture of the truth, the merged map (laid over it by ``truth_t_merged``) and their difference.

    ``merged`` ``None`` (no map arrived) leaves its panel unknown.
    """
    truth_layer, merged_layer = on_one_canvas(truth, merged, truth_t_merged)
    origin, side = truth_layer.origin, truth_layer.resolution
    extent = (origin.x, origin.x + truth_layer.width * side, origin.y, origin.y + truth_layer.height * side)
    pen = max(1, round(truth_layer.width / PANEL_PIXELS))
    figure = Figure(figsize=map_size(truth_layer), layout="constrained", dpi=DPI)
    axes = figure.subplots(1, 3, sharex=True, sharey=True)
    panels = (
        ("truth: the grid of the whole log", shade(truth_layer, pen)),
        ("merged map, as a robot received it", shade(merged_layer, pen)),
        ("difference", difference(truth_layer, merged_layer, pen)),
    )
    for axis, (name, picture) in zip(axes, panels, strict=True):
        axis.imshow(picture, origin="lower", extent=extent)
        axis.set_title(name, fontsize=10)
        axis.set_xlabel("x [m]", fontsize=9)
        axis.tick_params(labelsize=8)
    axes[0].set_ylabel("y [m]", fontsize=9)
    figure.suptitle(f"{title}\n{caption}", fontsize=12)
    handles = [Patch(facecolor=colour, edgecolor="#888888", label=label) for colour, label in DIFFERENCE_LEGEND]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=9, frameon=False)
    write(figure, path)


def map_size(grid: Grid) -> tuple[float, float]:
    """Figure size in inches for three panels of the grid's shape."""
    panel = PANEL_PIXELS / DPI
    return 3 * panel + 1.0, min(12.0, max(4.0, panel * grid.height / max(1, grid.width) + 1.6))


def on_one_canvas(truth: Grid, merged: Grid | None, truth_t_merged: Pose2) -> tuple[Grid, Grid]:
    """Both grids on one lattice in the truth's frame, cut to where either knows something."""
    extent = extent_of(truth, Pose2(), truth.resolution)
    if merged is not None:
        extent = extent.union(extent_of(merged, truth_t_merged, truth.resolution))
    layers = [] if merged is None else [(merged, truth_t_merged)]
    return cut_to_known(
        compose([(truth, Pose2())], extent, truth.resolution), compose(layers, extent, truth.resolution)
    )


def cut_to_known(a: Grid, b: Grid, margin: int = 20) -> tuple[Grid, Grid]:
    """Both grids without the rows and columns that neither knows; ``margin`` cells are left around."""
    known = a.known | b.known
    rows, columns = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
    if rows.size == 0:
        return a, b
    low_y, high_y = max(0, int(rows[0]) - margin), int(rows[-1]) + 1 + margin
    low_x, high_x = max(0, int(columns[0]) - margin), int(columns[-1]) + 1 + margin
    side = a.resolution
    origin = Pose2(x=a.origin.x + low_x * side, y=a.origin.y + low_y * side)
    first, second = (
        Grid(data=grid.data[low_y:high_y, low_x:high_x], resolution=side, origin=origin) for grid in (a, b)
    )
    return first, second


def shade(grid: Grid, pen: int) -> Picture:
    """The usual look of an occupancy grid: walls dark (``pen`` cells wider, to be seen), free light, unknown grey."""
    picture = paint(grid, UNKNOWN)
    picture[grid.known] = to_rgb(FREE)
    picture[wider(grid.occupied, pen)] = to_rgb(WALL)
    return picture


def difference(truth: Grid, merged: Grid, pen: int) -> Picture:
    """Where the two agree and where not; unknown in both is white."""
    near_truth, near_merged = wider(truth.occupied, TOLERANCE_CELLS), wider(merged.occupied, TOLERANCE_CELLS)
    picture = paint(truth, "#ffffff")
    picture[truth.known & merged.known] = to_rgb(FREE)
    picture[truth.known & ~merged.known] = to_rgb(MISSING_FREE)
    picture[merged.known & ~truth.known] = to_rgb(EXTRA_FREE)
    picture[wider(truth.occupied & near_merged, pen)] = to_rgb(WALL)
    picture[wider(merged.occupied & ~near_truth, pen)] = to_rgb(EXTRA_WALL)
    picture[wider(truth.occupied & ~near_merged, pen)] = to_rgb(MISSING_WALL)
    return picture


def paint(grid: Grid, colour: str) -> Picture:
    """A picture of the grid's shape in one colour."""
    picture: Picture = np.empty((*grid.data.shape, 3), dtype=np.float32)
    picture[:] = to_rgb(colour)
    return picture


def wider(mask: Mask, cells: int) -> Mask:
    """The mask grown by this many cells in each direction."""
    kernel = np.ones((2 * cells + 1, 2 * cells + 1), dtype=np.uint8)
    grown: Mask = cv2.dilate(mask.astype(np.uint8), kernel).astype(np.bool_)
    return grown


# --- the timeline ----------------------------------------------------------------------------------------------------


def save_timeline(path: Path, timeline: Timeline) -> None:
    """Write the picture of owner, CPU of the candidates with the injected load, and merged maps per second."""
    figure = Figure(figsize=(13.5, 8.0), layout="constrained", dpi=DPI)
    owner, cpu, rate = figure.subplots(3, 1, sharex=True, height_ratios=(1.1, 1.6, 1.2))
    colours = dict(zip(timeline.candidates, COLOURS * (1 + len(timeline.candidates) // len(COLOURS)), strict=False))
    draw_owner(owner, timeline, colours)
    draw_cpu(cpu, timeline, colours)
    draw_rate(rate, timeline)
    for axis in (owner, cpu, rate):
        mark_moves(axis, timeline)
        axis.set_xlim(0.0, timeline.duration_s)
        axis.tick_params(labelsize=9)
        axis.spines[["top", "right"]].set_visible(False)
    rate.set_xlabel("seconds since the daemons were started", fontsize=10)
    figure.suptitle(timeline.title, fontsize=12)
    write(figure, path)


def tenures(timeline: Timeline) -> list[tuple[Move, float]]:
    """Each allocation with the time of its end."""
    moves = sorted(timeline.moves, key=lambda move: move.epoch)
    ends = [move.t_s for move in moves[1:]] + [timeline.duration_s]
    return list(zip(moves, ends, strict=False))  # without moves there is one end too many


def draw_owner(axis: Axes, timeline: Timeline, colours: Mapping[NodeId, str]) -> None:
    """One lane per candidate, a bar while it owns the task, hatched windows of load."""
    lanes = {node: index for index, node in enumerate(reversed(timeline.candidates))}
    for load in timeline.loads:
        if load.node in lanes:
            span = (load.start_s, load.end_s - load.start_s)
            axis.broken_barh(
                [span], (lanes[load.node] - 0.45, 0.9), facecolor="#eeeeee", hatch="///", edgecolor="#999999"
            )
    for move, end in tenures(timeline):
        if move.node not in lanes:
            continue
        start = max(0.0, move.t_s)
        axis.broken_barh([(start, max(0.0, end - start))], (lanes[move.node] - 0.3, 0.6), color=colours[move.node])
        axis.text(start + 0.3, lanes[move.node], f"epoch {move.epoch}", va="center", fontsize=9, color="white")
    axis.set_yticks(list(lanes.values()), list(lanes))
    axis.set_ylim(-0.6, len(lanes) - 0.4)
    axis.set_title("owner of the task (hatched: neural load injected there)", fontsize=10, loc="left")


def draw_cpu(axis: Axes, timeline: Timeline, colours: Mapping[NodeId, str]) -> None:
    """CPU in use per candidate, each load's window in its node's colour."""
    for load in timeline.loads:
        axis.axvspan(load.start_s, load.end_s, color=colours.get(load.node, "#888888"), alpha=0.13, linewidth=0)
    for index, node in enumerate(timeline.candidates):
        points = timeline.cpu.get(node, ())
        times, ratios = [t_s for t_s, _ in points], [100.0 * ratio for _, ratio in points]
        # Edges that share a CPU draw the same line: the later ones are thinner.
        axis.plot(times, ratios, color=colours[node], linewidth=(3.0, 2.2, 1.4)[index % 3], label=node)
    axis.set_ylim(0.0, 128.0)
    axis.set_yticks([0, 25, 50, 75, 100])
    axis.set_ylabel("CPU in use [%]", fontsize=10)
    axis.legend(loc="upper right", ncols=len(timeline.candidates), fontsize=9, framealpha=0.9)
    axis.set_title(
        "CPU of the candidates, of what each may use, as its daemon smooths it (shaded: load injected there)",
        fontsize=10,
        loc="left",
    )


def draw_rate(axis: Axes, timeline: Timeline) -> None:
    """Merged maps per second as each robot receives them."""
    grid = np.arange(0.0, timeline.duration_s + 0.25, 0.5)
    for index, (robot, times) in enumerate(sorted(timeline.maps.items())):
        # Robots see nearly the same: the later lines are thinner, so that none hides another.
        colour, width = (("#bbbbbb", 5.0), ("#56B4E9", 3.0), ("#000000", 1.2))[index % 3]
        axis.plot(grid, windowed_rate(times, grid), linewidth=width, label=robot, color=colour)
    axis.set_ylim(bottom=0.0)
    axis.set_ylabel("maps per second", fontsize=10)
    if timeline.maps:
        axis.legend(loc="lower right", ncols=len(timeline.maps), fontsize=9, framealpha=0.9)
    axis.set_title("merged maps as the robots receive them (last 3 s)", fontsize=10, loc="left")


def windowed_rate(times: Sequence[float], at: npt.NDArray[np.float64], window_s: float = 3.0) -> list[float]:
    """Arrivals per second in the window that ends at each time of ``at``; shorter at the start."""
    arrivals = np.sort(np.asarray(times, dtype=np.float64))
    until = np.searchsorted(arrivals, at, side="right")
    since = np.searchsorted(arrivals, at - window_s, side="right")
    return [float(count) / window_s for count in until - since]


def mark_moves(axis: Axes, timeline: Timeline) -> None:
    """A dashed line at each move (the first allocation is none)."""
    for move, _ in tenures(timeline)[1:]:
        axis.axvline(move.t_s, color="#333333", linestyle="--", linewidth=1.0, zorder=3)


def write(figure: Figure, path: Path) -> None:
    """Render the figure as PNG."""
    FigureCanvasAgg(figure)
    figure.savefig(path)
