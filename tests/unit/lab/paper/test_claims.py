from __future__ import annotations

import math
from typing import Any

import pytest

from zsched_lab.paper.claims import (
    CLAIMS,
    Claim,
    Difference,
    Verdict,
    better_than_ours,
    difference,
    judged,
    relative,
    shared,
    table_of,
    verdict,
)
from zsched_lab.paper.schemes import FIXED_SCHEMES, PAPER_SCHEMES, SCHEMES

HIGHER = Claim(source="paper", says="x", metric="map_hz", mine=("a",), theirs=("b",), target=0.2)
LOWER = Claim(source="paper", says="x", metric="task_latency_s", mine=("a",), theirs=("b",), target=-0.28)
FIGURES = {
    "map_hz": 2.0, "throughput_mb_s": 10.0, "task_latency_s": 30.0,
    "merge_latency_p50_s": 0.2, "merge_latency_p95_s": 0.5, "merge_latency_p99_s": 0.7,
    "cpu_peak": 0.9, "cpu_mean": 0.5, "memory_mean": 0.4, "memory_peak": 0.6,
    "cpu_peak_spread": 0.2, "cpu_mean_spread": 0.4, "memory_mean_spread": 0.2,
    "ssim_rebased": 0.3, "held_ssim_rebased": 0.1, "wall_f1": 0.9, "coverage": 0.95, "ssim_crop": 0.8,
    "moves": 2, "wasted_moves": 0, "move_gap_mean_s": 0.4, "move_gap_max_s": 0.6, "lost_per_move": 0.5, "regret": 0.1,
}  # fmt: skip


def a_run(scheme: str, run: int, level: str = "one", **changed: Any) -> dict[str, Any]:
    node = {"cpu_peak": 0.9, "memory_mean": 0.4, "memory_peak": 0.6, "throughput_mb_s": 3.0}
    host = {"pressure": 0.05, "idle_ratio": 0.4}
    nodes = {"edge1": node, "edge2": node | {"cpu_peak": None}}
    return {
        "scheme": scheme,
        "run": run,
        "level": level,
        "host": host,
        "links": "simulated",
        "nodes": nodes,
        **FIGURES,
        **changed,
    }


def test_one_run_has_no_interval_to_tell() -> None:
    found = difference({1: 1.12}, {1: 1.0})
    assert found is not None
    assert found.text() == "+12 % (n = 1)"
    both = difference({1: 1.12, 2: 1.10}, {1: 1.0, 2: 1.0})
    assert both is not None
    assert both.text().startswith("+11 % [")


def test_the_difference_is_paired_and_its_interval_holds_the_mean() -> None:
    theirs = {0: 1.0, 1: 2.0, 2: 3.0, 3: 4.0, 9: 100.0}
    mine = {run: value * 1.3 for run, value in theirs.items() if run != 9}

    found = difference(mine, theirs)

    assert found is not None
    assert (found.value, found.low, found.high) == pytest.approx((0.3, 0.3, 0.3))  # run by run the same ratio
    assert found.runs == 4
    assert found.text() == "+30 % [+30, +30]"


def test_the_interval_by_hand() -> None:
    # Means 3 and 2, ratio 1.5; residuals 0, 1, -1 with s = 1; t(2) = 4.303: 4.303 * 1 / sqrt(3) / 2 = 1.2422.
    found = difference({0: 3.0, 1: 4.0, 2: 2.0}, dict.fromkeys(range(3), 2.0))

    assert found is not None
    assert (found.mine, found.theirs, found.value) == pytest.approx((3.0, 2.0, 0.5))
    assert (found.low, found.high) == pytest.approx((0.5 - 1.2422, 0.5 + 1.2422), abs=1e-4)
    # Pairs cancel what they share: mine = theirs + 1 is no noise but a little of the ratio's.
    paired = difference({0: 2.0, 1: 3.0, 2: 4.0}, {0: 1.0, 1: 2.0, 2: 3.0})
    assert paired is not None
    # Ratio 1.5; residuals 0.5, 0, -0.5 with s = 0.5; 4.303 * 0.5 / sqrt(3) / 2 = 0.6211.
    assert (paired.value, paired.high - paired.value) == pytest.approx((0.5, 0.6211), abs=1e-4)


def test_noise_widens_the_interval() -> None:
    found = difference({0: 1.0, 1: 3.0, 2: 1.0, 3: 3.0}, dict.fromkeys(range(4), 2.0))

    assert found is not None
    assert found.low < 0.0 < found.high
    assert difference({}, {0: 1.0}) is None
    assert difference({0: 1.0}, {0: 0.0}) is None
    single = difference({0: 2.0}, {0: 1.0})
    assert single is not None
    assert single.high == math.inf  # of one run nothing is known
    assert relative([-1.0], [-2.0]) == pytest.approx(0.5)  # better, though both are under nothing


@pytest.mark.parametrize(
    ("claim", "value", "low", "high", "expected"),
    [
        (HIGHER, 0.30, 0.25, 0.35, Verdict.EXCEEDED),
        (HIGHER, 0.22, 0.05, 0.30, Verdict.REPRODUCED),
        (HIGHER, 0.15, 0.10, 0.20, Verdict.NOT_REPRODUCED),
        (HIGHER, 0.30, -0.1, 0.70, Verdict.NOT_REPRODUCED),
        (LOWER, -0.40, -0.50, -0.30, Verdict.EXCEEDED),
        (LOWER, -0.30, -0.40, -0.20, Verdict.REPRODUCED),
        (LOWER, 0.40, 0.30, 0.50, Verdict.NOT_REPRODUCED),
    ],
)
def test_verdicts(claim: Claim, value: float, low: float, high: float, expected: Verdict) -> None:
    assert verdict(claim, Difference(value=value, low=low, high=high, runs=5)) is expected
    assert verdict(claim, Difference(value=value, low=low, high=high, runs=2)) is Verdict.TOO_FEW
    assert verdict(claim, None) is Verdict.NOT_MEASURED


def test_a_run_in_which_a_scheme_is_missing_does_not_count() -> None:
    runs = [a_run("fixed_e1", 0, map_hz=1.0), a_run("fixed_e2", 0, map_hz=3.0), a_run("fixed_e1", 1, map_hz=9.0)]

    assert table_of(runs, "map_hz", ("fixed_e1", "fixed_e2")) == {0: 2.0}


def test_rows_are_compared_over_the_runs_that_all_have() -> None:
    runs = [a_run("zsched", run) for run in range(5)] + [a_run("random", run) for run in (1, 2)]

    assert [(figures["scheme"], figures["run"]) for figures in shared(runs, "scheme")] == [
        ("zsched", 1), ("zsched", 2), ("random", 1), ("random", 2),
    ]  # fmt: skip
    assert shared([], "scheme") == []


def test_claims_are_judged_by_the_schemes_they_speak_of() -> None:
    runs = [a_run(name, run, throughput_mb_s=10.0) for name in FIXED_SCHEMES for run in range(3)]
    runs += [a_run(name, run, throughput_mb_s=15.0) for name in PAPER_SCHEMES for run in range(3)]
    runs += [a_run("zsched", run, throughput_mb_s=11.0) for run in range(3)]
    verdicts = {claim.says: outcome for claim, _, outcome in judged(runs)}
    assert len(verdicts) == len(CLAIMS), "each has words of its own"

    assert verdicts["throughput +40 % over fixed"] is Verdict.EXCEEDED
    assert verdicts["zsched: throughput at least +40 % over fixed"] is Verdict.NOT_REPRODUCED
    assert {metric for _, metric, _ in better_than_ours(runs)} == {"throughput_mb_s"}
    assert {scheme for scheme, _, _ in better_than_ours(runs)} == set(PAPER_SCHEMES)
    assert all(set(claim.mine) | set(claim.theirs) <= set(SCHEMES) for claim in CLAIMS)
