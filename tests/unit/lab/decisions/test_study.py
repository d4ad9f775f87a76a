"""Experiments: resuming, seeds that are kept apart, tables and pictures from real (short) results."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import pytest

from zsched_lab.decisions import __main__ as package
from zsched_lab.decisions import study

ONLY = frozenset({"zsched", "argmax", "fixed_e1"})
CASES = tuple(case for case in study.compared((3,)) if case.name in ("long", "step"))


def played(out: Path, hours: float, seeds: range = study.TEST) -> list[str]:
    short = tuple(case if case.name == "step" else replace(case, hours=0.04) for case in CASES)
    return list(study.play(short, hours, seeds, out, ONLY))


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("study") / "results-test.ndjson"
    assert len(played(out, 0.08)) == 3, "two of long, one of step"
    return out


def test_a_later_run_goes_on_where_the_earlier_one_ended(results: Path, tmp_path: Path) -> None:
    assert played(results, 0.08) == []
    copy = tmp_path / "cut.ndjson"
    lines = results.read_text().splitlines()
    copy.write_text("\n".join(lines) + '\n{"case": "long", "se')  # a run that was killed while it wrote
    assert len(study.read(copy)) == len(lines)


def test_a_later_run_plays_the_rules_that_are_missing_and_no_other(results: Path, tmp_path: Path) -> None:
    """A history counted as played when one rule of it was: after `--only` the others were never played there."""
    copy = tmp_path / "some.ndjson"
    lines = results.read_text().splitlines()
    copy.write_text("\n".join(line for line in lines if '"argmax"' not in line) + '\n{"case": "long", "se')
    assert len(played(copy, 0.08)) == 3
    rows, before = study.read(copy), study.read(results)
    assert sorted(rows, key=str) == sorted(before, key=str)
    assert played(copy, 0.08) == []


def test_every_rule_and_the_oracle_have_a_line_for_every_history(results: Path) -> None:
    rows = study.read(results)
    found = {(row["case"], row["seed"], row["rule"]) for row in rows}
    names = ONLY | {"oracle"}
    assert found == {
        (case, seed, name) for case, seed in (("long", 1001), ("long", 1002), ("step", 1001)) for name in names
    }
    assert all(float(row["regret"]) >= -1e-9 for row in rows), "nobody beats the oracle"


def test_seeds_for_choosing_and_for_checking_are_different() -> None:
    assert not set(study.TRAIN) & set(study.TEST)


def test_the_command_refuses_to_mix_results_unless_told_to_resume(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "results-test.ndjson").write_text("")
    command = ["zsched_lab.decisions", "--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", command)
    with pytest.raises(SystemExit, match="--resume"):
        package.main()
    monkeypatch.setattr(sys, "argv", [*command, "--parts", "nonsense"])
    with pytest.raises(SystemExit, match="2"):
        package.main()
