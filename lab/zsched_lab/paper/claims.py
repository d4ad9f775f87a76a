"""The paper's claims and our goals, and what the runs say of each: a relative difference with an interval, a verdict.

Knows: the claims, the interval. Does not know: runs, text, pictures.

Intervals are 95 % intervals of the relative difference of means, by Student's t on the residuals of the ratio of paired
runs (the ratio estimator's linearised variance: Cochran, Sampling Techniques, 1977, ch. 6). Runs are paired: run k has
one seed, one world and one schedule for all schemes. A bootstrap over three to five runs would be too narrow: it knows
no other values than these, and no t.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from zsched_lab.paper.schemes import FIXED_SCHEMES, PAPER_SCHEMES, SCHEMES, Family

LEAST_RUNS = 3
"""With fewer paired runs an interval says nothing."""
T_975 = (
    *(12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228),
    *(2.201, 2.179, 2.160, 2.145, 2.131, 2.120, 2.110, 2.101, 2.093, 2.086),
    *(2.080, 2.074, 2.069, 2.064, 2.060, 2.056, 2.052, 2.048, 2.045, 2.042),
)
"""Student's t at 97.5 % for 1, 2, ... degrees of freedom; beyond, the last one (it is on the safe side)."""
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
    """How far ``mine`` is from ``theirs``, relative, with its 95 % interval; over ``runs`` paired runs."""

    value: float
    low: float
    high: float
    runs: int
    mine: float = 0.0
    """The mean figure itself."""
    theirs: float = 0.0
    is_points: bool = False
    """Not relative: shares of the time, apart (`points`)."""

    def text(self) -> str:
        """For people: ``+12 % [+8, +17]``; of one run, which has no interval, ``+12 % (n = 1)``.

        Of `points` ``+12 % [+8, +17] of the time``.
        """
        return self._shown() + " of the time" * self.is_points

    def _shown(self) -> str:
        if not math.isfinite(self.low):
            return f"{self.value:+.0%} (n = {self.runs})".replace("%", " %")
        low, high = (f"{100 * end:+.0f}" for end in (self.low, self.high))
        return f"{self.value:+.0%} [{low}, {high}]".replace("%", " %")


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


def _claimed(
    says: str,
    metric: str,
    *,
    mine: tuple[str, ...] = PAPER_SCHEMES,
    theirs: tuple[str, ...] = FIXED_SCHEMES,
    target: float = 0.0,
) -> Claim:
    """A claim of the paper."""
    return Claim(source="paper", says=says, metric=metric, mine=mine, theirs=theirs, target=target)


def _each(says: str, metric: str, *, target: float = 0.0) -> Iterator[Claim]:
    """A claim that the paper makes of every one of its variants."""
    for scheme in PAPER_SCHEMES:
        yield _claimed(f"{says}: {scheme}", metric, mine=(scheme,), target=target)


def _wanted(says: str, metric: str, target: float) -> Claim:
    """A goal of ours."""
    return Claim(
        source="goal", says=f"zsched: {says}", metric=metric, mine=("zsched",), theirs=FIXED_SCHEMES, target=target
    )


CLAIMS = (
    _claimed("throughput +40 % over fixed", "throughput_mb_s", target=0.40),
    _claimed("task latency -28 % against fixed, the variants' mean", "task_latency_s", target=-0.28),
    *_each("task latency -28 % against fixed", "task_latency_s", target=-0.28),
    _claimed("better map frequency than fixed", "map_hz"),
    _claimed(
        "map frequency: dyna_mem +20 % over the other variants",
        "map_hz",
        mine=("dyna_mem",),
        theirs=OTHER_DYNAMIC,
        target=0.20,
    ),
    _claimed("map frequency: dyna_mem over fixed", "map_hz", mine=("dyna_mem",)),
    *_each("better map accuracy than fixed", "ssim_rebased"),
    *(
        _claimed(f"best map accuracy: dyna_both over {other}", "ssim_rebased", mine=("dyna_both",), theirs=(other,))
        for other in ("dyna_cpu", "dyna_mem")
    ),
    _claimed("peaks of CPU are spread more evenly than under fixed", "cpu_peak_spread"),
    _claimed("CPU is spread more evenly than under fixed", "cpu_mean_spread"),
    _claimed("memory is balanced better than under fixed", "memory_mean_spread"),
    _wanted("throughput at least +40 % over fixed", "throughput_mb_s", target=0.40),
    _wanted("task latency at most -28 % against fixed", "task_latency_s", target=-0.28),
    _wanted("map frequency at least +20 % over fixed", "map_hz", target=0.20),
)
LESS_IS_BETTER = frozenset(
    {
        "task_latency_s",
        "cpu_peak",
        "cpu_peak_spread",
        "cpu_mean_spread",
        "memory_mean",
        "memory_peak",
        "memory_mean_spread",
        "regret",
        "gap_max_s",
        "merge_latency_p50_s",
        "merge_latency_p95_s",
        "merge_latency_p99_s",
        "moves",
        "wasted_moves",
        "stopped_ratio",
    }
)
SIX = ("cpu_peak", "memory_mean", "throughput_mb_s", "map_hz", "task_latency_s", "ssim_rebased")
"""The paper's six metrics, fleet-wide."""
LED = ("coverage_mean", "walls_mean", "stopped_ratio")
"""And of robots that SLAM on the edges leads: there a bad place costs coverage, and a robot stands."""
POINTS = frozenset({"stopped_ratio"})
"""Shares of the time that may be 0, compared by their difference (`points`)."""

GAINS = (
    "coverage_mean",
    "walls_mean",
    "throughput_mb_s",
    "received_mb_s",
    "map_hz",
    "task_latency_s",
    "merge_latency_p95_s",
    "served_ratio",
)
"""What a better place is to bring."""

# --- figures ---------------------------------------------------------------------------------------------------------


def shared(runs: Sequence[Json], *keys: str) -> list[Json]:
    """The runs whose number every group by ``keys`` has: means over them are of the same worlds and schedules."""
    numbers: dict[tuple[str, ...], set[int]] = {}
    for figures in runs:
        numbers.setdefault(tuple(str(figures[key]) for key in keys), set()).add(int(figures["run"]))
    common = set.intersection(*numbers.values()) if numbers else set()
    return [figures for figures in runs if int(figures["run"]) in common]


def table_of(runs: Sequence[Json], metric: str, schemes: Sequence[str]) -> dict[int, float]:
    """{run: mean of the schemes' figures}; only runs in which every one of the schemes has the figure."""
    found: dict[int, dict[str, float]] = {}
    for figures in runs:
        value = figures.get(metric)
        if figures["scheme"] in schemes and value is not None:
            found.setdefault(int(figures["run"]), {})[figures["scheme"]] = float(value)
    return {run: statistics.fmean(row.values()) for run, row in sorted(found.items()) if len(row) == len(schemes)}


def difference(mine: Mapping[int, float], theirs: Mapping[int, float]) -> Difference | None:
    """The relative difference of the means over the runs that both have; ``None`` without a run, or of nothing.

    With one run the interval is everything: nothing is known of the spread.
    """
    common = sorted(mine.keys() & theirs.keys())
    if not common:
        return None
    ours, others = [mine[run] for run in common], [theirs[run] for run in common]
    value = relative(ours, others)
    if value is None:
        return None
    half = half_width(ours, others)
    base = statistics.fmean(others)
    return Difference(
        value=value, low=value - half, high=value + half, runs=len(common), mine=statistics.fmean(ours), theirs=base
    )


def points(mine: Mapping[int, float], theirs: Mapping[int, float]) -> Difference | None:
    """How far shares of the time are apart, in shares of it, paired; ``None`` without a run that both have.

    For what may be 0 in every run: a ratio of nothing has no spread, however few runs there are.
    """
    common = sorted(mine.keys() & theirs.keys())
    if not common:
        return None
    apart = [mine[run] - theirs[run] for run in common]
    value, half = statistics.fmean(apart), interval(apart)
    half = math.inf if half is None else half
    ours, others = (statistics.fmean(table[run] for run in common) for table in (mine, theirs))
    return Difference(
        value=value, low=value - half, high=value + half, runs=len(common), mine=ours, theirs=others, is_points=True
    )


def interval(values: Sequence[float]) -> float | None:
    """Half of the 95 % interval of a mean (Student's t); ``None`` of one value.

    >>> interval([1.0]), round(interval([1.0, 2.0, 3.0]), 3)
    (None, 2.484)
    """
    if len(values) < 2:
        return None
    t = T_975[min(len(values) - 1, len(T_975)) - 1]
    return t * statistics.stdev(values) / math.sqrt(len(values))


def half_width(mine: Sequence[float], theirs: Sequence[float]) -> float:
    """Half of the 95 % interval of ``mean(mine) / mean(theirs)`` over pairs; infinite for one pair.

    With the ratio r, the residuals ``mine - r * theirs`` have the mean 0; their standard error over the base's mean is
    the ratio's (Cochran 1977, eq. 6.13), and t has n - 1 degrees of freedom.
    """
    count = len(mine)
    if count < 2:
        return math.inf
    base = statistics.fmean(theirs)
    ratio = statistics.fmean(mine) / base
    residuals = [ours - ratio * other for ours, other in zip(mine, theirs, strict=True)]
    error = statistics.stdev(residuals, 0.0) / math.sqrt(count)
    return T_975[min(count - 1, len(T_975)) - 1] * error / abs(base)


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


def over(runs: Sequence[Json], scheme: str, others: Sequence[str] = FIXED_SCHEMES) -> dict[str, Difference]:
    """{metric: difference} of a scheme to the mean of the others (the fixed ones), where all were run often enough."""
    found = {metric: difference(table_of(runs, metric, (scheme,)), table_of(runs, metric, others)) for metric in GAINS}
    return {metric: one for metric, one in found.items() if one is not None and one.runs >= LEAST_RUNS}


def best_fixed(runs: Sequence[Json], metric: str) -> str | None:
    """The fixed scheme with the best mean of a figure, as known in hindsight; ``None`` where one is missing."""
    tables = {scheme: table_of(runs, metric, (scheme,)) for scheme in FIXED_SCHEMES}
    common = set.intersection(*(set(table) for table in tables.values()))
    if not common:
        return None
    sign = -1.0 if metric in LESS_IS_BETTER else 1.0
    return max(FIXED_SCHEMES, key=lambda name: sign * statistics.fmean(tables[name][run] for run in common))


def one_by_one(runs: Sequence[Json], scheme: str = "zsched") -> tuple[str, ...]:
    """The schemes that were run and that one is compared with singly.

    The fixed ones stand among them only where not all were run: then they have no mean.
    """
    run = {figures["scheme"] for figures in runs}
    left_out = {scheme, *(FIXED_SCHEMES if run.issuperset(FIXED_SCHEMES) else ())}
    return tuple(name for name in SCHEMES if name in run and name not in left_out)


def over_best_fixed(runs: Sequence[Json], scheme: str) -> dict[str, Difference]:
    """{metric: difference} of a scheme to the best fixed one of each figure, where both were run often enough."""
    best = {metric: name for metric in GAINS if (name := best_fixed(runs, metric)) is not None}
    found = {
        metric: difference(table_of(runs, metric, (scheme,)), table_of(runs, metric, (name,)))
        for metric, name in best.items()
    }
    return {metric: one for metric, one in found.items() if one is not None and one.runs >= LEAST_RUNS}


def led(runs: Sequence[Json]) -> list[Json]:
    """The runs whose robots SLAM on the edges led."""
    return [figures for figures in runs if figures.get("stopped_ratio") is not None]


def compared(runs: Sequence[Json]) -> tuple[str, ...]:
    """The metrics on which no scheme of the paper is to be better than ours: the six, and what led robots add."""
    return (*SIX, *LED) if led(runs) else SIX


def declared(
    runs: Sequence[Json], metric: str = "coverage_mean", scheme: str = "zsched"
) -> list[tuple[str, Difference]]:
    """(against whom, difference) of a scheme's coverage on the way, of led robots: as declared before their runs.

    Against the mean of the fixed schemes and the best of them as known afterwards, or each of them where not all were
    run, and every other scheme that was run; zsched against ``zsched_slam`` stands with the latter, whose question it
    is. ``metric``: another figure to compare them by.
    """
    own = led(runs)
    best = best_fixed(own, metric)
    against: dict[str, tuple[str, ...]] = {"the mean of the fixed schemes": FIXED_SCHEMES}
    against |= {} if best is None else {f"the best fixed one, {best}": (best,)}
    is_base = not SCHEMES[scheme].moves_slam
    against |= {
        name: (name,) for name in one_by_one(own, scheme) if not (is_base and SCHEMES[name].family is Family.OURS)
    }
    mine = table_of(own, metric, (scheme,))
    found = [(name, difference(mine, table_of(own, metric, schemes))) for name, schemes in against.items()]
    return [(name, one) for name, one in found if one is not None]


def better_than_ours(runs: Sequence[Json]) -> list[tuple[str, str, Difference]]:
    """(scheme, metric, difference) where one of the paper's beats ours beyond the interval, on what is `compared`."""
    found = []
    for scheme in (*FIXED_SCHEMES, *PAPER_SCHEMES, "dyna_net"):
        for metric in compared(runs):
            apart = points if metric in POINTS else difference
            one = apart(table_of(runs, metric, (scheme,)), table_of(runs, metric, ("zsched",)))
            if one is None or one.runs < LEAST_RUNS:
                continue
            is_better = one.high < 0.0 if metric in LESS_IS_BETTER else one.low > 0.0
            if is_better:
                found.append((scheme, metric, one))
    return found
