"""Results as tables for people: one line per rule and kind of history, with the spread over seeds.

Knows: what `study` writes. Does not know: how it came about, pictures (`figures`).
"""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from zsched_lab.decisions.drives import DriveFigures

Row = Mapping[str, Any]
RULES: Final = (
    *(
        "oracle",
        "zsched",
        "fixed_e1",
        "fixed_e2",
        "fixed_e3",
        "dyna_cpu",
        "dyna_mem",
        "dyna_both",
        "dyna_net",
    ),
    *("dyna_both_penalty", "argmax", "every_25s", "random", "first_match"),
)
ERRORS: Final = 1.96
"""Standard errors: a 95 % interval if there are many seeds."""
GRID_CASES: Final = ("sweep long", "sweep mixed", "sweep radio")
"""The kinds of histories that rank the settings of the grid; between equal nodes there is no regret to rank by."""
STARS: Final[Mapping[str, str]] = {"the default": "s0.3 b0.05 p0.3"}
"""Settings of the grid that have a name."""


def of(rows: Iterable[Row], case: str, rule: str | None = None) -> list[Row]:
    """The results of one case (and one rule)."""
    return [row for row in rows if row["case"] == case and (rule is None or row["rule"] == rule)]


def mean_and_spread(values: Sequence[float]) -> tuple[float, float]:
    """(mean, 1.96 standard errors over seeds); the latter is 0 with a single seed, and too small with a few."""
    mean = statistics.fmean(values)
    if len(values) < 2:
        return mean, 0.0
    return mean, ERRORS * statistics.stdev(values) / len(values) ** 0.5


def rate(rows: Sequence[Row], field: str) -> float:
    """Events per hour."""
    return sum(float(row[field]) for row in rows) / sum(float(row["hours"]) for row in rows)


def table(rows: Sequence[Row], case: str) -> str:
    """One case as a Markdown table, rules in the usual order, others behind."""
    found = of(rows, case)
    names = sorted({str(row["rule"]) for row in found}, key=_order)
    hours = sum(float(row["hours"]) for row in of(found, case, names[0]))
    lines = [
        f"### {case}: {hours:.1f} h, {len(of(found, case, names[0]))} seeds",
        "",
        "| rule | regret % | moves / h | wasted / h | bad % | utility |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for name in names:
        mine = of(found, case, name)
        regret, spread = mean_and_spread([100.0 * float(row["regret"]) for row in mine])
        bad = statistics.fmean(100.0 * float(row["bad"]) for row in mine)
        utility = statistics.fmean(float(row["mean_utility"]) for row in mine)
        moves, wasted = rate(mine, "moves"), rate(mine, "wasted")
        lines.append(
            f"| {name} | {regret:.2f} ± {spread:.2f} | {moves:.1f} | {wasted:.1f} | {bad:.2f} | {utility:.3f} |"
        )
    return "\n".join(lines) + "\n"


def step_table(rows: Sequence[Row]) -> str:
    """How soon each rule leaves a node that got 30 % worse."""
    lines = [
        "### step: 30 % worse in every weighted metric",
        "",
        "A rule that had left the node before the step has nothing to follow.",
        "",
        "| rule | followed | reaction s, median | longest |",
        "| --- | --- | --- | --- |",
    ]
    for name in sorted({str(row["rule"]) for row in of(rows, "step")} - {"oracle"}, key=_order):
        mine = of(rows, "step", name)
        took = sorted(float(row["reaction_s"]) for row in mine if row.get("reaction_s") is not None)
        times = f"{statistics.median(took):.1f} | {took[-1]:.1f}" if took else "- | -"
        lines.append(f"| {name} | {len(took)} of {len(mine)} | {times} |")
    return "\n".join(lines) + "\n"


def drive_table(figures: Sequence[DriveFigures], title: str) -> str:
    """The recorded drives as a Markdown table."""
    best = figures[0].mean_dbm
    lines = [
        f"### {title}",
        "",
        "| rule | moves | wasted | mean dBm | under the oracle, dB | under -70 dBm % | delay ms |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    lines += [
        f"| {one.rule} | {one.moves} | {one.wasted} | {one.mean_dbm:.1f} | {best - one.mean_dbm:.2f} | "
        f"{100.0 * one.weak:.1f} | {one.delay_ms:.1f} |"
        for one in figures
    ]
    return "\n".join(lines) + "\n"


def sweep_table(rows: Sequence[Row], top: int = 15) -> str:
    """The grid's best by the mean regret, then those of the rest that have a name."""
    cases = sorted({str(row["case"]) for row in rows if str(row["case"]).startswith("sweep ")})
    ranked = sorted(grid_regrets(rows).items(), key=lambda item: item[1])
    shown = ranked[:top] + [item for item in ranked[top:] if item[0] in STARS.values()]
    lines = [
        "| smoothing, bonus, price | mean regret % | "
        + " | ".join(f"{case.removeprefix('sweep ')}: regret %, moves / h" for case in cases)
        + " |",
        "| --- | --- |" + " --- |" * len(cases),
    ]
    for name, regret in shown:
        cells = []
        for case in cases:
            mine = of(rows, case, name)
            if not mine:
                cells.append("-")
                continue
            cells.append(
                f"{statistics.fmean(100.0 * float(row['regret']) for row in mine):.2f}, {rate(mine, 'moves'):.1f}"
            )
        lines.append(f"| {name} | {100.0 * regret:.2f} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def grid_played(rows: Sequence[Row]) -> list[str]:
    """Those of `GRID_CASES` that were played."""
    return [case for case in GRID_CASES if of(rows, case)]


def grid_regrets(rows: Sequence[Row]) -> dict[str, float]:
    """{setting: mean regret over the cases of the grid that were played, each with the same weight}."""
    played = grid_played(rows)
    names = sorted({str(row["rule"]) for case in played for row in of(rows, case)} - {"oracle"})
    return {
        name: statistics.fmean(
            statistics.fmean(float(row["regret"]) for row in of(rows, case, name)) for case in played
        )
        for name in names
    }


def write(rows: Sequence[Row], drives: Mapping[str, Sequence[DriveFigures]], out: Path) -> None:
    """All tables into one file."""
    cases = list(dict.fromkeys(str(row["case"]) for row in rows))
    parts = [table(rows, case) for case in cases if not case.startswith("sweep ") and case != "step"]
    if of(rows, "step"):
        parts.append(step_table(rows))
    if any(case.startswith("sweep ") for case in cases):
        parts.append("### The grid\n\n" + sweep_table(rows))
    parts += [drive_table(figures, title) for title, figures in drives.items()]
    played = sum(float(row["hours"]) for row in rows)
    heading = f"{played:.0f} hours of decisions in all, every rule's counted; ± is 1.96 standard errors over seeds.\n"
    parts.insert(0, heading)
    out.write_text("\n".join(parts), encoding="utf-8")


def _order(name: str) -> tuple[int, str]:
    return (RULES.index(name) if name in RULES else len(RULES), name)
