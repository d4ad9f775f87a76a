"""What a report says and draws of robots that SLAM on the edges leads: coverage over time, and whose CPU an edge's was.

Knows: Markdown, the curves, intervals over seeds. Does not know: how a run was made or measured.
"""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from zsched_lab.demo.plots import COLOURS, DPI
from zsched_lab.paper.claims import interval, led
from zsched_lab.paper.led_metrics import mean_stood
from zsched_lab.paper.roles import ROLES, mean_shares
from zsched_lab.paper.schemes import FIXED_SCHEMES, SCHEMES
from zsched_lab.paper.tables import known_columns, mean_text

Json = Mapping[str, Any]
OURS = {"zsched": "#111111", "zsched_slam": "#8a1c1c"}
"""Colours that stand out among the others' lines and bands."""
Curve = tuple[list[float], list[float], list[float | None]]
"""(t_s, mean share, half of its 95 % interval or ``None`` of one run)."""
COVERAGE_SAYS = (
    "Share of the truth that the newest merged map knows, right or wrong, mean over the robots; 95 % interval over the "
    "runs. What a run knew when it was done holds from there on. *Walls*: the mean share of the truth's walls that it "
    "has where they are.\n"
)
STANDS_AT_MOST = 0.05
"""Of the time robots may stand whose SLAM's edge has a model and no merger; with the merger they stand for longer."""
LED_COLUMNS = (
    ("walls_mean", "walls", 3),
    ("explored_m2", "m² at the end", 0),
    ("stopped_ratio", "stood", 3),
    ("corrections_hz", "corrections/s", 2),
    ("correction_age_max_s", "oldest s", 2),
    ("pose_error_m", "pose error m", 3),
    ("merge_cpu_s", "merge CPU s", 3),
)
"""(metric, title, digits) behind the coverage: how well the robots were led."""
MARKS = 5
"""This many instants of the run stand in the table."""
STATES = (
    ("idle", "SLAM and navigation alone"),
    ("merge", "and the merger"),
    ("model", "and the model"),
    ("both", "and both: the tipping point"),
)


def coverage_parts(runs: Sequence[Json]) -> list[str]:
    """The tables under their headings; of runs whose robots nobody leads coverage alone, where it was measured."""
    known, own = covered(runs), led(runs)
    curves = ["### Coverage over time\n", COVERAGE_SAYS, coverage_table(known)] if known else []
    if not own:
        return curves
    static, moved = (
        [one for one in own if SCHEMES[one["scheme"]].moves_slam is moves_slam] for moves_slam in (False, True)
    )
    return [
        *curves,
        "### Whose CPU an edge's was\n",
        "Shares of an edge's CPU, the mean over edges and runs by time. All but zsched's own have a quota in common.\n",
        *([roles_table(static)] if static else []),
        *(["Where SLAM moves, too, an edge has one, several or none of them:\n", roles_table(moved)] if moved else []),
        "### When robots stood\n",
        stood_text(own),
    ]


def covered(runs: Sequence[Json]) -> list[Json]:
    """The runs of which coverage over time was measured."""
    return [figures for figures in runs if figures.get("coverage_curve")]


def mean_curve(runs: Sequence[Json]) -> Curve:
    """The mean coverage of a scheme's runs at every instant that all of them have."""
    curves = [{float(t_s): float(share) for t_s, share in figures["coverage_curve"]} for figures in runs]
    instants = sorted(set.intersection(*(set(curve) for curve in curves)))
    values = [[curve[t_s] for curve in curves] for t_s in instants]
    return instants, [statistics.fmean(row) for row in values], [interval(row) for row in values]


def with_interval(mean: float, half: float | None, runs: int) -> str:
    """A mean share for people.

    >>> with_interval(0.5, 0.04, 5), with_interval(0.5, None, 1)
    ('0.500 ±0.040', '0.500 (n = 1)')
    """
    return f"{mean:.3f} (n = {runs})" if half is None else f"{mean:.3f} ±{half:.3f}"


def coverage_table(runs: Sequence[Json]) -> str:
    """A row per scheme: coverage at some instants, its mean over the run, and how the robots were led."""
    by_scheme = {name: own for name in SCHEMES if (own := [f for f in runs if f["scheme"] == name])}
    instants = mean_curve(runs)[0]
    marks = [round(number * (len(instants) - 1) / MARKS) for number in range(1, MARKS + 1)]
    chosen = [instants[mark] for mark in dict.fromkeys(marks)]
    columns = known_columns(runs, LED_COLUMNS)
    heads = ["scheme", "runs", *(f"{t_s:g} s" for t_s in chosen), "mean over the run"]
    heads += [title for _, title, _ in columns]
    lines = [f"| {' | '.join(heads)} |", "| --- " * len(heads) + "|"]
    for name, own in by_scheme.items():
        times, means, halves = mean_curve(own)
        at = dict(zip(times, zip(means, halves, strict=True), strict=True))
        over = [float(figures["coverage_mean"]) for figures in own]
        cells = [with_interval(*at[t_s], len(own)) for t_s in chosen]
        cells += [with_interval(statistics.fmean(over), interval(over), len(own))]
        cells += [mean_text([figures.get(metric) for figures in own], digits) for metric, _, digits in columns]
        lines.append(f"| {name} | {len(own)} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def roles_table(runs: Sequence[Json]) -> str:
    """A row per state of an edge: what each role took of its CPU, and their sum without zsched's own."""
    roles = [*dict.fromkeys(role for _, role in ROLES)]
    lines = [f"| on the edge | {' | '.join(roles)} | sum | zsched itself |", "| --- " * (len(roles) + 3) + "|"]
    measured = [figures["roles"] for figures in runs if figures.get("roles")]
    for state, says in STATES:
        if shares := mean_shares(measured, state):
            cells = [f"{shares.get(role, 0.0):.1%}" for role in roles]
            total = sum(shares.get(role, 0.0) for role in roles)
            row = f"| {says} | {' | '.join(cells)} | {total:.1%} | {shares.get('zsched', 0.0):.1%} |"
            lines.append(row.replace("%", " %"))
    return "\n".join(lines) + "\n"


def stood_text(runs: Sequence[Json]) -> str:
    """How long robots stood by what was on the edge of their SLAM, and whether the block is what it is to be.

    Where the merger has just left, SLAM has scans to catch up with, and its robot stands for some seconds more. So the
    block is judged by the fixed schemes, under which the merger leaves nobody; without any by those whose SLAM stays.
    """
    found: dict[str, list[dict[str, Any]]] = {"fixed": [], "moving": [], "SLAM moves, too": []}
    for one in runs:
        if one.get("stood_by_state"):
            found[_kind_of(one["scheme"])].append(one["stood_by_state"])
    kinds = {kind: own for kind, own in found.items() if own}
    if not kinds:
        return "Not measured by state.\n"
    told = {(kind, state): mean_stood(own, state) for kind, own in kinds.items() for state, _ in STATES}
    heads = " | ".join(f"{kind}: robots' minutes | stood" for kind in kinds)
    lines = [f"| on the edge of its SLAM | {heads} |", "| --- " * (2 * len(kinds) + 1) + "|"]
    for state, says in STATES:
        cells = [cell for kind in kinds for cell in _stood_cells(told[kind, state])]
        lines.append(f"| {says} | {' | '.join(cells)} |")
    return "\n".join([*lines, *_faithful(told)]) + "\n"


def _kind_of(scheme: str) -> str:
    if scheme in FIXED_SCHEMES:
        return "fixed"
    return "SLAM moves, too" if SCHEMES[scheme].moves_slam else "moving"


def _faithful(told: Mapping[tuple[str, str], tuple[float, float] | None]) -> list[str]:
    """Whether the block is what it is to be; nothing where no robot was seen in the states that tell it."""
    most = f"{100.0 * STANDS_AT_MOST:.0f} %"
    model, both = told.get(("fixed", "model")), told.get(("fixed", "both"))
    beside = told.get(("moving", "model"))
    if model is not None and both is not None:
        is_faithful = model[1] < STANDS_AT_MOST < both[1]
        says = f"Under fixed schemes less than {most} beside the model alone, and more with the merger"
    elif ("fixed", "idle") not in told and beside is not None:
        is_faithful = beside[1] < STANDS_AT_MOST
        says = f"Where SLAM stays less than {most} beside the model alone"
    else:
        return []
    return ["", f"{says}: {'as it must be' if is_faithful else '**not what the block is to show**'}."]


def _stood_cells(row: tuple[float, float] | None) -> tuple[str, str]:
    return ("-", "-") if row is None else (f"{row[0] / 60.0:.1f}", f"{100.0 * row[1]:.1f} %")


def save_coverage(path: Path, runs: Sequence[Json], title: str) -> str | None:
    """Coverage over time, a line per scheme with its interval; ``None``, and no picture, without any curve."""
    known = covered(runs)
    schemes = [name for name in SCHEMES if any(figures["scheme"] == name for figures in known)]
    if not schemes:
        return None
    figure = Figure(figsize=(9.0, 5.0), layout="constrained", dpi=DPI)
    axes = figure.subplots()
    for index, name in enumerate(schemes):
        own = [figures for figures in known if figures["scheme"] == name]
        times, means, halves = mean_curve(own)
        is_ours = name.startswith("zsched")
        colour = OURS[name] if name in OURS else COLOURS[index % len(COLOURS)]
        low = [max(mean - (half or 0.0), 0.0) for mean, half in zip(means, halves, strict=True)]
        high = [min(mean + (half or 0.0), 1.0) for mean, half in zip(means, halves, strict=True)]
        axes.fill_between(times, low, high, color=colour, alpha=0.1, linewidth=0)
        style = "--" if name.startswith("fixed") else "-"
        label = f"{name} (n = {len(own)})"
        axes.plot(times, means, style, color=colour, linewidth=2.4 if is_ours else 1.4, label=label)
    axes.set_xlabel("seconds since the robots may drive", fontsize=8)
    axes.set_ylabel("known share of the world, newest merged map", fontsize=8)
    axes.set_ylim(bottom=0.0)
    axes.set_xlim(left=0.0)
    axes.tick_params(labelsize=8)
    axes.legend(fontsize=8, frameon=False, loc="upper left")
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    axes.set_title(f"{title}; bands: 95 % over the runs", fontsize=8, color="#666666", loc="left")
    FigureCanvasAgg(figure).print_figure(path)
    return path.name
