"""Results as tables: lost service by length of load, what a rule costs, how soon it reacts, small tasks and large ones.

Knows: what `study` writes. Does not know: how it came about, pictures.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Sequence
from typing import Final

import numpy as np

from zsched_lab.decisions.report import mean_and_spread
from zsched_lab.decisions.service.cast import players
from zsched_lab.decisions.service.study import YARDSTICKS, Row

OURS: Final = "service"
ORDER: Final = ("oracle", *(player.name for player in players()), *YARDSTICKS[1:])
CLASSES: Final = ((0.0, 0.3), (0.3, 0.6), (0.6, 9.0))
"""Sizes of tasks, as shares of the median machine."""
MOST_OF_ORACLE: Final = 1.3
"""Goal: so many times the oracle's lost service at most."""
MOST_WASTED: Final = 0.1
"""Goal: so much of the moves is wasted at most."""


def where(rows: Iterable[Row], **wanted: object) -> list[Row]:
    """The rows with these values."""
    return [row for row in rows if all(row[key] == value for key, value in wanted.items())]


def names(rows: Iterable[Row]) -> list[str]:
    """The rules in the usual order, others behind today's."""
    found = {str(row["rule"]) for row in rows}
    described = sorted(found - set(ORDER))
    order = (*ORDER[:2], *described, *ORDER[2:])
    return [name for name in order if name in found]


def loads_of(rows: Iterable[Row]) -> list[float]:
    """The lengths of load that were played."""
    return sorted({float(row["load_s"]) for row in rows})


def rate(rows: Sequence[Row], field: str) -> float:
    """Events per hour."""
    return sum(float(row[field]) for row in rows) / sum(float(row["hours"]) for row in rows)


def by_seed(rows: Sequence[Row], field: str) -> dict[int, float]:
    """{seed: the mean of its rows}."""
    values: dict[int, list[float]] = {}
    for row in rows:
        values.setdefault(int(row["seed"]), []).append(float(row[field]))
    return {seed: statistics.fmean(values[seed]) for seed in sorted(values)}


def percent(rows: Sequence[Row], field: str) -> str:
    """Mean and 1.96 standard errors over the seeds; what one seed gives for several loads is one value."""
    mean, spread = mean_and_spread([100.0 * value for value in by_seed(rows, field).values()])
    return f"{mean:.2f} ± {spread:.2f}"


def _percent(rows: Sequence[Row], field: str) -> float:
    return 100.0 * statistics.fmean(float(row[field]) for row in rows)


def _lower(mine: Sequence[Row], other: Sequence[Row]) -> str:
    """On how many of the seeds that both have one rule loses less than another."""
    own, theirs = by_seed(mine, "lost"), by_seed(other, "lost")
    both = own.keys() & theirs.keys()
    return f"{sum(own[seed] < theirs[seed] for seed in both)} of {len(both)}"


def _verdict(is_met: object) -> str:
    return "met" if is_met else "missed"


def _title(load_s: float) -> str:
    return f"{load_s:g} s" if load_s else "none"


def _table(title: str, head: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    rows = [f"### {title}", "", f"| {' | '.join(head)} |", f"| {' | '.join('---' for _ in head)} |"]
    return "\n".join([*rows, *(f"| {' | '.join(line)} |" for line in lines)]) + "\n"


def _by_load(rows: Sequence[Row], title: str, cell: Callable[[list[Row]], str]) -> str:
    loads_s = loads_of(rows)
    return _table(
        title,
        ("loads of", *(_title(load_s) for load_s in loads_s)),
        ((name, *(cell(where(rows, rule=name, load_s=load_s)) for load_s in loads_s)) for name in names(rows)),
    )


def lost(rows: Sequence[Row], title: str) -> str:
    """Lost service by length of load."""
    return _by_load(rows, f"{title}: lost service, %", lambda mine: percent(mine, "lost") if mine else "-")


def beside(mine: Sequence[Row], ours: Sequence[Row]) -> str:
    """How much more is lost than by another rule on the same seeds, in points, with 1.96 standard errors over seeds."""
    theirs, own = by_seed(mine, "lost"), by_seed(ours, "lost")
    both = [seed for seed in theirs if seed in own]
    if not both:
        return "-"
    mean, spread = mean_and_spread([100.0 * (theirs[seed] - own[seed]) for seed in both])
    return f"{mean:+.2f} ± {spread:.2f}"


def costs(rows: Sequence[Row], title: str) -> str:
    """Everything that is judged by, over all lengths of load."""
    loaded = [row for row in rows if row["load_s"]]
    floor = statistics.fmean([float(row["lost"]) for row in where(loaded, rule="oracle")] or [0.0])
    lines = []
    for name in names(loaded):
        mine = where(loaded, rule=name)
        share = statistics.fmean(float(row["lost"]) for row in mine)
        moves, wasted = rate(mine, "moves"), rate(mine, "wasted")
        lines.append(
            (
                name,
                f"{100.0 * share:.2f}",
                f"{share / floor:.2f}" if floor > 0.0 else "-",
                "" if name == OURS else beside(mine, where(loaded, rule=OURS)),
                f"{statistics.fmean(float(row['outputs_hz']) for row in mine):.3f}",
                f"{100.0 * statistics.fmean(float(row['missed']) for row in mine):.2f}",
                f"{100.0 * statistics.fmean(float(row['slow']) for row in mine):.2f}",
                f"{moves:.1f}",
                f"{wasted:.1f}",
            )
        )
    head = (
        "rule",
        "lost %",
        "of the oracle's",
        f"beside {OURS}, points",
        "outputs / s",
        "missed %",
        "slow %",
        "moves / h",
        "wasted / h",
    )
    return _table(f"{title}: all loads together", head, lines)


def moves(rows: Sequence[Row], title: str) -> str:
    """Moves and wasted moves by length of load."""

    def cell(mine: list[Row]) -> str:
        return f"{rate(mine, 'moves'):.1f}, {rate(mine, 'wasted'):.1f}" if mine else "-"

    return _by_load(rows, f"{title}: moves / h, wasted / h", cell)


def reactions(rows: Sequence[Row], title: str) -> str:
    """How soon a task leaves a machine whose load it feels: how often before the load's end, median, 99 %."""

    def cell(mine: list[Row]) -> str:
        took = [float(one) for row in mine for one in row["reactions_s"]]
        felt = sum(int(row["felt"]) for row in mine)
        if not took:
            return f"0 of {felt}"
        return f"{len(took)} of {felt}, {np.quantile(took, 0.5):.1f}, {np.quantile(took, 0.99):.1f}"

    loaded = [row for row in rows if row["load_s"] and not str(row["rule"]).startswith("fixed")]
    return _by_load(loaded, f"{title}: left of felt loads; seconds to the move, p50, p99", cell)


def sizes(rows: Sequence[Row], title: str) -> str:
    """Lost service by size of task, over all lengths of load."""
    loaded = [row for row in rows if row["load_s"]]
    groups = [[row for row in loaded if low <= float(row["size"]) < high] for low, high in CLASSES]
    heads = [
        f"{100 * low:.0f} to {100 * high:.0f} %" if high < 2 else f"over {100 * low:.0f} %" for low, high in CLASSES
    ]
    lines = []
    for name in names(loaded):
        mine = [where(group, rule=name) for group in groups]
        lines.append((name, *(percent(group, "lost") if group else "-" for group in mine)))
    counts = [len({row["seed"] for row in group}) for group in groups]
    head = ("share of the median machine", *(f"{one} ({count})" for one, count in zip(heads, counts, strict=True)))
    return _table(f"{title}: lost service by size of the largest task, %", head, lines)


def lengths(rows: Sequence[Row], title: str) -> str:
    """Everything that is judged by, for every length of load."""

    def cell(mine: list[Row]) -> str:
        if not mine:
            return "-"
        shares = f"{_percent(mine, 'lost'):.2f}, {_percent(mine, 'missed'):.2f}"
        return f"{shares}, {rate(mine, 'moves'):.0f}, {rate(mine, 'wasted'):.0f}"

    return _by_load([row for row in rows if row["load_s"]], f"{title}: lost %, missed %, moves / h, wasted / h", cell)


def goals(rows: Sequence[Row], title: str) -> str:
    """For every length of load: does today's rule lose less than each other one, and is it near the oracle?"""
    lines = []
    for load_s in filter(None, loads_of(rows)):
        loaded = where(rows, load_s=load_s)
        ours, oracle = where(loaded, rule=OURS), where(loaded, rule=YARDSTICKS[0])
        others = {name: where(loaded, rule=name) for name in names(loaded) if name not in (OURS, *YARDSTICKS)}
        if not (ours and oracle and others):
            continue
        least = min(others, key=lambda name: _percent(others[name], "lost"))
        own, floor = _percent(ours, "lost"), _percent(oracle, "lost")
        moved, wasted = rate(ours, "moves"), rate(ours, "wasted")
        share = wasted / moved if moved else 0.0
        lines.append(
            (
                _title(load_s),
                f"{own:.2f}",
                f"{least}, {beside(others[least], ours)}, {_lower(ours, others[least])}",
                _verdict(own < _percent(others[least], "lost")),
                f"{own / floor:.2f}, {_verdict(own <= MOST_OF_ORACLE * floor)}" if floor > 0.0 else "-",
                f"{100.0 * share:.0f} %, {_verdict(share <= MOST_WASTED)}",
            )
        )
    head = (
        "loads of",
        f"{OURS}, lost %",
        "next rule, points above it, seeds",
        "below every rule",
        f"of the oracle's (goal {MOST_OF_ORACLE:g})",
        f"wasted of its moves (goal {100.0 * MOST_WASTED:.0f} %)",
    )
    return _table(f"{title}: goals by length of load", head, lines)


def equal(rows: Sequence[Row]) -> str:
    """Moves between equal machines without load; a task that is larger than a machine starves on each."""
    parts = []
    for tasks in sorted({int(row["tasks"]) for row in rows}):
        mine = where(rows, tasks=tasks)
        lines = []
        for name in names(mine):
            for fits in (True, False):
                every = [row for row in where(mine, rule=name) if (float(row["size"]) <= 1.0) == fits]
                if every:
                    lines.append(
                        (
                            name,
                            "up to 1" if fits else "over 1",
                            f"{sum(float(row['hours']) for row in every):.1f}",
                            f"{rate(every, 'moves'):.2f}",
                            f"{sum(int(row['moves']) > 0 for row in every)} of {len(every)}",
                            f"{max(int(row['moves']) / float(row['hours']) for row in every):.1f}",
                        )
                    )
        head = (
            "rule",
            "largest task, in machines",
            "hours",
            "moves / h",
            "seeds with moves",
            "most of one seed, moves / h",
        )
        what = "one task" if tasks == 1 else f"{tasks} tasks"
        parts.append(_table(f"{what}: equal machines, no loads", head, lines))
    return "\n".join(parts)


def report(rows: Sequence[Row]) -> str:
    """All tables."""
    parts = []
    for tasks in sorted({int(row["tasks"]) for row in rows}):
        mine = where(rows, tasks=tasks)
        seeds = sorted({int(row["seed"]) for row in mine})
        hours = sum(float(row["hours"]) for row in where(mine, rule=mine[0]["rule"], price_s=mine[0]["price_s"]))
        what = "one task" if tasks == 1 else f"{tasks} tasks"
        parts.append(f"## {what}: {len(seeds)} seeds ({seeds[0]} to {seeds[-1]}), {hours:.1f} h a rule\n")
        prices_s = sorted({float(row["price_s"]) for row in mine})
        for price_s in prices_s:
            priced = where(mine, price_s=price_s)
            title = f"{what}, {price_s:g} s a move"
            parts += [lost(priced, title), costs(priced, title)]
        middle_s = prices_s[len(prices_s) // 2]
        priced = where(mine, price_s=middle_s)
        title = f"{what}, {middle_s:g} s a move"
        parts += [
            lengths(priced, title),
            goals(priced, title),
            moves(priced, title),
            reactions(priced, title),
            sizes(priced, title),
        ]
    return "\n".join(parts)
