"""Draws explorations: merged maps beside the truth with every robot's path, and coverage over time.

Knows: grids, paths, curves. Does not know: how they came about.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from zsched.tasks.map_merge.geometry import Pose2
from zsched.tasks.map_merge.grid import Grid
from zsched_lab.demo.plots import COLOURS, DPI, difference, on_one_canvas, shade, write

PANEL_INCHES = 5.5
CURVE_INCHES = 3.2
PATH_COLOURS = (COLOURS[0], COLOURS[5], COLOURS[2], COLOURS[3], COLOURS[1])


@dataclass(frozen=True, slots=True, kw_only=True)
class Picture:
    """One exploration: its last merged map in the truth's frame, true paths in the world, coverage (t_s, share)."""

    title: str
    merged: Grid | None
    paths: Mapping[str, Sequence[Pose2]]
    coverage: Sequence[tuple[float, float]]


def save_pictures(path: Path, truth: Grid, pictures: Sequence[Picture], title: str) -> None:
    """Write one figure: a column for each exploration (map with paths, difference to the truth), all curves below.

    Raises:
        OSError: the file cannot be written.
        ValueError: there is nothing to draw.
    """
    if not pictures:
        raise ValueError("no exploration to draw")
    columns, shape = len(pictures), truth.height / truth.width
    panel = min(PANEL_INCHES, PANEL_INCHES / shape)
    height = 2 * (panel * shape + 0.6) + CURVE_INCHES
    figure = Figure(figsize=(max(9.0, columns * (panel + 0.5)), height), layout="constrained", dpi=DPI)
    ratios = (panel * shape, panel * shape, CURVE_INCHES)
    layout = figure.add_gridspec(3, columns, height_ratios=ratios)
    for column, picture in enumerate(pictures):
        _draw_map((figure.add_subplot(layout[0, column]), figure.add_subplot(layout[1, column])), truth, picture)
    _draw_curves(figure.add_subplot(layout[2, :]), pictures)
    figure.suptitle(title, fontsize=12)
    write(figure, path)


def _draw_map(axes: tuple[Axes, Axes], truth: Grid, picture: Picture) -> None:
    """The merged map with the paths, and below what it lacks."""
    truth_layer, merged_layer = on_one_canvas(truth, picture.merged, Pose2())
    origin, side = truth_layer.origin, truth_layer.resolution
    extent = (origin.x, origin.x + truth_layer.width * side, origin.y, origin.y + truth_layer.height * side)
    axes[0].imshow(shade(merged_layer, 1), origin="lower", extent=extent)
    for index, (robot, path) in enumerate(sorted(picture.paths.items())):
        colour = PATH_COLOURS[index % len(PATH_COLOURS)]
        axes[0].plot([pose.x for pose in path], [pose.y for pose in path], color=colour, linewidth=1.4, label=robot)
        if path:
            axes[0].plot(path[0].x, path[0].y, marker="o", color=colour, markersize=6)
    axes[0].legend(loc="lower right", fontsize=8)
    axes[0].set_title(f"{picture.title}\nmerged map and paths (dot: start)", fontsize=10)
    axes[1].imshow(difference(truth_layer, merged_layer, 1), origin="lower", extent=extent)
    axes[1].set_title("difference to the truth\n(blue: not seen, orange: too much)", fontsize=10)
    for axis in axes:
        axis.tick_params(labelsize=8)


def _draw_curves(axis: Axes, pictures: Sequence[Picture]) -> None:
    """Coverage over time, one line per exploration."""
    for index, picture in enumerate(pictures):
        times, shares = [t_s for t_s, _ in picture.coverage], [share for _, share in picture.coverage]
        axis.plot(times, shares, color=COLOURS[index % len(COLOURS)], label=picture.title)
    axis.set_xlabel("seconds", fontsize=10)
    axis.set_ylabel("coverage, as the robots have it", fontsize=10)
    axis.set_ylim(0.0, 1.0)
    axis.grid(visible=True, alpha=0.3)
    axis.legend(loc="lower right", fontsize=9)
