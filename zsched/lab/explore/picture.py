"""Draws explorations: merged maps beside the truth with every robot's path, and coverage over time.

Knows: grids, paths, curves. Does not know: how they came about.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from zsched.lab.plots import COLOURS, DPI, difference, on_one_canvas, shade, write
from zsched.tasks.map_merge.geometry import Pose2
from zsched.tasks.map_merge.grid import Grid

PATH_COLOURS = (COLOURS[0], COLOURS[5], COLOURS[2], COLOURS[3], COLOURS[1])


@dataclass(frozen=True, slots=True, kw_only=True)
class Picture:
    """One exploration: its last merged map in the truth's frame, true paths in the world, coverage (t_s, share)."""

    title: str
    merged: Grid | None
    paths: Mapping[str, Sequence[Pose2]]
    coverage: Sequence[tuple[float, float]]


def save_pictures(path: Path, truth: Grid, pictures: Sequence[Picture], title: str) -> None:
    """Write one figure: a row for each exploration (map with paths, difference to the truth), and all curves below.

    Raises:
        OSError: the file cannot be written.
    """
    rows = len(pictures)
    figure = Figure(figsize=(13.0, 5.2 * rows + 3.6), layout="constrained", dpi=DPI)
    layout = figure.add_gridspec(rows + 1, 2, height_ratios=(*([5.2] * rows), 3.2))
    for row, picture in enumerate(pictures):
        axes = figure.add_subplot(layout[row, 0]), figure.add_subplot(layout[row, 1])
        _draw_map(axes, truth, picture)
    curves = figure.add_subplot(layout[rows, :])
    for index, picture in enumerate(pictures):
        times, shares = [t_s for t_s, _ in picture.coverage], [share for _, share in picture.coverage]
        curves.plot(times, shares, color=COLOURS[index % len(COLOURS)], label=picture.title)
    curves.set_xlabel("seconds")
    curves.set_ylabel("coverage of the merged map, as the robots have it")
    curves.set_ylim(0.0, 1.0)
    curves.grid(visible=True, alpha=0.3)
    curves.legend(loc="lower right", fontsize=9)
    figure.suptitle(title, fontsize=12)
    write(figure, path)


def _draw_map(axes: tuple[Axes, Axes], truth: Grid, picture: Picture) -> None:
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
    axes[0].set_title(f"{picture.title}: merged map and paths (dot: start)", fontsize=10)
    axes[1].imshow(difference(truth_layer, merged_layer, 1), origin="lower", extent=extent)
    axes[1].set_title("difference to the truth (blue: not seen, orange: too much)", fontsize=10)
    for axis in axes:
        axis.tick_params(labelsize=8)
