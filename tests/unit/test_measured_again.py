"""Whose measured time was too long is run again, three times in all; nothing else is."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

TESTS = Path(__file__).parent.parent
CASES = """
from pathlib import Path
import pytest
from support.waiting import within

def runs(name):
    path = Path(__file__).with_name(name)
    path.write_text((path.read_text() if path.exists() else "") + "x")
    return len(path.read_text())

@pytest.fixture
def fresh(tmp_path):
    assert not list(tmp_path.iterdir())
    (tmp_path / "used").touch()

def test_once_slow(fresh):
    within(5.0 if runs("once") < 2 else 1.0, 2.0)

def test_always_slow(fresh):
    runs("always")
    within(5.0, 2.0)

def test_wrong():
    runs("wrong")
    assert False
"""


def test_only_what_was_too_slow_is_run_again(tmp_path: Path) -> None:
    (tmp_path / "test_cases.py").write_text(CASES)
    shutil.copy(TESTS / "conftest.py", tmp_path)
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        "-c",
        str(TESTS.parent / "pyproject.toml"),
    ]
    done = subprocess.run(
        [*command, "--rootdir", tmp_path, tmp_path],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert "2 failed, 1 passed, 3 rerun" in done.stdout, done.stdout
    assert done.stdout.count("RERUN ") == 3, "each is named"
    assert {name: len((tmp_path / name).read_text()) for name in ("once", "always", "wrong")} == {
        "once": 2,
        "always": 3,
        "wrong": 1,
    }
