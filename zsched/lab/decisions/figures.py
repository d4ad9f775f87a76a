"""Results as pictures: what each rule loses and how often it moves, the grid, fleets of all sizes, the drives.

Knows: matplotlib, what `study` and `drives` give. Does not know: how rules decide.
"""

from __future__ import annotations

import itertools
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
import numpy as np

from zsched.lab.decisions.report import RULES, WHOLE_GRID, Row, grid_regrets, of, rate
from zsched.lab.decisions.rules import Move
from zsched.lab.decisions.score import owners_by_step
from zsched.lab.decisions.world import DT_S, World

mpl.use("Agg")
import matplotlib.pyplot as plt

OURS, THEIRS, YARDSTICK = "#c0392b", "#2c6fbb", "#8a8a8a"
KINDS: Final = (
    ("long", "loads of 60 to 240 s"),
    ("mixed", "loads of 5 to 180 s"),
    ("short", "loads of 3 to 20 s"),
    ("radio", "driving robots, loads of 60 to 240 s"),
)
DPI: Final = 110


def _colour(rule: str) -> str:
    if rule.startswith("zsched"):
        return OURS
    return THEIRS if rule.startswith("dyna") else YARDSTICK


def _save(figure: Any, path: Path) -> None:
    figure.savefig(path, dpi=DPI)
    plt.close(figure)


def rules(rows: Sequence[Row], path: Path) -> None:
    """Regret and moves of every rule, one row of panels per kind of history."""
    kinds = [kind for kind in KINDS if of(rows, kind[0])]
    figure, axes = plt.subplots(len(kinds), 2, figsize=(11, 3.1 * len(kinds)), layout="constrained", squeeze=False)
    for row, (case, title) in enumerate(kinds):
        names = [name for name in RULES if of(rows, case, name) and name != "oracle"]
        regrets = [[100.0 * float(one["regret"]) for one in of(rows, case, name)] for name in names]
        at = np.arange(len(names))
        colours = [_colour(name) for name in names]
        means = [statistics.fmean(values) for values in regrets]
        spans = np.asarray([[m - min(v), max(v) - m] for m, v in zip(means, regrets, strict=True)]).T
        axes[row][0].bar(at, means, color=colours, yerr=spans, error_kw={"lw": 0.8, "capsize": 2})
        axes[row][0].axhline(5.0, color="black", lw=0.8, ls=":")
        axes[row][0].set_ylabel("regret, %")
        axes[row][0].set_title(f"{title}: regret (whiskers: all seeds; dotted: 5 %)", fontsize=10)
        total, wasted = ([rate(of(rows, case, name), field) for name in names] for field in ("moves", "wasted"))
        axes[row][1].bar(at, total, color=colours)
        axes[row][1].bar(at, wasted, color="black", width=0.35, label="back within 30 s")
        oracle = rate(of(rows, case, "oracle"), "moves")
        axes[row][1].axhline(oracle, color="black", lw=0.8, ls="--", label="oracle")
        axes[row][1].set_yscale("symlog", linthresh=1.0)
        axes[row][1].set_ylim(0, 40.0 * max(total))  # room for the legend
        axes[row][1].set_ylabel("moves per hour")
        axes[row][1].set_title(f"{title}: moves", fontsize=10)
        axes[row][1].legend(fontsize=8, ncols=2, loc="upper left")
        for axis in axes[row]:
            axis.set_xticks(at, names, rotation=40, ha="right", fontsize=8)
    _save(figure, path)


def grid(rows: Sequence[Row], stars: Mapping[str, str], path: Path) -> None:
    """The sweep: regret against moves, one point per setting; ``stars`` is {label: setting}."""
    figure, axis = plt.subplots(figsize=(8, 5), layout="constrained")
    regrets = grid_regrets(rows)
    cases = WHOLE_GRID
    moves = {name: statistics.fmean(rate(of(rows, case, name), "moves") for case in cases) for name in regrets}
    groups = (
        ("time-to-trigger, smoothing 3 s", "#2c6fbb", "s3 ", " t"),
        ("time-to-trigger, smoothing 1.5 s", "#74b3e0", "s1.5 ", " t"),
        ("patience, smoothing 3 s", "#2e8b57", "s3 ", " p"),
        ("patience, smoothing 1.5 s", "#90d0a8", "s1.5 ", " p"),
    )
    for label, colour, smoothing, trigger in groups:
        names = [name for name in regrets if name.startswith(smoothing) and trigger in name]
        axis.scatter([moves[n] for n in names], [100 * regrets[n] for n in names], s=22, color=colour, label=label)
    for (label, name), colour in zip(stars.items(), (OURS, "black"), strict=False):
        if name in regrets:
            place = ([moves[name]], [100 * regrets[name]])
            axis.scatter(*place, s=120, marker="*", color=colour, label=f"{label}: {name}")
    axis.set_xlabel("moves per hour")
    axis.set_ylabel("mean regret, %")
    axis.set_title("Every setting of the grid on the training seeds (long, mixed)", fontsize=10)
    axis.legend(fontsize=8)
    _save(figure, path)


def sizes(rows: Sequence[Row], path: Path) -> None:
    """Regret and moves by the number of candidates."""
    cases = {3: "long"} | {
        int(str(row["case"]).removeprefix("long-")): str(row["case"])
        for row in rows
        if str(row["case"]).startswith("long-")
    }
    counts = sorted(cases)
    figure, axes = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
    for rule, style in (
        ("zsched", "o-"),
        ("dyna_both", "s-"),
        ("argmax", "^-"),
        ("every_25s", "v-"),
        ("oracle", "k--"),
    ):
        found = [of(rows, cases[count], rule) for count in counts]
        if not all(found):
            continue
        regrets = [100.0 * statistics.fmean(float(row["regret"]) for row in mine) for mine in found]
        colour = {"color": OURS} if rule == "zsched" else {}
        if rule != "oracle":
            axes[0].plot(counts, regrets, style, label=rule, ms=4, **colour)
        axes[1].plot(counts, [max(rate(mine, "moves"), 0.1) for mine in found], style, label=rule, ms=4, **colour)
    for axis, name in zip(axes, ("regret, %", "moves per hour"), strict=True):
        axis.set_xscale("log")
        axis.set_xticks(counts, [str(count) for count in counts])
        axis.minorticks_off()
        axis.set_xlabel("candidates")
        axis.set_ylabel(name)
        axis.legend(fontsize=8)
    axes[1].set_yscale("log")
    _save(figure, path)


def drives(world: World, moves: Mapping[str, list[Move]], shown: Sequence[str], title: str, path: Path) -> None:
    """As the paper's real-world figure: the signals, and who has the task, for a few rules."""
    figure, axes = plt.subplots(
        1 + len(shown), 1, figsize=(10, 3.4 + 1.25 * len(shown)), layout="constrained", sharex=True,
        gridspec_kw={"height_ratios": [3, *(1 for _ in shown)]},
    )  # fmt: skip
    at_s = np.arange(world.steps) * DT_S
    assert world.signal is not None
    signal = world.signal if world.signal.ndim == 2 else world.signal[:, 0, :]
    colours = ("#2c6fbb", "#e08e0b", "#2e8b57")
    for index, name in enumerate(world.candidates):
        axes[0].plot(at_s, signal[:, index], color=colours[index], lw=1.2, label=name)
    axes[0].set_ylabel("signal, dBm\n(mean over 11 s)")
    axes[0].legend(fontsize=8, ncols=3)
    axes[0].set_title(title, fontsize=10)
    for axis, rule in zip(axes[1:], shown, strict=True):
        owner = owners_by_step(world, list(moves[rule]))
        edges = [0, *(np.flatnonzero(np.diff(owner)) + 1).tolist(), len(owner)]
        for begin, end in itertools.pairwise(edges):
            if owner[begin] >= 0:
                axis.axvspan(begin * DT_S, end * DT_S, color=colours[owner[begin]], alpha=0.85, lw=0)
        count = sum(move.left is not None for move in moves[rule])
        axis.set_yticks([])
        axis.set_ylabel(f"{rule}\n{count} moves", rotation=0, ha="right", va="center", fontsize=8)
    axes[-1].set_xlabel("time, s")
    axes[-1].set_xlim(0, at_s[-1])
    _save(figure, path)
