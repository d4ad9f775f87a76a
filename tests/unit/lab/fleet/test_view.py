from __future__ import annotations

from typing import Any

import pytest

from zsched_lab.fleet.view import Move, merge_moves, node_views, past_allocations, task_view

KINDS = {"edge1": "edge", "edge2": "edge", "robot1": "robot"}


def a_status(**changes: Any) -> dict[str, Any]:
    status: dict[str, Any] = {
        "schema": "zsched.status/1",
        "nodes": [
            {"name": "robot1", "state": "alive", "cpu_ratio": 0.2, "links": [{"source": "wired"}], "workers": []},
            {
                "name": "edge1",
                "state": "suspect",
                "cpu_ratio": 0.9,
                "memory_ratio": None,
                "links": [{"source": "fixed", "rssi_dbm": -61.2}, {"source": "fixed", "rssi_dbm": -70.0}],
                "workers": [{"task": "map_merge", "state": "ready"}],
            },
        ],
        "tasks": [
            {
                "name": "map_merge",
                "owner": "edge1",
                "epoch": 2,
                "since_s": 4.0,
                "phase": "settled",
                "candidates": ["edge1", "edge2"],
                "decision": {
                    "reason": "stays",
                    "aggregates": {"edge1": 0.6, "edge2": 0.5},
                    "utilities": {"robot1": {"edge1": {"value": 0.5}, "edge2": {"value": 0.5}}},
                },
                "vote": {"votes": {"robot1": "edge1"}},
                "history": [
                    {"epoch": 1, "revision": 1, "owner": "edge2", "age_s": 9.0, "reason": "first"},
                    {"epoch": 2, "revision": 2, "owner": "edge1", "age_s": 4.0, "reason": ""},
                ],
            }
        ],
        "problems": ["no quorum"],
    }
    return status | changes


def test_the_task_is_read() -> None:
    task = task_view(a_status(), "map_merge")

    assert task is not None
    assert (task.owner, task.epoch, task.candidates) == ("edge1", 2, ("edge1", "edge2"))
    assert task.aggregates == (("edge1", 0.6), ("edge2", 0.5))
    assert task.utilities == (("robot1", (("edge1", 0.5), ("edge2", 0.5))),)
    assert task.votes == (("robot1", "edge1"),)


@pytest.mark.parametrize("status", [{}, {"tasks": None}, {"tasks": [{"name": "other"}]}])
def test_a_task_that_is_not_there_is_none(status: dict[str, Any]) -> None:
    assert task_view(status, "map_merge") is None


def test_robots_come_first_and_a_silent_node_is_shown_by_a_peers_word() -> None:
    rows = node_views({"robot1": a_status()}, KINDS, "map_merge", "edge1", frozenset({"edge1"}))

    assert [row.name for row in rows] == ["robot1", "edge1", "edge2"]
    robot, edge1, edge2 = rows
    assert (robot.state, robot.link, robot.cpu_ratio) == ("alive", "wired", 0.2)
    assert (edge1.state, edge1.cpu_ratio, edge1.memory_ratio) == ("no answer", 0.9, None)
    assert (edge1.link, edge1.worker, edge1.is_owner, edge1.is_loaded) == ("-70 dBm", "ready", True, True)
    assert (edge2.state, edge2.cpu_ratio) == ("no answer", None)


def test_history_is_put_on_the_listeners_clock() -> None:
    first, second = past_allocations(a_status(), "map_merge", heard_s=100.0)

    assert (first.epoch, first.node, first.t_s, first.reason) == (1, "edge2", 91.0, "first")
    assert (second.epoch, second.node, second.t_s) == (2, "edge1", 96.0)


def test_moves_told_twice_are_one_with_the_earliest_time_and_a_reason() -> None:
    early = Move(task="t", epoch=1, node="edge1", t_s=1.0, reason="")
    late = Move(task="t", epoch=1, node="edge1", t_s=1.2, reason="edge2 is busy")

    assert merge_moves({}, [late, early]) == {
        1: Move(task="t", epoch=1, node="edge1", t_s=1.0, reason="edge2 is busy"),
    }
