from __future__ import annotations

import json
import math
from pathlib import Path
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
    over,
    relative,
    shared,
    table_of,
    verdict,
)
from zsched_lab.paper.figures import save_all, save_gains, save_panels, save_radio
from zsched_lab.paper.remarks import ended_text, losses_text
from zsched_lab.paper.report import (
    blocks_parts,
    claims_text,
    gains_parts,
    groups_of,
    in_block,
    is_whole,
    judged_groups,
    main_runs,
    memory_text,
    others_text,
    radio_text,
    report,
)
from zsched_lab.paper.schemes import FIXED_SCHEMES, PAPER_SCHEMES, SCHEMES

EVALUATION = Path(__file__).parents[4] / "docs" / "evaluation"
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


def test_whether_memory_was_exhausted_is_judged_too() -> None:
    def with_peak(scheme: str, peak: float) -> dict[str, Any]:
        return a_run(scheme, 0, nodes={"edge1": {"memory_peak": peak}})

    both = [with_peak("fixed_e1", 0.5), with_peak("dyna_cpu", 0.6)]
    assert "variants 0.60, fixed 0.50. **reproduced** (but so it is under fixed placement)." in memory_text(both)
    assert memory_text([with_peak("fixed_e1", 0.97), with_peak("dyna_cpu", 0.6)]).endswith("**reproduced**.\n")
    assert memory_text([with_peak("dyna_mem", 0.96)]).endswith("**not reproduced**.\n")
    assert memory_text([]) == ""


def test_each_table_says_how_far_a_scheme_is_from_the_fixed_ones() -> None:
    runs = [a_run(name, run, map_hz=4.0 + run / 10) for name in FIXED_SCHEMES for run in range(3)]
    runs += [a_run("zsched", run, map_hz=5.0 + run / 8) for run in range(3)]
    runs += [a_run("random", run, map_hz=2.0) for run in range(2)]

    assert over(runs, "zsched")["map_hz"].value == pytest.approx(0.25)
    assert over(runs, "random") == {}, "two runs say nothing"
    text = "\n".join(gains_parts({"scenario": {"level": "one"}, "runs": runs}, ["gains.png"]))
    assert "| where | scheme | runs | MB/s | maps/s | task s | p95 s |" in text
    assert "+25 % [+25, +25]" in text
    assert "| matrix (one) | 3 |" in text, "against the best one"
    assert "![gains.png](gains.png)" in text
    assert "random" not in text
    assert others_text(runs) == "", "zsched is in the table of gains, and two runs of random say nothing"
    runs += [a_run("random", 2, map_hz=2.0)]
    assert "| random | 3 |" in others_text(runs)


def test_what_was_dropped_stands_beside_what_was_lost_by_reason() -> None:
    runs = [a_run("zsched", 0, lost=1, dropped=4, drops={"cut": 3, "overflow": 1})]
    runs += [a_run("zsched", 1, lost=0, dropped=6, drops={"cut": 6}), a_run("fixed_e1", 0, lost=0, dropped=0, drops={})]
    runs += [a_run("dyna_both", 0, lost=2, dropped=3)]  # of before reasons were kept
    text = losses_text({"matrix (one)": runs})

    assert "| matrix (one) | zsched | 2 | 4 | 1 | cut 9, overflow 1 |" in text
    assert "| matrix (one) | dyna_both | 1 | 2 | 2 | reason not kept 3 |" in text
    assert "fixed_e1" not in text
    assert losses_text({"matrix (one)": runs[2:3]}).endswith("\n\nNothing was lost or dropped.\n")
    results = json.loads((EVALUATION / "results.json").read_text(encoding="utf-8"))
    assert losses_text(groups_of(results)) in report(results, [])


@pytest.mark.parametrize(
    ("file", "told"),
    [
        ("results.json", "run 3 of fixed_e2 (19.6 s; *done* is 1.00)"),
        ("heavy-again.json", "run 7 of fixed_e2 (35.4 s; *done* is 0.88)"),
    ],
)
def test_a_run_that_ended_because_it_was_done_is_named_where_it_counts_as_not_done(file: str, told: str) -> None:
    results = json.loads((EVALUATION / file).read_text(encoding="utf-8"))
    runs = main_runs(results)
    said = ended_text(runs, results["scenario"])

    assert said.endswith(f": {told}.\n")
    longest = [{**one, "duration_s": results["scenario"]["duration_s"]} for one in runs]
    assert ended_text(longest, results["scenario"]) == "", "of those whose time was over nothing is known"


def a_block(name: str, schemes: tuple[str, ...], runs: int = 3) -> list[dict[str, Any]]:
    """Runs of a block in which zsched makes half as many maps again as the fixed schemes."""
    return [
        a_run(scheme, run, "four", block=name, map_hz=(6.0 if scheme == "zsched" else 4.0) + run / 10)
        for scheme in schemes
        for run in range(runs)
    ]


def test_the_report_says_where_placing_pays_and_judges_a_block_that_is_a_whole_matrix(tmp_path: Any) -> None:
    every = (*FIXED_SCHEMES, *PAPER_SCHEMES, "zsched")
    runs = a_block("heavy", every) + a_block("part", (*FIXED_SCHEMES, "zsched")) + a_block("thin", every, runs=2)
    results = {"scenario": {"level": "one", "blocks": {"heavy": {}, "part": {}, "thin": {}, "gone": {}}}, "runs": runs}

    text = "\n".join(gains_parts(results))
    assert "| heavy | zsched | 3 |" in text
    assert "+49 % [" in text
    assert "| part | zsched | 3 |" in text
    assert "matrix" not in text, "it was not run"
    assert "oracle |" not in text
    assert "thin" not in text, "two runs say nothing"
    assert gains_parts({**results, "runs": []}) == []

    assert is_whole(in_block(runs, "heavy"))
    assert not is_whole(in_block(runs, "part"))
    assert not is_whole(in_block(runs, "thin"))
    blocks: dict[str, Any] = {"heavy": {}, "part": {}}
    told = {"scenario": {"level": "one", "blocks": blocks, "merge": {}}, "runs": runs}
    shown = "\n".join(blocks_parts(told, ["heavy.png"]))
    assert "## Block heavy" in shown
    assert "![heavy.png](heavy.png)" in shown
    assert "## Block part" not in shown
    assert "| part | zsched | 3 |" in shown
    assert "| heavy | verdict |" in claims_text(judged_groups(told))
    assert "| part | verdict |" not in claims_text(judged_groups(told))
    row = next(line for line in claims_text(judged_groups(told)).splitlines() if "at least +20 % over fixed" in line)
    assert row.endswith("| - | **not measured** | +49 % [+46, +52] | **exceeded** |")

    groups = groups_of(results)
    assert save_gains(tmp_path / "gains.png", groups, "title") == "gains.png"
    assert save_panels(tmp_path / "heavy.png", groups["heavy"], "title") == "heavy.png"
    assert save_gains(tmp_path / "none.png", {"thin": groups["thin"]}, "title") is None
    assert {path.name for path in tmp_path.iterdir()} == {"gains.png", "heavy.png"}


def test_the_report_holds_every_claim_scheme_level_and_picture(tmp_path: Any) -> None:
    runs = [a_run(name, run) for name in ("fixed_e1", "zsched") for run in range(3)]
    runs += [a_run("random", 0)]
    runs += [a_run(name, 0, block="narrow", map_hz=7.5) for name in ("fixed_e1", "zsched")]
    runs += [a_run("zsched", 1, block="narrow", map_hz=99.0)]  # in another world than fixed_e1's
    runs += [a_run(name, 0, level="two", map_hz=2.5) for name in ("fixed_e1", "zsched")]
    node = {"cpu_cores": 0.3, "memory_mb": 512.0, "ballast_mb": 0.0}
    levels = {name: {"streams": 1, "share": 0.6, "side": 640} for name in ("one", "two")}
    scenario = {
        "name": "paper", "seed": 1, "level": "one", "levels": levels, "nodes": {"edge1": node},
        "merge": {"mode": "track", "rate_hz": 4.0, "resolution_m": 0.05}, "target_coverage": 0.8, "pressure_limit": 0.2,
        "blocks": {
            "narrow": {"world": None, "links": {"bandwidth_mbit": 9.8}},
            "gone": {"world": "turtlebot3", "links": {"bandwidth_mbit": None}},
        },
    }  # fmt: skip
    invalid = [{"cell": "one-zsched-1", "reason": "pressure 0.50\nmore"}]
    row = {"moves": 3, "wasted_moves": 0, "mean_dbm": -55.0, "under_best_db": 1.2, "below_70_ratio": 0.0}
    radio = {
        "links": "simulated", "duration_s": 60.0, "best_dbm": -53.8, "best_fixed_dbm": -57.0,
        "picture": "radio.png", "schemes": {"zsched": row},
    }  # fmt: skip
    results = {
        "scenario": scenario, "runs": runs, "invalid": invalid, "command": "zsched bench paper", "input": "log x",
        "version": "1", "machine": "2 cores", "radio": radio,
        "missing": ["one-random-3"], "skipped": {"gone": "no exploring robots"},
    }  # fmt: skip
    pictures = save_all(runs, "one", ("one", "two"), tmp_path, "title")
    pictures.append(
        save_radio(
            tmp_path / "radio.png", {"robot1": [(0.0, -50.0), (5.0, -60.0)]}, {"zsched": [(0.0, "robot1")]}, 60.0
        )
    )

    text = report(results, pictures)

    assert all(claim.says in text for claim in CLAIMS)
    assert "| zsched | 3 | 2.00 |" in text  # the matrix's, without the block's
    assert "| zsched | 1 | 7.50 |" in text
    assert "Where the numbers of runs differ, so do the worlds" in text
    assert "| narrow | zsched | 1 | 7.50 |" in text
    assert "every node sends at most 9.8 Mbit/s" in text
    assert "Left out: no exploring robots." in text
    assert "No valid run of 1 cells: one-random-3." in text
    assert "in any run: zsched 0.60, fixed 0.60." in text
    assert "plain SSIM" not in text, "results.json has it"
    assert "| maps/s | zsched | 2.00 | 2.50 |" in text
    assert "one-zsched-1: pressure 0.50" in text
    assert "-55.0" in text
    assert "strongest signal, says the paper: zsched: **reproduced**" in text
    lost = {**radio, "schemes": {"dyna_net": row | {"under_best_db": 1.6}, "zsched": row | {"mean_dbm": -57.5}}}
    assert radio_text(lost).count("**not reproduced**") == 2
    assert {"cpu.png", "memory.png", "throughput.png", "frequency.png", "latency.png", "ssim.png", "sweep.png"} <= set(
        pictures
    )
    for name in pictures:
        assert name in text
        assert (tmp_path / name).stat().st_size > 5000
    assert save_all([], "one", (), tmp_path, "title") == []
