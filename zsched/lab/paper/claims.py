"""The paper's claims and our goals, and what the runs say of each: a relative difference with an interval, a verdict.

Knows: the claims, the bootstrap. Does not know: runs, text, pictures.

Intervals are 95 % bootstrap intervals (Efron 1979) of the relative difference of means. Runs are paired: run k has one
seed for all schemes, so runs are drawn, not single figures. With so few runs an interval is rough, and told as such.
"""

from __future__ import annotations

import math
import random
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from zsched.lab.paper.schemes import FIXED_SCHEMES, PAPER_SCHEMES

DRAWS = 2000
LEAST_RUNS = 3
"""With fewer paired runs an interval says nothing."""
CONFIDENCE = 0.95
Json = Mapping[str, Any]


class Verdict(StrEnum):
    """What became of a claim."""

    EXCEEDED = "exceeded"
    REPRODUCED = "reproduced"
    NOT_REPRODUCED = "not reproduced"
    NOT_MEASURED = "not measured"
    TOO_FEW = "too few runs"


@dataclass(frozen=True, slots=True, kw_only=True)
class Difference:
    """How far ``mine`` is from ``theirs``, relative, with its interval; over ``runs`` paired runs."""

    value: float
    low: float
    high: float
    runs: int

    def text(self) -> str:
        """For people: ``+12 % [+8, +17]``."""
        return f"{self.value:+.0%} [{self.low:+.0%}, {self.high:+.0%}]".replace("%", " %")


@dataclass(frozen=True, slots=True, kw_only=True)
class Claim:
    """One claim: ``metric`` of ``mine`` (the schemes' mean) against ``theirs``, by ``target`` (relative, signed)."""

    source: str
    says: str
    metric: str
    mine: tuple[str, ...]
    theirs: tuple[str, ...]
    target: float


OTHER_DYNAMIC = ("dyna_cpu", "dyna_both")
CLAIMS = (
    Claim(
        source="paper",
        says="throughput +40 % over fixed (all variants)",
        metric="throughput_mb_s",
        mine=PAPER_SCHEMES,
        theirs=FIXED_SCHEMES,
        target=0.40,
    ),
    Claim(
        source="paper",
        says="task latency -28 % against fixed (all variants)",
        metric="task_latency_s",
        mine=PAPER_SCHEMES,
        theirs=FIXED_SCHEMES,
        target=-0.28,
    ),
    Claim(
        source="paper",
        says="map frequency: dyna_mem +20 % over the other variants",
        metric="map_hz",
        mine=("dyna_mem",),
        theirs=OTHER_DYNAMIC,
        target=0.20,
    ),
    Claim(
        source="paper",
        says="map frequency of its best variant over fixed",
        metric="map_hz",
        mine=("dyna_mem",),
        theirs=FIXED_SCHEMES,
        target=0.0,
    ),
    Claim(
        source="paper",
        says="best map accuracy: dyna_both over fixed",
        metric="ssim_rebased",
        mine=("dyna_both",),
        theirs=FIXED_SCHEMES,
        target=0.0,
    ),
    Claim(
        source="paper",
        says="best map accuracy: dyna_both over the other variants",
        metric="ssim_rebased",
        mine=("dyna_both",),
        theirs=("dyna_cpu", "dyna_mem"),
        target=0.0,
    ),
    Claim(
        source="paper",
        says="CPU is spread more evenly than under fixed",
        metric="cpu_mean_spread",
        mine=PAPER_SCHEMES,
        theirs=FIXED_SCHEMES,
        target=0.0,
    ),
    Claim(
        source="paper",
        says="memory is spread more evenly than under fixed",
        metric="memory_mean_spread",
        mine=PAPER_SCHEMES,
        theirs=FIXED_SCHEMES,
        target=0.0,
    ),
    Claim(
        source="goal",
        says="zsched: throughput at least +40 % over fixed",
        metric="throughput_mb_s",
        mine=("zsched",),
        theirs=FIXED_SCHEMES,
        target=0.40,
    ),
    Claim(
        source="goal",
        says="zsched: task latency at most -28 % against fixed",
        metric="task_latency_s",
        mine=("zsched",),
        theirs=FIXED_SCHEMES,
        target=-0.28,
    ),
    Claim(
        source="goal",
        says="zsched: map frequency at least +20 % over fixed",
        metric="map_hz",
        mine=("zsched",),
        theirs=FIXED_SCHEMES,
        target=0.20,
    ),
)
LESS_IS_BETTER = frozenset(
    {
        "task_latency_s",
        "cpu_peak",
        "cpu_mean_spread",
        "memory_mean",
        "memory_mean_spread",
        "regret",
        "gap_max_s",
        "merge_latency_p50_s",
        "merge_latency_p95_s",
        "merge_latency_p99_s",
        "moves",
        "wasted_moves",
    }
)
SIX = ("cpu_peak", "memory_mean", "throughput_mb_s", "map_hz", "task_latency_s", "ssim_rebased")
"""The paper's six metrics, fleet-wide."""

# --- figures ---------------------------------------------------------------------------------------------------------


def table_of(runs: Sequence[Json], metric: str, schemes: Sequence[str]) -> dict[int, float]:
    """{run: mean of the schemes' figures}; only runs in which every one of the schemes has the figure."""
    found: dict[int, dict[str, float]] = {}
    for figures in runs:
        value = figures.get(metric)
        if figures["scheme"] in schemes and value is not None:
            found.setdefault(int(figures["run"]), {})[figures["scheme"]] = float(value)
    return {run: statistics.fmean(row.values()) for run, row in sorted(found.items()) if len(row) == len(schemes)}


def difference(mine: Mapping[int, float], theirs: Mapping[int, float], seed: int = 1) -> Difference | None:
    """The relative difference of the means over the runs that both have; ``None`` without a run, or of nothing."""
    common = sorted(mine.keys() & theirs.keys())
    if not common:
        return None
    ours, others = [mine[run] for run in common], [theirs[run] for run in common]
    value = relative(ours, others)
    if value is None:
        return None
    generator = random.Random(seed)
    drawn = []
    for _ in range(DRAWS):
        picked = generator.choices(range(len(common)), k=len(common))
        one = relative([ours[i] for i in picked], [others[i] for i in picked])
        if one is not None:
            drawn.append(one)
    drawn.sort()
    tail = (1.0 - CONFIDENCE) / 2
    low, high = drawn[int(tail * len(drawn))], drawn[min(int((1 - tail) * len(drawn)), len(drawn) - 1)]
    return Difference(value=value, low=low, high=high, runs=len(common))


def relative(mine: Sequence[float], theirs: Sequence[float]) -> float | None:
    """``mean(mine) / mean(theirs) - 1``, the sign turned for a negative base; ``None`` for a base of nothing."""
    base = statistics.fmean(theirs)
    return None if math.isclose(base, 0.0, abs_tol=1e-9) else (statistics.fmean(mine) - base) / abs(base)


def verdict(claim: Claim, found: Difference | None) -> Verdict:
    """What a difference says of a claim.

    Reproduced: the mean meets it, and the interval is clear of no effect. Exceeded: the whole interval meets it.
    A claim without a figure ("best", "more evenly") is reproduced when the interval lies on its side of nothing.
    """
    if found is None:
        return Verdict.NOT_MEASURED
    if found.runs < LEAST_RUNS:
        return Verdict.TOO_FEW
    sign = -1.0 if claim.metric in LESS_IS_BETTER else 1.0
    least = min(sign * found.low, sign * found.high)
    target = abs(claim.target)
    if least <= 0.0 or sign * found.value < target:
        return Verdict.NOT_REPRODUCED
    return Verdict.EXCEEDED if 0.0 < target < least else Verdict.REPRODUCED


def judged(runs: Sequence[Json]) -> list[tuple[Claim, Difference | None, Verdict]]:
    """Every claim with what was found, at the main level."""
    found = []
    for claim in CLAIMS:
        one = difference(table_of(runs, claim.metric, claim.mine), table_of(runs, claim.metric, claim.theirs))
        found.append((claim, one, verdict(claim, one)))
    return found


def better_than_ours(runs: Sequence[Json]) -> list[tuple[str, str, Difference]]:
    """(scheme, metric, difference) where one of the paper's beats ours beyond the interval, on the six metrics."""
    found = []
    for scheme in (*FIXED_SCHEMES, *PAPER_SCHEMES):
        for metric in SIX:
            one = difference(table_of(runs, metric, (scheme,)), table_of(runs, metric, ("zsched",)))
            if one is None or one.runs < LEAST_RUNS:
                continue
            is_better = one.high < 0.0 if metric in LESS_IS_BETTER else one.low > 0.0
            if is_better:
                found.append((scheme, metric, one))
    return found
