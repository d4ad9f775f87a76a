"""`zsched bench paper --report` of a published results.json, whose runs' files are not there."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from zsched.core.values.exits import EXIT_USAGE
from zsched_lab.paper.bench import BenchOptions, run_bench
from zsched_lab.paper.places import robots_scenario_path, scenario_path
from zsched_lab.paper.published import RESULTS, made_by

PUBLISHED = Path(__file__).parents[4] / "docs" / "evaluation"


def reported(out: Path) -> int:
    return run_bench(
        BenchOptions(out=out, scenario=scenario_path(), robots_scenario=robots_scenario_path(), is_report=True)
    )


def copied(name: str, out: Path) -> Path:
    out.mkdir()
    return Path(shutil.copy(PUBLISHED / name, out / RESULTS))


def test_what_is_published_is_reported_with_what_made_it_whatever_the_other_options(tmp_path: Path) -> None:
    results = copied("heavy-calm.json", tmp_path / "out")
    before = results.read_bytes()
    told = json.loads(before)
    assert reported(tmp_path / "out") == 0
    assert results.read_bytes() == before
    text = (tmp_path / "out" / "report.md").read_text(encoding="utf-8")
    assert f"zsched {told['version']}, {told['machine']}" in text, "not who reports it"
    assert f"{len(told['runs'])} runs that count" in text
    assert (tmp_path / "out" / "gains.png").stat().st_size > 10_000
    assert sorted(path.name for path in (tmp_path / "out").glob("*.json")) == [RESULTS], "nothing was begun"
    assert reported(tmp_path / "out") == 0, "and again"


def test_older_figures_stand_as_they_were(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    copied("heavy-oracle.json", tmp_path / "out")
    assert reported(tmp_path / "out") == 0
    assert "figures by definitions 5, today's are 6" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("{", "is no results.json of `zsched bench paper` (JSONDecodeError"),
        ("[]", "is no results.json of `zsched bench paper` (TypeError"),
        ('{"runs": []}', "it has no runs"),
        ('{"runs": [{"definitions": 1}]}', "is missing: only the version that made them can report them"),
        (None, "neither runs of `zsched bench paper` nor a results.json"),
    ],
)
def test_what_cannot_be_reported_says_why(
    text: str | None, says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if text is not None:
        (tmp_path / RESULTS).write_text(text, encoding="utf-8")
    assert reported(tmp_path) == EXIT_USAGE
    assert says in capsys.readouterr().err


def test_the_versions_are_those_of_the_runs() -> None:
    assert made_by([{"version": "2"}, {"version": "1"}, {"version": None}, {}], "version") == "1, 2"
    assert made_by([{}], "version") == ""
