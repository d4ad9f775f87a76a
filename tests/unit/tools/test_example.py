"""`zsched new`: what it writes, and that it overwrites nothing."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from zsched.cli import app
from zsched.config.load import check_file
from zsched.tools.example import EXAMPLES, Example, files_of

NAMES = ["README.md", "ask.py", "fleet.yaml", "worker.py"]


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.mark.parametrize("example", Example)
def test_an_example_is_written_whole_and_its_fleet_file_has_no_fault(tmp_path: Path, example: Example) -> None:
    folder = tmp_path / "new" / "task"
    result = run("new", example, folder)
    assert (result.exit_code, result.stdout.splitlines()) == (0, [str(folder / name) for name in NAMES])
    assert sorted(path.name for path in folder.iterdir()) == NAMES
    checked = check_file(folder / "fleet.yaml")
    assert (checked.faults, checked.warnings) == ((), ())
    assert checked.fleet is not None
    assert len(checked.fleet.nodes) == 3


def test_every_folder_of_examples_is_offered() -> None:
    assert {path.name for path in EXAMPLES.iterdir() if path.name != "__pycache__"} == {one.value for one in Example}


@pytest.mark.parametrize("is_link", [False, True])
def test_what_is_there_is_named_and_nothing_is_written(tmp_path: Path, is_link: bool) -> None:
    if is_link:
        (tmp_path / "worker.py").symlink_to(tmp_path / "nowhere")
    else:
        (tmp_path / "worker.py").write_text("mine")
    result = run("new", "python", tmp_path)
    assert result.exit_code == 1
    assert "has worker.py already" in result.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["worker.py"]
    assert is_link or (tmp_path / "worker.py").read_text() == "mine"


def test_the_application_is_the_same_for_both_zenoh_workers() -> None:
    assert files_of(Example.PYTHON)["ask.py"] == files_of(Example.ZENOH)["ask.py"]
