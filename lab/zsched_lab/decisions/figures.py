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

from zsched_lab.decisions.report import RULES, STARS, Row, grid_played, grid_regrets, mean_and_spread, of, rate
from zsched_lab.decisions.rules import Move
from zsched_lab.decisions.score import owners_by_step
from zsched_lab.decisions.world import DT_S, World

mpl.use("Agg")
import matplotlib.pyplot as plt

OURS, THEIRS, YARDSTICK = "#c0392b", "#2c6fbb", "#8a8a8a"
KINDS: Final = (
    ("long", "loads of 60 to 240 s"),
    ("mixed", "loads of 5 to 180 s"),
    ("short", "loads of 3 to 20 s"),
    ("radio", "driving robots, loads of 60 to 240 s"),
)
OPTIONS: Final = {"robots": "three robots, one access point"}
STEP_GOAL_S: Final = 4.3
"""Time-to-trigger, 0.6 time constants and a round (design)."""
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
        means, spans = zip(*(mean_and_spread(values) for values in regrets), strict=True)
        axes[row][0].bar(at, means, color=colours, yerr=spans, error_kw={"lw": 0.8, "capsize": 2})
        axes[row][0].axhline(5.0, color="black", lw=0.8, ls=":")
        axes[row][0].set_ylabel("regret, %")
        axes[row][0].set_title(f"{title}: regret ({len(regrets[0])} h, ± 1.96 s.e.)", fontsize=10)
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


def stickiness(rows: Sequence[Row], path: Path) -> None:
    """Two equal nodes under noise: moves per hour; one of them 30 % worse: how soon each rule leaves it."""
    names = [name for name in RULES if of(rows, "equal", name) and of(rows, "step", name) and name != "oracle"]
    figure, axes = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained", sharey=True)
    at = np.arange(len(names))
    axes[0].barh(at, [rate(of(rows, "equal", name), "moves") for name in names], color=[_colour(n) for n in names])
    axes[0].set_xscale("symlog", linthresh=1.0)
    axes[0].axvline(1.0, color="black", lw=0.8, ls=":")
    axes[0].set_xlabel("moves per hour (dotted: goal, at most 1)")
    axes[0].set_title("two equal nodes, readings uniform within 15 %", fontsize=10)
    axes[0].set_yticks(at, names, fontsize=8)
    axes[0].invert_yaxis()
    for index, name in enumerate(names):
        mine = of(rows, "step", name)
        took = [float(row["reaction_s"]) for row in mine if row.get("reaction_s") is not None]
        axes[1].scatter(took, [index] * len(took), s=14, color=_colour(name), alpha=0.6)
        axes[1].text(17.0, index, f"{len(took)} of {len(mine)}", fontsize=8, va="center")
    axes[1].axvline(STEP_GOAL_S, color="black", lw=0.8, ls=":")
    axes[1].set_xlim(0, 20)
    axes[1].set_xlabel(f"seconds from the step to the move (dotted: goal, {STEP_GOAL_S:g} s)")
    axes[1].set_title("the owner gets 30 % worse (right: how often followed)", fontsize=10)
    _save(figure, path)


def options(rows: Sequence[Row], path: Path) -> None:
    """What each option loses to the oracle, one panel per question."""
    cases = [case for case in dict.fromkeys(str(row["case"]) for row in rows) if case in OPTIONS or "costs" in case]
    figure, axes = plt.subplots(-(-len(cases) // 3), 3, figsize=(14, 8.5), layout="constrained", squeeze=False)
    for axis in axes.flat[len(cases) :]:
        axis.set_axis_off()
    for axis, case in zip(axes.flat, cases, strict=False):
        found = dict.fromkeys(str(row["rule"]) for row in of(rows, case))
        names = [name for name in found if name != "oracle" and "argmax" not in name]
        pairs = [mean_and_spread([100.0 * float(row["regret"]) for row in of(rows, case, name)]) for name in names]
        at = np.arange(len(names))
        colours = [OURS if name == "zsched" else THEIRS for name in names]
        axis.barh(at, [mean for mean, _ in pairs], xerr=[span for _, span in pairs], color=colours,
                  error_kw={"lw": 0.8, "capsize": 2})  # fmt: skip
        axis.set_yticks(at, names, fontsize=7)
        axis.invert_yaxis()
        axis.set_xlabel("regret, %")
        axis.set_title(f"{OPTIONS.get(case, case)} ({len(of(rows, case, names[0]))} h)", fontsize=9)
    _save(figure, path)


def grid(rows: Sequence[Row], path: Path) -> None:
    """The sweep: regret against moves, one point per setting, the `STARS` among them."""
    figure, axis = plt.subplots(figsize=(8, 5), layout="constrained")
    regrets = grid_regrets(rows)
    cases = grid_played(rows)
    moves = {name: statistics.fmean(rate(of(rows, case, name), "moves") for case in cases) for name in regrets}
    groups = (
        ("smoothing 3 s", "#2e8b57", "s3 "),
        ("smoothing 1 s", "#c9a227", "s1 "),
        ("smoothing 0.3 s", "#2c6fbb", "s0.3 "),
    )
    for label, colour, smoothing in groups:
        names = [name for name in regrets if name.startswith(smoothing)]
        axis.scatter([moves[n] for n in names], [100 * regrets[n] for n in names], s=22, color=colour, label=label)
    for label, name in STARS.items():
        if name in regrets:
            place = ([moves[name]], [100 * regrets[name]])
            axis.scatter(*place, s=120, marker="*", color=OURS, label=f"{label}: {name}")
    axis.set_xlabel("moves per hour")
    axis.set_ylabel("mean regret, %")
    kinds = ", ".join(case.removeprefix("sweep ") for case in cases)
    axis.set_title(f"Every setting of the grid on the training seeds ({kinds})", fontsize=10)
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
    """As the paper's real-world figure: the signals, and the owner of the task, for a few rules."""
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
