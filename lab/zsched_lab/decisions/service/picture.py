"""Lost service by length of load, as a picture: one panel per number of tasks and price of a move.

Knows: matplotlib, what `study` writes. Does not know: how rules decide.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import matplotlib as mpl

from zsched_lab.decisions.service.study import Row
from zsched_lab.decisions.service.tables import loads_of, names, where

mpl.use("Agg")
import matplotlib.pyplot as plt

STYLES: Final = {
    "oracle": ("black", "--", ""),
    "present": ("#555555", ":", ""),
    "paper": ("#c0392b", "-", "o"),
    "service": ("#2e8b57", "-", "o"),
    "dyna_cpu": ("#1b3f6e", "-", "<"),
    "dyna_mem": ("#5b8fc9", "-", ">"),
    "dyna_both": ("#2c6fbb", "-", "s"),
    "dyna_net": ("#74b3e0", "-", "v"),
    "argmax": ("#e08e0b", "-", "^"),
    "fixed, best": ("#8a8a8a", "-", "D"),
    "fixed, mean": ("#bdbdbd", "-", "D"),
}
OTHERS: Final = ("#8e44ad", "#c9a227", "#16a085")
DPI: Final = 110


def draw(rows: Sequence[Row], path: Path) -> None:
    """Means over the seeds. Their spread is that of machines and tasks; what differs between rules is in the tables."""
    counts = sorted({int(row["tasks"]) for row in rows})
    prices_s = sorted({float(row["price_s"]) for row in rows})
    figure, axes = plt.subplots(
        len(counts), len(prices_s), figsize=(4.6 * len(prices_s), 4.0 * len(counts) + 0.5), layout="constrained",
        squeeze=False, sharey="row",
    )  # fmt: skip
    shown = names(rows)
    others = dict(zip((name for name in shown if name not in STYLES), OTHERS * len(shown), strict=False))
    for line, tasks in zip(axes, counts, strict=True):
        for axis, price_s in zip(line, prices_s, strict=True):
            mine = where(rows, tasks=tasks, price_s=price_s)
            loads_s = loads_of(mine)
            for name in shown:
                colour, dashes, mark = STYLES.get(name) or (others[name], "-", "P")
                found = [where(mine, rule=name, load_s=load_s) for load_s in loads_s]
                if not all(found):
                    continue
                means = [100.0 * statistics.fmean(float(row["lost"]) for row in one) for one in found]
                axis.plot(range(len(means)), means, color=colour, linestyle=dashes, marker=mark, ms=4, label=name)
            axis.set_xticks(range(len(loads_s)), [f"{load_s:g}" if load_s else "none" for load_s in loads_s])
            axis.set_xlabel("length of the loads, s")
            axis.grid(axis="y", lw=0.4)
            what = "one task" if tasks == 1 else f"{tasks} tasks"
            axis.set_title(f"{what}, a move costs {price_s:g} s", fontsize=10)
        line[0].set_ylabel("lost service, %")
        line[0].set_ylim(bottom=0.0)
    figure.legend(*axes[0][0].get_legend_handles_labels(), loc="outside upper center", ncols=len(shown), fontsize=9)
    figure.savefig(path, dpi=DPI)
    plt.close(figure)
