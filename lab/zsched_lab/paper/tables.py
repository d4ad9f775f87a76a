"""Tables of a report: means of every scheme, and differences with their intervals.

Knows: Markdown, columns, digits. Does not know: which runs belong together, what is said around a table.
"""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from zsched_lab.paper.claims import GAINS, Difference
from zsched_lab.paper.schemes import SCHEMES

Json = Mapping[str, Any]
Gains = Mapping[tuple[str, ...], Mapping[str, Difference]]
"""{names of a row: {metric: difference}}."""
COLUMNS = (
    ("map_hz", "maps/s", 2),
    ("throughput_mb_s", "MB/s", 1),
    ("received_mb_s", "received MB/s", 2),
    ("task_latency_s", "task s", 1),
    ("is_done", "done", 2),
    ("merge_latency_p50_s", "p50 s", 2),
    ("merge_latency_p95_s", "p95 s", 2),
    ("served_ratio", "served", 3),
    ("cpu_peak", "CPU peak", 2),
    ("memory_mean", "mem mean", 2),
    ("ssim_rebased", "SSIM", 3),
    ("held_ssim_rebased", "SSIM held", 3),
    ("walls_mean", "walls on the way", 3),
    ("coverage_mean", "covered on the way", 3),
    ("stopped_ratio", "stood", 2),
    ("moves", "moves", 1),
    ("wasted_moves", "wasted", 1),
    ("other_moves", "moves of others", 1),
    ("move_gap_max_s", "longest gap s, mean", 2),
    ("lost_per_move", "lost/move", 1),
    ("regret", "regret", 3),
)
"""(metric, title, digits) of the table of a block; results.json has the other metrics."""
SMALL = ("map_hz", "task_latency_s", "is_done", "merge_latency_p50_s", "merge_latency_p95_s", "held_ssim_rebased")
SMALL_COLUMNS = tuple(
    column for column in COLUMNS if column[0] in (*SMALL, "moves", "move_gap_max_s", "lost_per_move", "regret")
)
"""The columns of blocks that run only some schemes."""
DROP_COLUMNS = (("moves", "moves in all", 0), ("lost", "lost in all", 0), ("dropped", "dropped in all, by reason", 0))
UNKNOWN_DROP = "reason not kept"
TITLES = {metric: title for metric, title, _ in COLUMNS}


def schemes_text(runs: Sequence[Json]) -> str:
    """One row per scheme: means over its runs."""
    columns = known_columns(runs, COLUMNS)
    return "\n".join([*head_of(("scheme",), columns), *scheme_rows(runs, columns)]) + "\n"


def known_columns(runs: Sequence[Json], columns: Sequence[tuple[str, str, int]]) -> list[tuple[str, str, int]]:
    """The columns that some run has a figure for."""
    return [column for column in columns if any(figures.get(column[0]) is not None for figures in runs)]


def head_of(names: Sequence[str], columns: Sequence[tuple[str, str, int]]) -> list[str]:
    """The two first lines of a table of means."""
    titles = [*names, "runs", *(title for _, title, _ in columns)]
    return [f"| {' | '.join(titles)} |", "| --- " * len(titles) + "|"]


def scheme_rows(runs: Sequence[Json], columns: Sequence[tuple[str, str, int]], before: str = "") -> list[str]:
    """A row per scheme that was run; ``before`` are its first cells."""
    lines = []
    for name in SCHEMES:
        own = [figures for figures in runs if figures["scheme"] == name]
        if own:
            cells = [mean_text([figures.get(metric) for figures in own], digits) for metric, _, digits in columns]
            lines.append(f"{before}| {name} | {len(own)} | {' | '.join(cells)} |")
    return lines


def losses_table(groups: Mapping[str, Sequence[Json]]) -> str:
    """What each scheme's runs lost and dropped in all, by reason; only schemes that did. Empty where nobody did."""
    lines = []
    for where, runs in groups.items():
        for name in SCHEMES:
            own = [figures for figures in runs if figures["scheme"] == name]
            lost, dropped = (sum(int(figures.get(key) or 0) for figures in own) for key in ("lost", "dropped"))
            if lost or dropped:
                moves = sum(int(figures["moves"]) for figures in own)
                lines.append(f"| {where} | {name} | {len(own)} | {moves} | {lost} | {drops_text(own)} |")
    if not lines:
        return ""
    return "\n".join([*head_of(("where", "scheme"), DROP_COLUMNS), *lines]) + "\n"


def drops_text(runs: Sequence[Json]) -> str:
    """What runs dropped, by reason, the most first; runs of before reasons were kept have their sum alone.

    >>> drops_text([{"dropped": 4, "drops": {"cut": 3, "overflow": 1}}, {"dropped": 3}])
    'cut 3, reason not kept 3, overflow 1'
    >>> drops_text([{"dropped": 0}])
    '0'
    """
    drops: Counter[str] = Counter()
    for figures in runs:
        drops.update(figures.get("drops") or {UNKNOWN_DROP: int(figures.get("dropped") or 0)})
    return ", ".join(f"{reason} {count}" for reason, count in drops.most_common() if count) or "0"


def gains_table(titles: Sequence[str], rows: Gains) -> str:
    """Rows of differences in `GAINS`, those without any left out; ``titles`` head their names. Empty without rows."""
    known = {names: found for names, found in rows.items() if found}
    metrics = [metric for metric in GAINS if any(metric in found for found in known.values())]
    if not known:
        return ""
    lines = [
        f"| {' | '.join(titles)} | runs | " + " | ".join(TITLES[metric] for metric in metrics) + " |",
        "| --- " * (len(titles) + 1 + len(metrics)) + "|",
    ]
    for names, found in known.items():
        cells = [found[metric].text() if metric in found else "-" for metric in metrics]
        lines.append(f"| {' | '.join(names)} | {min(one.runs for one in found.values())} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def mean_text(values: Sequence[float | None], digits: int) -> str:
    """The mean of what was measured; a dash for nothing."""
    known = [float(value) for value in values if value is not None]
    return f"{statistics.fmean(known):.{digits}f}" if known else "-"
