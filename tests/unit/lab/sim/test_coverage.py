"""The table of branches, and that branches are counted at all: the whole command runs for minutes."""

from __future__ import annotations

from pathlib import Path

import pytest

from zsched_lab.sim.coverage import File, merge, reached, table, watch

ROOT = Path(__file__).parents[4]


def test_table_sums_up_and_names_what_nobody_has_gone() -> None:
    files = [
        File(
            name="a.py",
            all=frozenset({(1, 2), (1, 3), (9, -8)}),
            by_simulator=frozenset({(1, 2)}),
            by_tests=frozenset({(1, 2)}),
        ),
        File(name="b.py", all=frozenset({(4, 5)}), by_simulator=frozenset(), by_tests=frozenset({(4, 5)})),
    ]
    rows = table(files).splitlines()
    assert [row.split() for row in rows[1:4]] == [
        ["a.py", "3", "1", "1", "2"],
        ["b.py", "1", "0", "1", "0"],
        ["all", "4", "1", "2", "2"],
    ]
    assert rows[4:] == ["  a.py: 1 -> 3, 9 -> the end", "2 branches are reached by neither"]


def test_branches_of_what_was_run_are_told_apart_from_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("coverage", reason="an environment from before the dev extra had coverage.py")
    monkeypatch.chdir(ROOT)
    watch(["pytest", "-q", "-p", "no:cacheprovider", "tests/unit/core/scheduler/test_fuse.py"], tmp_path / "tests.0")
    gone, left = reached(merge(tmp_path, "tests"))["zsched/core/scheduler/fuse.py"]
    assert gone
    assert not gone & left
