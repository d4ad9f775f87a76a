"""The short form of a status: ten lines for six nodes, rates, wall times, and drops that are over."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import pytest

from zsched.commands.base.report import render_brief

RECORDED = Path(__file__).parent / "recorded_status"
NOON = time.mktime((2026, 3, 4, 12, 0, 0, 0, 0, -1))


def recorded(name: str) -> dict[str, Any]:
    status: dict[str, Any] = json.loads((RECORDED / f"{name}.json").read_text())
    return status


def last_row(status: dict[str, Any], at: float | None = None) -> str:
    """The only task's row."""
    lines = render_brief(status, 100, color=False, at=at).splitlines()
    return next(line for line in lines if line.startswith("echo "))


def test_six_nodes_and_a_task_take_ten_lines() -> None:
    status = recorded("healthy")
    status["nodes"].append({**status["nodes"][-1], "name": "robot4"})
    lines = render_brief(status, 80, color=False).splitlines()
    assert len(lines) == 10
    assert [line.split()[0] for line in lines[1:]] == [
        *("NODE", "edge1", "edge2", "robot1*", "robot2", "robot3", "robot4", "TASK", "echo")
    ]


@pytest.mark.parametrize("width", [60, 80, 100, 160])
@pytest.mark.parametrize("name", ["healthy", "edge", "degraded"])
def test_no_line_is_longer_than_the_terminal(name: str, width: int) -> None:
    status = recorded(name)
    status["problems"] = ["a problem told at length " * 8]
    assert max(map(len, render_brief(status, width, color=False, at=NOON).splitlines())) <= width


def test_missed_samples_are_counted_whatever_became_of_them_and_what_a_rule_wants_is_none() -> None:
    status = recorded("healthy")
    stream = status["tasks"][0]["streams"][0]
    stream["drops"] = dict.fromkeys(("cut", "loop", "retried", "superseded", "thinned", "uncounted"), 9)
    assert last_row(status).endswith(" -")
    stream |= {"drops": {"overflow": 3, "thinned": 9}, "lost": 2, "at_most_lost": 100, "dropped_s": 59.0}
    assert last_row(status).endswith(" 105")
    stream["dropped_s"] = 185.0
    assert last_row(status).endswith(" 105 (none in the last minute)")
    stream["dropped_s"] = None
    assert last_row(status).endswith(" 105 (none since the daemon's start)")


def test_who_is_not_let_in_is_told_and_is_no_problem() -> None:
    status = recorded("healthy")
    status["refused"] = ["robot9 dials with a key that is revoked"]
    told = render_brief(status, 100, color=False)
    assert "refused    robot9 dials with a key that is revoked\n" in told
    assert told.splitlines()[0].endswith(" ok")


def test_long_names_can_be_told_apart_and_keep_their_marks() -> None:
    """Of twelve robots of one hall one row was red, and no row said which robot it was."""
    status = recorded("healthy")
    names = [f"warehouse-north-robot-{number:02}" for number in range(len(status["nodes"]))]
    for node, name in zip(status["nodes"], names, strict=True):
        node["name"] = name
    status["node"] = names[0]
    status["tasks"][0] |= {"owner": names[1], "pin": {"node": names[1], "by": "ana@lab", "reason": "", "known_s": 3.0}}
    status["tasks"][0]["pin"] |= {"for_s": None, "is_hard": False}
    for width, head in ((160, "warehouse"), (80, "…")):
        rows = render_brief(status, width, color=False).splitlines()
        first = [row.split()[0] for row in rows[2 : 2 + len(names)]]
        assert [one.rstrip("*")[-9:] for one in first] == [name[-9:] for name in names]
        assert all(one.startswith(head) for one in first)
        assert first[0].endswith("*")
        assert any("-01 (pin)" in row for row in rows)
