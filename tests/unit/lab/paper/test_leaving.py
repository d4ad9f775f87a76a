"""How soon a loaded edge was left: by the plan of the load, and the moves of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from zsched_lab.paper.leaving import left_after_s, told
from zsched_lab.paper.load import schedule
from zsched_lab.paper.scenario import LoadPlan

RESULTS = Path(__file__).parents[4] / "docs" / "evaluation" / "heavy-again.json"
PLAN = LoadPlan(lanes=1, busy_s=(9.0, 15.0), idle_s=(2.0, 5.0), first_s=3.0)
SCENARIO: dict[str, Any] = {
    "load": {"lanes": 1, "busy_s": [9, 15], "idle_s": [2, 5], "first_s": 3},
    "nodes": {"edge1": {}, "edge2": {}},
    "duration_s": 40.0,
}


def run_of(owners: list[list[Any]]) -> dict[str, Any]:
    return {"scheme": "zsched", "seed": 7, "owners": owners}


def test_a_move_counts_when_the_edge_that_it_leaves_is_loaded() -> None:
    first = schedule(PLAN, ("edge1", "edge2"), 40.0, 7)[0]
    other = "edge1" if first.node == "edge2" else "edge2"
    at = first.start_s
    assert left_after_s(SCENARIO, run_of([[0.0, first.node], [at + 1.5, other]])) == [pytest.approx(1.5)]
    assert left_after_s(SCENARIO, run_of([[0.0, other], [at + 1.5, first.node]])) == [], "that edge is idle"
    assert left_after_s(SCENARIO, run_of([[0.0, first.node], [at - 0.5, other]])) == [], "not yet"
    assert left_after_s(SCENARIO, run_of([[0.0, first.node]])) == []
    late = run_of([[0.0, first.node], [at + 4.0, other]])
    (line,) = told(SCENARIO, [late, run_of([[0.0, first.node], [at + 1.0, other]])])
    assert line.split(maxsplit=1) == ["zsched", "1.0 to 4.0 s, median 2.5; 1 of 2 moves within 3 s"]
