from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from zsched.cli import app

SCENARIO = """
name: small
fleet: fleet.yaml
duration_s: 20
seed: 5
runs: 1
level: one
levels: {one: {}}
"""


@pytest.mark.parametrize(
    ("arguments", "code", "told"),
    [
        (["--schemes", "nonsense"], 78, "nonsense"),
        (["--schemes", ","], 2, "--schemes"),
        (["--input", "explore", "--log", "x.log"], 2, "--log"),
        (["--scenario", "absent.yml"], 78, "absent.yml"),
        (["--runs", "0"], 2, "--runs"),
        (["--log", "absent.log"], 78, "absent.log"),
        (["--report"], 2, "--out"),
    ],
)
def test_wrong_arguments_are_told_before_anything_starts(
    tmp_path: Path, arguments: list[str], code: int, told: str
) -> None:
    result = CliRunner().invoke(app, ["bench", "paper", "--out", str(tmp_path / "out"), *arguments])

    assert result.exit_code == code
    assert told in result.stderr


def test_a_folder_with_something_in_it_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("kept")

    result = CliRunner().invoke(app, ["bench", "paper", "--out", str(tmp_path), "--quick"])

    assert result.exit_code == 2
    assert "--resume" in result.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


def test_a_damaged_scenario_is_told_with_its_file(tmp_path: Path) -> None:
    path = tmp_path / "scenario.yml"
    path.write_text(SCENARIO.replace("level: one", "level: two"))

    result = CliRunner().invoke(app, ["bench", "paper", "--scenario", str(path), "--out", str(tmp_path / "out")])

    assert result.exit_code == 78
    assert "scenario.yml" in result.stderr
    assert not (tmp_path / "out").exists()
