"""Draws the panels of the paper's figure, the sweep over load, what placing gains, and the radio with the task's moves.

Knows: figures per run, colours. Does not know: how they were measured.
"""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from zsched_lab.demo.plots import COLOURS, DPI
from zsched_lab.paper.claims import Difference, over, shared
from zsched_lab.paper.schemes import SCHEMES, Family

Json = Mapping[str, Any]
FAMILY_COLOURS = {Family.FIXED: "#9aa0a6", Family.PAPER: "#56B4E9", Family.OURS: "#D55E00", Family.YARDSTICK: "#c9b458"}
PER_NODE = (
    ("cpu", "cpu_peak", "CPU utilisation, peak (share of the quota)"),
    ("memory", "memory_mean", "memory utilisation, mean (share of the limit)"),
    ("throughput", "throughput_mb_s", "throughput of the task's streams (MB/s)"),
)
PER_SCHEME = (
    ("frequency", "map_hz", "merged maps per second, as the robots see them"),
    ("latency", "task_latency_s", "task latency: time to the target coverage (s)"),
    ("ssim", "ssim_rebased", "structural similarity of the map (0: no map, 1: truth)"),
)
WITH_YARDSTICKS = (
    ("merge-latency", "merge_latency_p95_s", "newest input to merged map at a robot, p95 (s)"),
    ("moves", "moves", "moves in a run"),
    ("regret", "regret", "regret against the oracle"),
)
GAIN_LABELS = {
    "map_hz": "merged maps per second, %",
    "merge_latency_p95_s": "merge latency p95, % (less is better)",
    "task_latency_s": "task latency, % (less is better)",
    "coverage_mean": "covered on the way, %",
}


def save_all(runs: Sequence[Json], level: str, levels: Sequence[str], folder: Path, title: str) -> list[str]:
    """Every picture that the runs have figures for; returns the names of the files.

    The paper's panels show the paper's schemes and ours, the others all schemes; every picture holds only the runs that
    each of its schemes has, since each run has a world of its own.
    """
    main = [figures for figures in runs if figures["level"] == level]
    paper = shared([f for f in main if SCHEMES[f["scheme"]].family is not Family.YARDSTICK], "scheme")
    every = shared(main, "scheme")
    panels = [(per_node, paper, panel) for panel in PER_NODE]
    panels += [(per_scheme, paper, panel) for panel in PER_SCHEME]
    panels += [(per_scheme, every, panel) for panel in WITH_YARDSTICKS]
    names = []
    for draw, shown, (name, metric, label) in panels:
        schemes = [one for one in SCHEMES if any(figures["scheme"] == one for figures in shown)]
        if schemes:
            fill = partial(draw, runs=shown, schemes=schemes, metric=metric, label=label)
            names.append(save(folder / f"{name}.png", fill, title))
    swept = shared(runs, "level", "scheme")
    at = [one for one in levels if any(figures["level"] == one for figures in swept)]
    if len(at) > 1:
        names.append(save(folder / "sweep.png", partial(sweep, runs=swept, levels=at), title))
    return names


def save_panels(path: Path, runs: Sequence[Json], title: str) -> str:
    """The six panels of the paper's figure in one picture, over the runs that every scheme has: for a block."""
    shown = shared(runs, "scheme")
    schemes = [one for one in SCHEMES if any(figures["scheme"] == one for figures in shown)]
    figure = Figure(figsize=(13.0, 7.0), layout="constrained", dpi=DPI)
    above, below = figure.subplots(2, 3)
    for axes, (_, metric, label) in zip(above, PER_NODE, strict=True):
        per_node(axes, shown, schemes, metric, label)
    for axes, (_, metric, label) in zip(below, PER_SCHEME, strict=True):
        per_scheme(axes, shown, schemes, metric, label)
    figure.suptitle(title, fontsize=8, color="#666666", x=0.01, ha="left")
    FigureCanvasAgg(figure).print_figure(path)
    return path.name


def save_gains(path: Path, groups: Mapping[str, Sequence[Json]], title: str) -> str | None:
    """What zsched gains over fixed placement, and what the oracle does, with intervals: a row per group of runs.

    ``None``, and no picture, where no group has enough runs.
    """
    found = {(name, scheme): over(runs, scheme) for name, runs in groups.items() for scheme in ("oracle", "zsched")}
    return save_rows(path, {(f"{name}: {scheme}", scheme): found[name, scheme] for name, scheme in found}, title)


def save_rows(path: Path, found: Mapping[tuple[str, str], Mapping[str, Difference]], title: str) -> str | None:
    """Differences in `GAIN_LABELS` with their intervals: {(what stands beside a row, its scheme): differences}."""
    rows = [key for key, known in found.items() if known]
    if not rows:
        return None
    rows.reverse()  # the first at the top
    figure = Figure(figsize=(11.0, 1.2 + 0.3 * len(rows)), layout="constrained", dpi=DPI)
    panels = figure.subplots(1, len(GAIN_LABELS), sharey=True)
    for axes, (metric, label) in zip(panels, GAIN_LABELS.items(), strict=True):
        for place, key in enumerate(rows):
            if (one := found[key].get(metric)) is None:
                continue
            colour = FAMILY_COLOURS[SCHEMES[key[1]].family]
            axes.plot([100 * one.low, 100 * one.high], [place, place], color=colour, linewidth=2)
            axes.plot(100 * one.value, place, "o", color=colour, markersize=5)
        axes.axvline(0.0, color="#999999", linewidth=0.8)
        axes.set_xlabel(label, fontsize=8)
        axes.tick_params(labelsize=8)
    panels[0].set_yticks(range(len(rows)), [name for name, _ in rows], fontsize=8)
    figure.suptitle(title, fontsize=8, color="#666666", x=0.01, ha="left")
    FigureCanvasAgg(figure).print_figure(path)
    return path.name


def save(path: Path, draw: Any, title: str) -> str:
    """One picture; ``draw`` fills its axes."""
    figure = Figure(figsize=(8.0, 4.2), layout="constrained", dpi=DPI)
    axes = figure.subplots()
    draw(axes)
    axes.set_title(title, fontsize=8, color="#666666", loc="left")
    FigureCanvasAgg(figure).print_figure(path)
    return path.name


def values_of(runs: Sequence[Json], scheme: str, metric: str) -> list[float]:
    """The scheme's figures that were measured, by run."""
    own = sorted((figures for figures in runs if figures["scheme"] == scheme), key=lambda figures: int(figures["run"]))
    return [float(figures[metric]) for figures in own if figures.get(metric) is not None]


def per_scheme(axes: Axes, runs: Sequence[Json], schemes: Sequence[str], metric: str, label: str) -> None:
    """A bar per scheme (the mean) with a dot per run."""
    for place, name in enumerate(schemes):
        values = values_of(runs, name, metric)
        if values:
            axes.bar(place, statistics.fmean(values), color=FAMILY_COLOURS[SCHEMES[name].family], width=0.7)
            axes.plot([place] * len(values), values, "o", color="#222222", markersize=3)
    _names(axes, schemes)
    axes.set_ylabel(label, fontsize=8)


def per_node(axes: Axes, runs: Sequence[Json], schemes: Sequence[str], metric: str, label: str) -> None:
    """A group of bars per scheme, one per node, as in the paper's panels."""
    nodes = sorted({node for figures in runs for node in figures["nodes"]})
    width = 0.8 / max(len(nodes), 1)
    for index, node in enumerate(nodes):
        places, means = [], []
        for place, name in enumerate(schemes):
            own = [f["nodes"][node][metric] for f in runs if f["scheme"] == name and node in f["nodes"]]
            known = [float(value) for value in own if value is not None]
            if known:
                places.append(place + (index - (len(nodes) - 1) / 2) * width)
                means.append(statistics.fmean(known))
        axes.bar(places, means, width=width, color=COLOURS[index % len(COLOURS)], label=node)
    if nodes:
        axes.legend(fontsize=7, ncols=len(nodes), frameon=False, loc="upper right")
        axes.set_ylim(top=1.12 * max(axes.get_ylim()[1], 1e-6))  # room for the legend
    _names(axes, schemes)
    axes.set_ylabel(label, fontsize=8)


def sweep(axes: Axes, runs: Sequence[Json], levels: Sequence[str]) -> None:
    """Map frequency over the strength of the injected load, a line per scheme that was run at every level."""
    for index, name in enumerate(SCHEMES):
        at_level = [values_of([f for f in runs if f["level"] == level], name, "map_hz") for level in levels]
        if all(at_level):
            means = [statistics.fmean(values) for values in at_level]
            axes.plot(range(len(levels)), means, "o-", label=name, color=COLOURS[index % len(COLOURS)], markersize=4)
    axes.set_xticks(range(len(levels)), levels, fontsize=8)
    axes.set_xlabel("injected load", fontsize=8)
    axes.set_ylabel("merged maps per second", fontsize=8)
    axes.set_ylim(bottom=0)
    axes.legend(fontsize=7, frameon=False)


def _names(axes: Axes, schemes: Sequence[str]) -> None:
    axes.set_xticks(range(len(schemes)), schemes, rotation=30, ha="right", fontsize=7)
    axes.tick_params(axis="y", labelsize=8)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


# --- robot to robot --------------------------------------------------------------------------------------------------


def save_radio(
    path: Path,
    signals: Mapping[str, Sequence[tuple[float, float]]],
    rows: Mapping[str, Sequence[tuple[float, str]]],
    end_s: float,
) -> str:
    """The robots' signals over time, and below which robot held the task under each scheme (the paper's last figure).

    ``signals`` {robot: [(t_s, dBm)]}; ``rows`` {scheme: [(from when, robot)]}.
    """
    robots = sorted(signals)
    colours = dict(zip(robots, COLOURS, strict=False))
    figure = Figure(figsize=(9.0, 5.0), layout="constrained", dpi=DPI)
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1 + len(rows) * 0.35))
    for robot in robots:
        above.plot(*zip(*signals[robot], strict=True), color=colours[robot], label=robot, linewidth=1.1)
    above.set_ylabel("signal as the robots smoothed it (dBm)", fontsize=8)
    above.legend(fontsize=7, ncols=len(robots), frameon=False)
    for place, owners in enumerate(rows.values()):
        ends = [*(start for start, _ in owners[1:]), end_s]
        for (start, robot), end in zip(owners, ends, strict=True):
            below.barh(
                place, end - max(start, 0.0), left=max(start, 0.0), color=colours.get(robot, "#222222"), height=0.7
            )
    below.set_yticks(range(len(rows)), [f"{s} ({max(len(o) - 1, 0)} moves)" for s, o in rows.items()], fontsize=8)
    below.set_xlabel("seconds; the colour says which robot holds the task", fontsize=8)
    FigureCanvasAgg(figure).print_figure(path)
    return path.name
