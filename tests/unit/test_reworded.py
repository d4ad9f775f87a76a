"""No decision hangs on a sentence: who reads a status does the same when each of its sentences is said otherwise."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from zsched.commands.base.report import all_problems
from zsched.core.values.problems import Problem, of_kind, parted, told_of
from zsched.tools.doctor.daemon import lacks_of_owners
from zsched.tools.doctor.fleet import have_true_clocks
from zsched.tools.metrics import metrics_text

RECORDED = Path(__file__).parent / "commands" / "recorded_status" / "degraded.json"
SAID = {
    Problem.OTHER: "a robot is overloaded",
    Problem.CLOCK: "clock: it is slewed",
    Problem.NO_QUORUM: "no quorum: 1 of 3 electors can answer, 2 needed; waiting for robot2",
    Problem.NOTHING_AGREED: "nothing can be agreed: too many electors without their states",
    Problem.TAKEN_OUT: "fleet/document: this machine was taken out",
}
OF_TASK = {
    Problem.WORKER_FAILED: "the worker on edge2 failed: no map",
    Problem.NO_SPARE: "no other candidate can take it",
}


def status_of(said: dict[Problem, str], of_task: dict[Problem, str]) -> dict[str, Any]:
    status: dict[str, Any] = json.loads(RECORDED.read_text())
    (task,) = status["tasks"]
    for body, problems in ((status, said), (task, of_task)):
        body["problems"], body["problem_kinds"] = list(problems.values()), [str(kind) for kind in problems]
    return status


def decided(status: dict[str, Any]) -> list[Any]:
    """What the readers make of it; a sentence by its place in the status."""
    (task,) = status["tasks"]
    said = {text: place for place, text in enumerate(status["problems"])}
    said |= {f"{task['name']}: {text}": place for place, text in enumerate(task["problems"], 100)}
    scene: Any = SimpleNamespace(statuses={"robot1": status})
    gauge = [line for line in metrics_text(status).splitlines() if line.startswith("zsched_task_without_spare{")]
    return [
        [said.get(text, text) for text in all_problems(status)],
        [[said.get(text, text) for text in result.evidence] for result in lacks_of_owners(status)],
        have_true_clocks(scene).verdict,
        gauge,
        bool(of_kind(status, Problem.TAKEN_OUT)),
    ]


def test_a_status_whose_sentences_are_reworded_is_read_the_same() -> None:
    first = decided(status_of(SAID, OF_TASK))
    otherwise = ({kind: f"said {number}" for number, kind in enumerate(kinds)} for kinds in (SAID, OF_TASK))
    assert decided(status_of(*otherwise)) == first
    assert first[0][:3] == [3, 2, "echo: its owner edge1 is gone"], "causes come first, and the lost quorum once"
    assert first[1][-1] == [101]
    assert first[3] == ['zsched_task_without_spare{task="echo"} 1']
    assert first[4]


def test_kinds_alone_count_though_the_sentences_say_more() -> None:
    status = status_of({Problem.OTHER: "clock: this machine was taken out"}, {Problem.OTHER: OF_TASK[Problem.NO_SPARE]})
    (_, lacks, verdict, gauge, is_out) = decided(status)
    assert (lacks[-1] == [100], gauge, is_out) == (False, ['zsched_task_without_spare{task="echo"} 0'], False)
    assert verdict is not decided(status_of(SAID, OF_TASK))[2]


@pytest.mark.parametrize("kind", [Problem.CLOCK, Problem.NO_SPARE])
def test_an_older_daemon_tells_no_kinds(kind: Problem) -> None:
    assert of_kind({"problems": [*SAID.values(), *OF_TASK.values()]}, kind) == []


def test_problems_are_told_in_the_order_of_their_sources() -> None:
    problems = {("thread", "x"): "a", ("state", ""): "b", (Problem.TAKEN_OUT, ""): "c", (Problem.FLEET, "robot2"): "d"}
    told = told_of(problems)
    assert parted("first", *told) == (
        ("first", "fleet/document: c", "fleet/robot2: d", "state: b", "thread/x: a"),
        ("other", "taken_out", "fleet", "state", "thread"),
    )
