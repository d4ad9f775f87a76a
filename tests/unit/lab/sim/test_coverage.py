"""The table of branches, and that branches are counted at all: the whole command runs for minutes."""

from __future__ import annotations

from pathlib import Path

import pytest

from zsched_lab.sim.coverage import merge, reached, watch

ROOT = Path(__file__).parents[4]


def test_branches_of_what_was_run_are_told_apart_from_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("coverage", reason="an environment from before the dev extra had coverage.py")
    monkeypatch.chdir(ROOT)
    watch(["pytest", "-q", "-p", "no:cacheprovider", "tests/unit/core/scheduler/test_fuse.py"], tmp_path / "tests.0")
    gone, left = reached(merge(tmp_path, "tests"))["zsched/core/scheduler/fuse.py"]
    assert gone
    assert not gone & left
