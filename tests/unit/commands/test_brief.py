"""The short form of a status: ten lines for six nodes, rates, wall times, and drops that are over."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import pytest

from zsched.commands.base.page import clock_time
from zsched.commands.base.report import render_brief, render_status

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


def test_a_fleet_without_tasks_says_so_and_how_it_gets_one() -> None:
    lines = render_brief({**recorded("healthy"), "tasks": []}, 60, color=False).splitlines()
    assert lines[-1].split()[:3] == ["TASK", "none", "yet;"]
    assert "`zsched task add FILE`" in lines[-1]


@pytest.mark.parametrize("width", [60, 80, 100, 160])
@pytest.mark.parametrize("name", ["healthy", "edge", "degraded"])
def test_no_line_is_longer_than_the_terminal(name: str, width: int) -> None:
    status = recorded(name)
    status["problems"] = ["a problem told at length " * 8]
    assert max(map(len, render_brief(status, width, color=False, at=NOON).splitlines())) <= width


def test_problems_stand_below_in_the_short_form_too() -> None:
    assert "PROBLEMS   no quorum: 1 of 3" in render_brief(recorded("degraded"), 100, color=False)


def test_a_task_s_rates_are_sums_over_its_streams_and_unknown_without_counts() -> None:
    status = recorded("healthy")
    assert last_row(status).split()[-3:] == ["-", "-", "-"]
    for stream in status["tasks"][0]["streams"]:
        stream["hz"] = 49.96 if "/in/" in stream["stream"] else 0.0
    assert last_row(status).split()[-3:] == ["50.0/s", "0/s", "-"]


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


def test_wall_times_stand_beside_ages_where_the_clock_is_given() -> None:
    status = recorded("healthy")
    status["tasks"][0]["since_s"] = 61.0
    assert "1m01s 11:58:59" in last_row(status, NOON)
    assert ":59" not in last_row(status)
    before = {**status, "tasks": [{**status["tasks"][0], "since_s": 36_300.0 + 4 * 3600}]}
    assert "14h 03-03 21:55 " in last_row(before, NOON), "of another day: the date, and the age in short"
    status["tasks"][0]["history"][-1]["age_s"] = 90000.0
    whole = render_status(status, 120, color=False, at=NOON)
    assert "known here for 1m01s, since 11:58:59" in whole
    assert "1d01h ago, 03-03 11:00  epoch" in whole


def test_a_moment_of_another_day_has_its_date() -> None:
    assert clock_time(NOON - 3600, NOON) == "11:00:00"
    assert clock_time(NOON - 86400, NOON) == "03-03 12:00"


def test_frames_that_were_dropped_more_than_a_minute_ago_are_not_shown() -> None:
    status = recorded("healthy")
    status["counters"] = {"dropped_data_link_stranger": 3, "dropped_beat_stale": 2}
    assert "dropped    data_link_stranger 3 · beat_stale 2\n" in render_brief(status, 100, color=False)
    status["dropped_ages"] = {"dropped_data_link_stranger": 61.0, "dropped_beat_stale": 59.0}
    assert "dropped    beat_stale 2\n" in render_brief(status, 100, color=False)
    status["dropped_ages"]["dropped_beat_stale"] = 61.0
    assert "dropped" not in render_brief(status, 100, color=False)


def test_who_is_not_let_in_is_told_and_is_no_problem() -> None:
    status = recorded("healthy")
    status["refused"] = ["robot9 dials with a key that is revoked"]
    told = render_brief(status, 100, color=False)
    assert "refused    robot9 dials with a key that is revoked\n" in told
    assert told.splitlines()[0].endswith(" ok")


def test_the_first_line_tells_the_revision_of_an_agreed_document_only() -> None:
    status = recorded("healthy")
    assert "revision" not in render_brief(status, 120, color=False).splitlines()[0]
    told = {**status, "document": "ab12" * 8, "fleet_revision": 7}
    assert " · revision 7 · up " in render_brief(told, 120, color=False).splitlines()[0]
    assert "revision" not in render_brief({**told, "document": ""}, 120, color=False).splitlines()[0]


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
