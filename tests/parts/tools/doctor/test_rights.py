"""`zsched doctor` of a user who may not look where the service keeps its things: it says so, and blames nothing."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from support.clinic import FLEET
from support.rights import WITHOUT_RIGHTS


@pytest.fixture
def closed(tmp_path: Path) -> Path:
    """A folder into which its owner may not look either, with the service's folders in it."""
    (tmp_path / "fleet.yaml").write_text(FLEET, encoding="utf-8")
    for name in ("zsched", "run"):
        (tmp_path / "closed" / name).mkdir(parents=True)
    (tmp_path / "closed").chmod(0)
    return tmp_path / "closed"


def found(closed: Path, *words: str, node: str = "edge1", runtime: Path | None = None) -> dict[str, dict[str, Any]]:
    """{check: its result}."""
    asked = ("doctor", "--json", "--node", node, "--config", str(closed.parent / "fleet.yaml"), *words)
    folders = ("--state-dir", str(closed / "zsched"), "--runtime-dir", str(runtime or closed.parent))
    command = [*WITHOUT_RIGHTS, sys.executable, "-m", "zsched.cli", *asked, *folders]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert "Traceback" not in ended.stderr, ended.stderr
    return {one["id"]: one for one in json.loads(ended.stdout)["checks"]}


@pytest.mark.parametrize(("words", "node"), [((), "edge1"), (("--fleet",), "edge1"), (("--fleet",), "laptop")])
def test_a_state_folder_that_is_closed_is_passed_over(closed: Path, words: tuple[str, ...], node: str) -> None:
    told = found(closed, *words, node=node)
    assert [told[name]["verdict"] for name in ("state.valid", "state.fsync")] == ["SKIP", "SKIP"]
    assert [name for name, one in told.items() if "the check itself failed" in str(one)] == []


def test_a_runtime_folder_that_is_closed_does_not_mean_that_no_daemon_runs(closed: Path) -> None:
    told = found(closed, runtime=closed / "run")["daemon.answers"]
    assert told["verdict"] == "SKIP"
    assert "run the doctor as root" in str(told)
