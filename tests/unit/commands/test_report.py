"""Status as JSON and as text: recorded snapshots of real fleets at 80 and 100 columns, and what text must never do.

The recorded answers lie in ``recorded_status/`` with the text they give; ``UPDATE_GOLDEN=1 pytest ...`` writes the text
anew (look at the difference before you commit it).
"""

from __future__ import annotations

import copy
import json
import os
from pathlib import Path
from typing import Any

import pytest

from support.fleets import tuning_of
from zsched.commands.base.report import all_problems, degradations, render_status
from zsched.core.values.model import Utility
from zsched.core.values.plan import StreamCount
from zsched.core.values.profile import Link, LinkSource, WorkerLoad, WorkerState
from zsched.core.values.report import snapshot_json
from zsched.core.values.snapshot import (
    DecisionStatus,
    NodeStatus,
    PastAllocation,
    QuorumStatus,
    Snapshot,
    TaskStatus,
    VoteStatus,
)

RECORDED = Path(__file__).parent / "recorded_status"
NAMES = ("healthy", "edge", "degraded")


def recorded(name: str) -> dict[str, Any]:
    status: dict[str, Any] = json.loads((RECORDED / f"{name}.json").read_text())
    return status


def snapshot() -> Snapshot:
    edge = NodeStatus(
        name="edge1",
        kind="edge",
        state="alive",
        age_s=0.4,
        links=(Link(source=LinkSource.WIRED),),
        workers=(WorkerLoad(task="merge", state=WorkerState.READY, cpu_cores=0.1, memory_mb=90.0),),
    )
    task = TaskStatus(
        name="merge",
        owner="edge1",
        epoch=3,
        revision=5,
        since_s=12.0,
        owner_state="alive",
        phase="settled",
        tuning=tuning_of(),
        candidates=("edge1",),
        decision=DecisionStatus(
            outcome="stay",
            winner="edge1",
            reason="nobody better",
            age_s=0.2,
            aggregates=(("edge1", 0.7),),
            utilities=(("robot1", (Utility(candidate="edge1", value=0.6, cpu=0.2),)),),
            vetoed=(("edge2", "worker failed"),),
        ),
        vote=VoteStatus(base_revision=4, votes=(("robot1", "edge1"),), outcome="won", winner="edge1", age_s=12.0),
        streams=(StreamCount(stream="merge/in/0", messages=7, bytes=70, drops=(("overflow", 2),), last_seen_s=0.1),),
        history=(PastAllocation(epoch=3, revision=5, owner="edge1", age_s=12.0, reason="first placement"),),
    )
    quorum = QuorumStatus(electors=1, needed=1, alive=1, ok=True, this_node="elector")
    return Snapshot(
        schema="zsched.status/1",
        version="0.1.0",
        fleet="hall",
        node="robot1",
        kind="robot",
        incarnation=7,
        up_s=60.0,
        loop_lag_s=0.0,
        quorum=quorum,
        nodes=(edge,),
        tasks=(task,),
        counters=(("dropped_beat_stale", 3),),
    )


# --- JSON ------------------------------------------------------------------------------------------------------------


def test_snapshot_as_json_has_objects_for_pairs_and_null_for_what_is_not_measured() -> None:
    body = json.loads(json.dumps(snapshot_json(snapshot())))
    assert body["schema"] == "zsched.status/1"
    assert body["counters"] == {"dropped_beat_stale": 3}
    assert body["nodes"][0]["cpu_ratio"] is None
    assert body["nodes"][0]["links"][0] == {
        "source": "wired",
        "peer": None,
        "rssi_dbm": None,
        "bitrate_mbps": None,
        "retry_ratio": None,
    }
    (task,) = body["tasks"]
    assert task["decision"]["utilities"]["robot1"]["edge1"]["value"] == 0.6
    assert task["decision"]["vetoed"] == {"edge2": "worker failed"}
    assert task["vote"]["votes"] == {"robot1": "edge1"}
    assert task["streams"][0]["drops"] == {"overflow": 2}


def test_fields_of_the_recorded_schema_are_all_still_there() -> None:
    """Within a major version fields are only added: what a script reads today it can read tomorrow."""
    assert missing(recorded("healthy"), snapshot_json(snapshot()), "") == []


def missing(old: Any, new: Any, where: str) -> list[str]:
    """Paths of keys that ``old`` has and ``new`` has not; keys that are names are not compared."""
    by_name = ("utilities", "aggregates", "vetoed", "votes", "drops", "counters")
    if isinstance(old, dict) and isinstance(new, dict):
        gone = [f"{where}.{key}" for key in old if key not in new]
        shared = [key for key in old if key in new and key not in by_name]
        return gone + [path for key in shared for path in missing(old[key], new[key], f"{where}.{key}")]
    if isinstance(old, list) and isinstance(new, list) and old and new:
        return missing(old[0], new[0], f"{where}[]")
    return []


# --- text ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("width", [80, 100])
@pytest.mark.parametrize("name", NAMES)
def test_recorded_status_looks_as_agreed(name: str, width: int) -> None:
    golden = RECORDED / f"{name}.{width}.txt"
    text = render_status(recorded(name), width, color=False)
    if os.environ.get("UPDATE_GOLDEN"):
        golden.write_text(text)
    assert text == golden.read_text()


@pytest.mark.parametrize("width", [60, 73, 80, 100, 160])
@pytest.mark.parametrize("name", NAMES)
def test_no_line_is_longer_than_the_terminal(name: str, width: int) -> None:
    status = recorded(name)
    status["problems"] = ["a problem told at length " * 8, "x" * 300]
    status["tasks"][0]["history"][0]["reason"] = "y" * 300
    assert max(map(len, render_status(status, width, color=False).splitlines())) <= width


@pytest.mark.parametrize(
    ("trouble", "said"), [({}, "starting"), ({"trouble": "lost"}, "was ready"), ({"trouble": "again"}, "restarting")]
)
def test_a_worker_that_was_ready_is_starting_in_no_row(trouble: dict[str, str], said: str) -> None:
    status = recorded("healthy")
    status["nodes"][0]["workers"][0].update(state="starting", **trouble)
    name = status["nodes"][0]["name"]
    for width in (80, 120):
        rows = [line for line in render_status(status, width, color=False).splitlines() if line.startswith(name)]
        assert said in rows[0]
        assert ("starting" in rows[0].split()) is (said == "starting")
    status["nodes"][0]["workers"].append({**status["nodes"][0]["workers"][0], "task": "slam"})
    status["tasks"].append({**copy.deepcopy(status["tasks"][0]), "name": "slam", "streams": []})
    assert f"echo {said}, slam {said}" in render_status(status, 140, color=False)


def test_nothing_known_yet_is_shown_as_such() -> None:
    status = recorded("healthy")
    for node in status["nodes"]:
        unknown = dict.fromkeys(node, None) | {"name": node["name"], "kind": node["kind"], "state": "unknown"}
        node.update(unknown, links=[], workers=[], draining=False)
    (task,) = status["tasks"]
    task.update(owner=None, owner_state="none", since_s=None, decision=None, vote=None, history=[], streams=[])
    text = render_status(status, 80, color=False)
    assert "0 of 5 profiles held" in text
    assert "no owner yet" in text
    assert "no round yet" in text
    assert "None" not in text


@pytest.mark.parametrize(
    ("states", "said"), [(("gone",), "ok, 1 node away"), (("gone", "unknown"), "ok, 2 nodes away")]
)
def test_the_first_line_tells_of_nodes_that_are_away(states: tuple[str, ...], said: str) -> None:
    """A robot may be switched off: that is no problem, and not just "ok"."""
    status = recorded("healthy")
    for node, state in zip(status["nodes"][1:], states, strict=False):
        node["state"] = state
    assert render_status(status, 100, color=False).splitlines()[0].endswith(f" {said}")
    assert degradations(status) == ()
    status["problems"] = ["something"]
    assert render_status(status, 100, color=False).splitlines()[0].endswith(" 1 problem")


@pytest.mark.parametrize(
    ("from_expr", "joins", "told"),
    [
        (
            "robot1/in",
            ["tcp/127.0.0.1:7458"],
            "waits for a message on robot1/in from an application at tcp/127.0.0.1:7458",
        ),
        ("robot1/in", [], "nothing yet: waits for a message on robot1/in"),
        ("", ["tcp/127.0.0.1:7458"], "nothing yet"),
    ],
)
def test_an_input_that_never_saw_a_message_says_what_it_waits_for(from_expr: str, joins: list[str], told: str) -> None:
    status = recorded("healthy")
    status["joins_at"] = joins
    for stream in status["tasks"][0]["streams"]:
        stream["from_expr"], stream["last_seen_s"], stream["messages"] = from_expr, None, 0
    text = " ".join(render_status(status, 100, color=False).split())
    assert told in text
    assert text.count("waits for") == (1 if from_expr else 0), "an output waits for nobody's application"


@pytest.mark.parametrize(
    ("done", "answers", "phase", "is_told"),
    [(100, 0, "settled", True), (99, 0, "settled", False), (100, 1, "settled", False), (100, 0, "preparing", False)],
)
def test_a_worker_that_does_all_and_answers_nothing_may_put_it_under_another_key(
    done: int, answers: int, phase: str, is_told: bool
) -> None:
    status = recorded("healthy")
    (task,) = status["tasks"]
    task["phase"] = phase
    for stream in task["streams"]:
        if "/in/" in stream["stream"]:
            stream["acknowledged"] = done
        else:
            stream.update(messages=answers, from_expr="edge1/echo/1/anser")
    told = " ".join(render_status(status, 160, color=False).split())
    assert (f"done {done} inputs and nothing has ever come on edge1/echo/1/anser" in told) is is_told
    assert degradations(status) == (), "it may answer rarely"
    assert "PROBLEMS" not in told


# --- degraded --------------------------------------------------------------------------------------------------------


def test_a_lost_quorum_is_told_once_with_what_the_daemon_says_of_it() -> None:
    status = recorded("degraded")
    said = "no quorum: 1 of 3 electors can answer, 2 needed; waiting for robot2, robot3"
    status["problems"], status["problem_kinds"] = [said], ["no_quorum"]
    assert [one for one in all_problems(status) if one.startswith("no quorum")] == [said]


def test_lost_quorum_and_lost_owner_are_degraded() -> None:
    assert degradations(recorded("degraded")) == (
        "no quorum: 1 of 3 electors can answer, 2 needed",
        "echo: its owner edge1 is gone",
    )


def test_failed_worker_of_the_owner_is_degraded_and_one_elsewhere_is_not() -> None:
    status = recorded("healthy")
    status["nodes"][1]["workers"][0]["state"] = "failed"
    assert degradations(status) == ()
    status["nodes"][0]["workers"][0]["state"] = "failed"
    assert degradations(status) == ("echo: the worker on edge1 failed; mend it, then `zsched restart echo edge1`",)
    status["nodes"][0]["workers"][0] |= {"state": "stopped", "reason": "nobody subscribes to a/key"}
    assert degradations(status) == ("echo: the worker on edge1 is stopped: nobody subscribes to a/key",)


# --- figures and lines -----------------------------------------------------------------------------------------------


def test_what_a_worker_says_of_its_jobs_is_shown_with_the_deadline_and_what_misses_it() -> None:
    status = recorded("healthy")
    (task, *_) = status["tasks"]
    assert "JOBS" not in render_status(status, 120, color=False)
    owner = next(node for node in status["nodes"] if node["name"] == task["owner"])
    jobs = {"time_s": 0.22, "cpu_s": 0.034, "wait_s": 0.18, "age_s": 0.41, "done_hz": 4.0, "wanted_hz": 6.0}
    owner["workers"][0]["jobs"] = {**jobs, "backlog": 3, "late_ratio": None}
    text = render_status(status, 120, color=False)
    assert f"JOBS       {task['owner']} · 220 ms a job, 34 ms of CPU · 4 of 6 a second · 67% done · 3 wait" in text
    assert "deadline" not in text
    task["tuning"]["deadline_ms"] = 100.0
    owner["workers"][0]["jobs"]["late_ratio"] = 0.95
    text = render_status(status, 160, color=False)
    assert "410 ms from input to end, deadline 100 ms, 95% late" in text
    assert "· deadline 100 ms" in text
    for file_ms, late in ((500.0, "95% later than 500 ms"), (100.0, "95% late"), (None, "95% late")):
        task["file_tuning"] = {**task["tuning"], "deadline_ms": file_ms}
        assert f"deadline 100 ms, {late}\n" in render_status(status, 160, color=False), "workers count by the file"
    owner["workers"][0]["jobs"] = None
    assert "JOBS" not in render_status(status, 120, color=False), "nothing is told"
