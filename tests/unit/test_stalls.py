"""Below a red test with real processes stands how the machine was while it ran."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

TESTS = Path(__file__).parent.parent
CASES = """
def test_wrong():
    assert False

def test_right():
    pass
"""


def test_a_red_test_with_real_processes_has_it_and_no_other_one(tmp_path: Path) -> None:
    shutil.copy(TESTS / "conftest.py", tmp_path)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"]
    command += ["-c", str(TESTS.parent / "pyproject.toml"), "--rootdir", str(tmp_path), str(tmp_path)]
    for folder, times in (("system", 1), ("unit", 0)):
        case = tmp_path / "tests" / folder / "test_cases.py"
        case.parent.mkdir(parents=True)
        case.write_text(CASES)
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
        assert "1 failed, 1 passed" in done.stdout, done.stdout
        assert done.stdout.count(" The machine meanwhile ") == times, done.stdout
        case.unlink()
