"""What `make` would run."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
OF_THE_MAKE_THAT_RUNS_US = ("MAKEFLAGS", "MAKEOVERRIDES", "MFLAGS", "MAKELEVEL", "LONG", "MARK")
"""Which tests are run now is no matter of what is planned here."""


def planned(folder: Path, *programs: str, target: str = "image", words: tuple[str, ...] = ()) -> str:
    """The commands of a target on a machine that has these programs."""
    make = shutil.which("make")
    if make is None:
        pytest.skip("no make here")
    for name in programs:
        (folder / name).write_text("#!/bin/sh\n")
        (folder / name).chmod(0o755)
    command = [make, "--dry-run", "--always-make", target, *words]
    env = {name: value for name, value in os.environ.items() if name not in OF_THE_MAKE_THAT_RUNS_US}
    env |= {"PATH": f"{folder}:/nowhere", "SHELL": "/bin/sh"}
    done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, timeout=60, check=True)
    return done.stdout


def test_a_share_of_the_long_tests_is_a_word_of_every_pytest(tmp_path: Path) -> None:
    """As `.ci/run` says it; without it `make test-all` runs all."""
    told = [planned(tmp_path, target="test-all", words=words) for words in ((), ("LONG=1/3",))]
    lines = [[line for line in one.splitlines() if "-m pytest" in line] for one in told]
    assert [len(one) for one in lines] == [3, 3]
    assert not any("--long-share" in line for line in lines[0])
    assert all("--long-share=1/3" in line for line in lines[1])
