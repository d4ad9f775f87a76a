"""Shares of the long tests: each long test is in one of them, and no other test is left out."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
FILES = [f"tests/{name}.py" for name in "hdbgfeac"]


def test_of_two_files_with_long_tests_a_share_of_two_leaves_those_of_one_out() -> None:
    """The others of its tests stay."""
    files = ["tests/sim/test_rest.py", "tests/unit/core/test_node_prefixes.py"]
    seen = {share: collected(*files, *([f"--long-share={share}"] if share else [])) for share in ("", "0/2", "1/2")}
    long = collected(*files, "-m", "long")
    assert {name.partition("::")[0] for name in long} == set(files), "else the test shows nothing"
    assert seen["0/2"] | seen["1/2"] == seen[""]
    assert seen["0/2"] & seen["1/2"] == seen[""] - long
    assert {name.partition("::")[0] for name in seen["0/2"] & long} == {files[0]}


def collected(*words: str) -> set[str]:
    """The tests that pytest would run."""
    command = [sys.executable, "-m", "pytest", "--collect-only", "-q", "-p", "no:cacheprovider", *words]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60, check=True)
    return {line for line in done.stdout.splitlines() if "::" in line}
