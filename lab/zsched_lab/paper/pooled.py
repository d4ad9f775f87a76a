"""Pools the offices of several records, and says how far a scheme is from fixed places and from every other scheme.

Knows: records of `zsched bench paper`, what is compared. Does not know: how an interval comes about (`claims`).

    python -m zsched_lab.paper.pooled docs/evaluation/heavy-{again,oracle,all,calm}.json [--png FILE]
    python -m zsched_lab.paper.pooled --block heavy docs/evaluation/{results,heavy-all}.json

An office is known by its seed, and compared with itself only, so blocks of different days may be pooled.
"""

from __future__ import annotations

import argparse
import json
import statistics
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from zsched_lab.paper.claims import (
    GAINS,
    LESS_IS_BETTER,
    T_975,
    Difference,
    difference,
    judged,
    one_by_one,
    table_of,
)
from zsched_lab.paper.figures import GAIN_LABELS, save_rows
from zsched_lab.paper.report import in_block, main_runs
from zsched_lab.paper.schemes import FIXED_SCHEMES
from zsched_lab.paper.tables import TITLES, Json

T_95 = (
    *(6.314, 2.920, 2.353, 2.132, 2.015, 1.943, 1.895, 1.860, 1.833, 1.812),
    *(1.796, 1.782, 1.771, 1.761, 1.753, 1.746, 1.740, 1.734, 1.729, 1.725),
    *(1.721, 1.717, 1.714, 1.711, 1.708, 1.706, 1.703, 1.701, 1.699, 1.697),
)
"""Student's t at 95 %, as `T_975` for 97.5 %: of one of two one-sided tests at 5 %."""
PLACES: Mapping[str, tuple[str, ...]] = {
    "the mean of the fixed places": FIXED_SCHEMES,
    "the large edges, fixed_e2 and fixed_e3": FIXED_SCHEMES[1:],
}
HINDSIGHT = "each office's best fixed place, in hindsight"
DRAWN = ("zsched", "dyna_both")


def pooled(records: Sequence[Json], block: str | None = None) -> list[Json]:
    """The judged runs of all records, each run known by its office's seed; ``block``: of this one where it is known."""
    found: list[Json] = []
    for results in records:
        is_there = block is not None and block in results["scenario"].get("blocks", {})
        runs = in_block(results["runs"], str(block)) if is_there else main_runs(results)
        found += [{**figures, "run": int(figures["seed"])} for figures in runs]
    return found


def best_places(runs: Sequence[Json], metric: str) -> dict[int, float]:
    """{office: the best figure of its three fixed places}: nobody can choose that one beforehand."""
    tables = [table_of(runs, metric, (name,)) for name in FIXED_SCHEMES]
    best = min if metric in LESS_IS_BETTER else max
    common = set.intersection(*(set(table) for table in tables))
    return {run: best(table[run] for table in tables) for run in sorted(common)}


def against(runs: Sequence[Json], scheme: str) -> dict[str, dict[str, Difference]]:
    """{what a scheme is held against: {metric: difference}}: fixed places, then each scheme that was run beside it."""
    bases = {**PLACES, **{name: (name,) for name in one_by_one(runs, scheme)}}
    found: dict[str, dict[str, Difference]] = {}
    for metric in GAINS:
        mine = table_of(runs, metric, (scheme,))
        tables = {name: table_of(runs, metric, schemes) for name, schemes in bases.items()}
        for name, table in {**tables, HINDSIGHT: best_places(runs, metric)}.items():
            if (one := difference(mine, table)) is not None:
                found.setdefault(name, {})[metric] = one
    return found


def equivalent_within(one: Difference) -> float:
    """The smallest margin that holds a difference by two one-sided tests at 5 %.

    >>> one = Difference(value=-0.01, low=-0.03, high=0.01, runs=25)
    >>> round(equivalent_within(one), 4)
    0.0266
    """
    place = min(one.runs - 1, len(T_975)) - 1
    return abs(one.value) + (one.high - one.value) * T_95[place] / T_975[place]


def told(runs: Sequence[Json], scheme: str) -> Iterator[str]:
    """Everything for people, a line each."""
    for name, found in against(runs, scheme).items():
        yield f"\n{scheme} against {name}"
        for metric, one in found.items():
            if one.runs > 1:
                interval = f"{one.value:+.1%} [{100 * one.low:+.1f}, {100 * one.high:+.1f}]"
                means = f"{one.mine:9.3f} {one.theirs:9.3f}"
                within = f"equivalent within {equivalent_within(one):.1%}"
                yield f"  {TITLES[metric]:<18} {means}  {interval:<24} {one.runs:>3} offices, {within}"
    yield "\nclaims of the paper"
    for claim, apart, verdict in judged(runs):
        if apart is not None and claim.source == "paper":
            yield f"  {claim.says}: {apart.text()}, {apart.runs} offices: {verdict}"
    yield f"\nmaps/s and MB/s of {len(runs)} runs: r = {likeness(runs):.2f}"


def likeness(runs: Sequence[Json]) -> float:
    """How alike merged maps and throughput are over all runs (Pearson's r)."""
    return statistics.correlation(*([float(one[name]) for one in runs] for name in ("map_hz", "throughput_mb_s")))


def draw(path: Path, runs: Sequence[Json], title: str) -> None:
    """What zsched and `dyna_both` gain over each kind of fixed place."""
    found = {scheme: against(runs, scheme) for scheme in DRAWN}
    rows = {
        (f"{name.partition(',')[0]}: {scheme}", scheme): found[scheme].get(name, {})
        for name in (*PLACES, HINDSIGHT)
        for scheme in DRAWN
    }
    save_rows(path, {key: row for key, row in rows.items() if row.keys() & GAIN_LABELS.keys()}, title)


def main(arguments: list[str] | None = None) -> int:
    """Print the differences; draw them with ``--png``."""
    parser = argparse.ArgumentParser(prog="python -m zsched_lab.paper.pooled", description=__doc__.split("\n")[0])
    parser.add_argument("records", type=Path, nargs="+", help="results.json of `zsched bench paper`")
    parser.add_argument("--scheme", default="zsched", help="which one is compared (default zsched)")
    parser.add_argument("--block", help="this one of the records that have it (default: each one's main block)")
    parser.add_argument("--png", type=Path, help="draw what is gained over a fixed place")
    given = parser.parse_args(arguments)
    runs = pooled([json.loads(path.read_text(encoding="utf-8")) for path in given.records], given.block)
    if len({(one["scheme"], one["run"]) for one in runs}) < len(runs):
        parser.error("two records have the same office: they cannot be pooled")
    print("\n".join(told(runs, given.scheme)).lstrip())
    if given.png is not None:
        names = ", ".join(path.stem for path in given.records)
        draw(given.png, runs, f"{names}: over a fixed place, where all three were played, 95 %")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
