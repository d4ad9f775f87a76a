"""`support.tools`: what to install for skipped tests is the last thing that pytest says."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from support.tools import PACKAGES, to_install

TESTS = Path(__file__).parents[1]


@pytest.mark.parametrize("is_skipped", [True, False])
def test_behind_skipped_tests_stands_one_command_that_installs_what_is_missing(
    tmp_path: Path, *, is_skipped: bool
) -> None:
    shutil.copy(TESTS / "conftest.py", tmp_path)
    (tmp_path / "pytest.ini").write_text("[pytest]\n")
    (tmp_path / "test_it.py").write_text(
        f"import pytest\n\n\n@pytest.mark.skipif({is_skipped}, reason='x')\ndef test_it(): pass\n"
    )
    env = {**os.environ, "PATH": str(tmp_path), "PYTHONPATH": str(TESTS)}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "test_it.py"]
    done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stdout
    wanted = f"sudo apt-get install {' '.join(PACKAGES.values())}"
    assert (wanted in done.stdout) is is_skipped, done.stdout


def test_what_is_there_is_not_to_be_installed() -> None:
    assert to_install({("sh",): "dash", ("no-such-program", "sh"): "none"}) == ""
