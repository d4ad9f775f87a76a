"""Status as JSON and as text: recorded snapshots of real fleets at 80 and 100 columns, and what text must never do.

The recorded answers lie in ``recorded_status/`` with the text they give; ``UPDATE_GOLDEN=1 pytest ...`` writes the text
anew (look at the difference before you commit it).
"""

from __future__ import annotations

import copy
import json
import os
import re
from pathlib import Path
from typing import Any

import pytest

from support.fleets import tuning_of
from zsched.commands.base.page import Page, cut, memory, size, span
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
STAGES = ("PROFILE", "GATEWAY", "SCHEDULER", "VOTE", "EXECUTOR", "ROUTE")


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


def test_stages_stand_in_the_order_of_the_design() -> None:
    text = render_status(recorded("healthy"), 100, color=False)
    starts = [re.search(rf"^{stage}\b", text, re.MULTILINE) for stage in STAGES]
    places = [match.start() for match in starts if match]
    assert len(places) == 6
    assert places == sorted(places)


@pytest.mark.parametrize("name", NAMES)
def test_colour_changes_nothing_but_colour(name: str) -> None:
    plain = render_status(recorded(name), 100, color=False)
    coloured = render_status(recorded(name), 100, color=True)
    assert "\x1b[" in coloured
    assert "\x1b" not in plain
    assert re.sub(r"\x1b\[[0-9;]*m", "", coloured) == plain


def test_more_robots_than_fit_are_counted() -> None:
    status = recorded("healthy")
    utilities = status["tasks"][0]["decision"]["utilities"]
    column = utilities["robot1"]
    utilities.update({f"robot{i}": copy.deepcopy(column) for i in range(4, 21)})
    lines = render_status(status, 80, color=False).splitlines()
    (head,) = [line for line in lines if "candidate" in line]
    shown = head.count("robot")
    assert 0 < shown < 20
    assert f"+{20 - shown}" in head


def test_the_scheduler_shows_what_a_move_costs_where_the_daemon_tells_it() -> None:
    status = recorded("healthy")
    (told,) = [line for line in render_status(status, 120, color=False).splitlines() if "SCHEDULER" in line]
    del status["tasks"][0]["tuning"]["price_s"]
    (untold,) = [line for line in render_status(status, 120, color=False).splitlines() if "SCHEDULER" in line]
    assert told.replace(" · a move costs 0.2 s", "") == untold != told


def test_bonus_and_what_was_not_kept_stand_beside_the_candidate_they_change() -> None:
    status = recorded("healthy")
    status["tasks"][0]["decision"]["unkept"] = {"edge2": 0.05, "edge1": 0.0}
    lines = {line.split()[0]: line for line in render_status(status, 100, color=False).splitlines()[12:] if line}
    assert lines["edge1"].endswith("owner +0.1")
    assert lines["edge2"].endswith("not kept -0.05")


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


def test_several_tasks_and_workers_are_told_apart() -> None:
    status = recorded("healthy")
    status["tasks"].append({**copy.deepcopy(status["tasks"][0]), "name": "slam", "streams": []})
    status["nodes"][0]["workers"].append({"task": "slam", "state": "failed", "cpu_cores": None, "memory_mb": None})
    wide, narrow = render_status(status, 120, color=False), render_status(status, 80, color=False)
    assert "echo ready, slam failed" in wide
    assert "1 ready, 1 failed" in render_status(status, 84, color=False)
    assert narrow.count("TASK ") == 2


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


def test_where_applications_join_stays_once_messages_flow() -> None:
    status = recorded("healthy")
    status["joins_at"] = ["tcp/127.0.0.1:7458"]
    status["tasks"].append({**status["tasks"][0], "name": "slam", "streams": []})
    assert all(stream["last_seen_s"] is not None for stream in status["tasks"][0]["streams"])
    assert render_status(status, 100, color=False).count("applications here join at tcp/127.0.0.1:7458") == 1


def test_where_applications_join_is_told_before_anything_is_counted() -> None:
    status = recorded("healthy")
    status["joins_at"] = ["tcp/127.0.0.1:7458"]
    status["tasks"][0]["streams"] = []
    told = render_status(status, 100, color=False)
    assert "no streams here" in told
    assert told.count("applications here join at tcp/127.0.0.1:7458") == 1
    status["kind"] = "edge"
    assert "applications here join" not in render_status(status, 100, color=False)


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


def test_an_input_that_had_messages_before_its_relays_start_waits_for_no_first_one() -> None:
    status = recorded("healthy")
    for stream in status["tasks"][0]["streams"]:
        stream["last_seen_s"] = None
        stream["from_expr"] = "robot1/mapp"
    text = " ".join(render_status(status, 100, color=False).split())
    assert "none since the relay's start or the stream's last change: waits for a message on robot1/mapp" in text
    assert "nothing yet" not in text


def test_an_input_that_has_seen_messages_waits_for_nothing() -> None:
    status = recorded("healthy")
    status["joins_at"] = ["tcp/127.0.0.1:7458"]
    for stream in status["tasks"][0]["streams"]:
        stream["from_expr"] = "robot1/in"
    assert "waits for" not in render_status(status, 100, color=False)


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


@pytest.mark.parametrize(
    ("base", "has_quorum", "told"),
    [
        (0, True, "won edge1 · "),
        (1, True, "won edge1, not agreed on yet"),
        (1, False, "won edge1, no quorum to agree on it"),
    ],
)
def test_a_vote_that_is_won_and_not_agreed_on_is_shown_as_such(base: int, has_quorum: bool, told: str) -> None:
    status = recorded("healthy")
    (task,) = status["tasks"]
    assert task["revision"] == 1
    task["vote"]["base_revision"] = base
    status["quorum"]["ok"] = has_quorum
    assert told in " ".join(render_status(status, 160, color=False).split())


# --- degraded --------------------------------------------------------------------------------------------------------


def test_healthy_fleet_is_not_degraded() -> None:
    assert degradations(recorded("healthy")) == ()
    assert degradations(recorded("edge")) == ()


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


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"owner": None, "owner_state": "none"}, ("echo has no owner (`zsched explain echo` says why)",)),
        ({"owner_state": "unknown"}, ("echo: its owner edge1 is unknown",)),
        ({"owner_state": "suspect"}, ()),  # in grace: it may still refute
    ],
)
def test_owner_that_is_not_there_is_degraded(change: dict[str, Any], expected: tuple[str, ...]) -> None:
    status = recorded("healthy")
    status["tasks"][0].update(change)
    assert degradations(status) == expected


def test_failed_worker_of_the_owner_is_degraded_and_one_elsewhere_is_not() -> None:
    status = recorded("healthy")
    status["nodes"][1]["workers"][0]["state"] = "failed"
    assert degradations(status) == ()
    status["nodes"][0]["workers"][0]["state"] = "failed"
    assert degradations(status) == ("echo: the worker on edge1 failed; mend it, then `zsched restart echo edge1`",)
    status["nodes"][0]["workers"][0] |= {"state": "stopped", "reason": "nobody subscribes to a/key"}
    assert degradations(status) == ("echo: the worker on edge1 is stopped: nobody subscribes to a/key",)


# --- figures and lines -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (None, "-"),
        (-0.2, "0.0s"),
        (0.04, "0.0s"),
        (9.94, "9.9s"),
        (9.96, "10s"),
        (59.4, "59s"),
        (59.6, "1m00s"),
        (3599.9, "1h00m"),
        (86400.0 * 2 + 3600 * 4, "2d04h"),
    ],
)
def test_durations(seconds: float | None, text: str) -> None:
    assert span(seconds) == text


def test_sizes() -> None:
    assert [size(0), size(999), size(1000), size(1 << 20), size(5 << 40)] == [
        "0 B",
        "999 B",
        "1.0 KiB",
        "1.0 MiB",
        "5120.0 GiB",
    ]
    assert [memory(98.4), memory(1000.0), memory(24064.0)] == ["98M", "1.0G", "23.5G"]


def test_cut_shows_that_something_was_cut() -> None:
    assert [cut("abcd", 4), cut("abcde", 4), cut("abc", 1), cut("abc", 0)] == ["abcd", "abc…", "…", ""]


def test_block_breaks_between_its_parts_and_aligns_them() -> None:
    page = Page(30, color=False)
    page.block("VOTE", ("one two", ""), ("three four", ""), ("five", ""))
    assert page.lines == ["VOTE       one two", "           three four · five"]


def test_block_with_a_long_title_pushes_its_text_along() -> None:
    page = Page(40, color=False)
    page.block("TASK a_long_name", ("owned", ""))
    assert page.lines == ["TASK a_long_name  owned"]


@pytest.mark.parametrize(
    ("age_s", "told"), [(303.0, "5m03s"), (2712.0, "45m"), (43_500.0, "12h"), (1_000_000.0, "11d")]
)
def test_an_age_of_a_node_fits_its_column(age_s: float, told: str) -> None:
    status = recorded("healthy")
    status["nodes"][0] |= {"state": "gone", "age_s": age_s, "speed": 0.713, "cpu_cores": 16.0, "memory_mb": 128_614.0}
    line = next(line for line in render_status(status, 120, color=False).splitlines() if line.startswith("edge1 "))
    assert f" {told} " in line
    assert "of 16 x0.71 " in line
    assert " 126G " in line
    assert "…" not in line


def test_speed_of_the_cores_what_a_starved_worker_wants_and_the_score_are_shown_where_there_is_room() -> None:
    status = recorded("healthy")
    (node, *_), (task, *_) = status["nodes"], status["tasks"]
    node["speed"], node["workers"][0]["cpu_cores"], node["workers"][0]["wanted_cores"] = 0.713, 0.48, 1.0
    task["tuning"]["score"] = "paper"
    wide, narrow = (render_status(status, width, color=False) for width in (120, 80))
    assert "of 2 x0.71 " in wide
    assert "0.48 of 1.00 cores" in wide
    assert "· by the paper's score" in wide
    assert "x0.71" not in narrow
    assert "paper's score" not in render_status(recorded("healthy"), 120, color=False)


@pytest.mark.parametrize(
    ("of_node", "of_worker", "is_shown"),
    [
        ({}, {}, True),
        ({"state": "gone", "age_s": 15.0}, {}, False),
        ({"state": "suspect"}, {}, False),
        ({"age_s": 15.0}, {}, False),
        ({}, {"state": "starting", "trouble": "lost"}, False),
        ({}, {"state": "stopped", "reason": "killed by signal 9 (Killed)"}, False),
    ],
)
def test_jobs_of_who_does_none_any_more_are_not_shown(
    of_node: dict[str, Any], of_worker: dict[str, Any], *, is_shown: bool
) -> None:
    status = recorded("healthy")
    node = status["nodes"][0]
    node.update(of_node)
    jobs = {"time_s": 0.02, "cpu_s": 0.01, "done_hz": 47.5, "wanted_hz": 47.5, "backlog": 0}
    node["workers"][0].update(jobs=jobs, **of_worker)
    assert ("47.5 of 47.5 a second" in render_status(status, 120, color=False)) is is_shown


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


def test_gauges_stand_under_the_nodes_where_any_is_measured() -> None:
    status = recorded("healthy")
    assert "GAUGES" not in render_status(status, width=100, color=False)
    status["nodes"][0]["gauges"] = {"battery": 0.843, "temperature_c": 51.2}
    status["nodes"][1]["gauges"] = {"gpu": 0.3, "wind": 4.0}
    (line,) = (row for row in render_status(status, width=100, color=False).splitlines() if row.startswith("GAUGES"))
    names = [node["name"] for node in status["nodes"]]
    assert f"{names[0]} battery 84 % temperature_c 51 °C · {names[1]} gpu 30 % wind 4" in line
