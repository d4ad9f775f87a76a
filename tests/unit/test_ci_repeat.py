"""`.ci/repeat.py`: a test that fails once is repeated alone and named, one that fails twice is a failure."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

REPEAT = Path(__file__).parents[2] / ".ci" / "repeat.py"
FLAKY = """
from pathlib import Path

def test_fails_the_first_time():
    seen = Path("seen")
    was_there = seen.exists()
    seen.touch()
    assert was_there
"""


def run(folder: Path, source: str) -> tuple[int, str]:
    (folder / "test_it.py").write_text(source, encoding="utf-8")
    (folder / "pytest.ini").write_text("[pytest]\n", encoding="utf-8")
    command = [sys.executable, str(REPEAT), "-q", "test_it.py"]
    ended = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=60, check=False)
    return ended.returncode, ended.stdout


def test_a_test_that_passes_alone_is_flaky_and_the_run_goes_on(tmp_path: Path) -> None:
    code, told = run(tmp_path, FLAKY)
    assert code == 0
    assert told.splitlines()[-1] == "FLAKY: test_it.py::test_fails_the_first_time"


def test_a_test_that_fails_again_fails_the_run(tmp_path: Path) -> None:
    code, told = run(tmp_path, FLAKY + "\ndef test_wrong():\n    assert False\n")
    assert code == 1
    assert "FAILED twice: test_it.py::test_wrong" in told
    assert "FLAKY: test_it.py::test_fails_the_first_time" in told


def test_many_failures_are_not_repeated(tmp_path: Path) -> None:
    wrong = "".join(f"def test_{number}():\n    assert False\n\n" for number in range(13))
    code, told = run(tmp_path, wrong)
    assert code == 1
    assert "repeat" not in told
