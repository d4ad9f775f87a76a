"""`zsched wait`: conditions, what is missing, and exit codes."""

from __future__ import annotations

import copy
import json
import re
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from support.schemas import faults
from support.waiting import until, within
from zsched.cli import app
from zsched.commands.look.wait import missing, parse_condition
from zsched.host.operator_socket import OperatorSocket

RECORDED = Path(__file__).parent / "recorded_status"
Json = dict[str, Any]


def recorded(name: str = "healthy") -> Json:
    status: Json = json.loads((RECORDED / f"{name}.json").read_text())
    return status


def lacks(text: str, *statuses: Json) -> list[str]:
    return missing(parse_condition(text), {str(number): status for number, status in enumerate(statuses)})


# --- conditions ------------------------------------------------------------------------------------------------------


def test_quorum_and_owner() -> None:
    assert lacks("quorum", recorded()) == []
    assert lacks("quorum", recorded("degraded")) == ["1 of 3 electors can answer, 2 needed"]
    assert lacks("owner=echo@edge1", recorded()) == []
    assert lacks("owner=echo@edge2", recorded()) == ["echo: its owner is edge1"]


def test_settled_needs_a_live_owner_with_a_ready_worker_and_every_robot_s_handover_over() -> None:
    first, other = recorded(), recorded()
    assert lacks("settled=echo", first, other) == []
    other["tasks"][0]["phase"] = "draining"
    assert lacks("settled=echo", first, other) == ["echo: 1 is draining"]
    other["tasks"][0] |= {"phase": "settled", "owner": "edge2"}
    assert lacks("settled=echo", first, other) == ["echo: 1 takes edge2 for the owner, not edge1"]
    first["nodes"][0]["workers"][0]["state"] = "starting"
    assert lacks("settled=echo", first) == ["echo: the worker on edge1 is starting"]
    first["tasks"][0]["owner_state"] = "suspect"
    assert lacks("settled=echo", first) == ["echo: its owner is edge1, suspect"]
    first["tasks"][0]["owner"] = None
    assert lacks("settled=echo", first)[0] == "echo: its owner is nobody"


def test_empty_needs_no_task_and_no_slot_that_drains() -> None:
    first, other = recorded(), recorded()
    assert lacks("empty=edge1", first) == ["echo is owned by edge1"]
    assert lacks("empty=edge2", first, other) == []
    other["tasks"][0]["phase"] = "draining"
    assert lacks("empty=edge2", first, other) == ["echo: the old owner may be in use: 1 is draining"]


def test_a_node_that_does_not_know_the_task_is_named_and_uses_no_old_owner() -> None:
    """A document that adds or removes a task reaches one node after the other."""
    first, other = recorded(), {**recorded(), "tasks": []}
    assert lacks("settled=echo", first, other) == ["echo: 1 has not learnt of it yet"]
    assert lacks("settled=echo", other, first) == ["echo: 0 does not know it"]
    assert lacks("owner=echo@edge1", other) == ["echo: 0 does not know it"]
    assert lacks("empty=edge2", first, other) == []


# --- the verb --------------------------------------------------------------------------------------------------------


class Daemon:
    def __init__(self, folder: Path) -> None:
        self.status, self.asked = recorded(), list[Json]()
        self.behind = 0
        """Looks at robot2 until it knows the tasks."""
        self.socket = OperatorSocket(folder / "robot1.sock", self.answer)

    def answer(self, request: Json) -> Json:
        self.asked.append(request)
        told = {**copy.deepcopy(self.status), "node": request.get("node", "robot1")}
        if told["node"] == "robot2" and self.behind:
            self.behind -= 1
            told["tasks"] = []
        return told


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("ZSCHED_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("ZSCHED_NODE", raising=False)
    return tmp_path


@pytest.fixture
def daemon(folder: Path) -> Iterator[Daemon]:
    running = Daemon(folder)
    running.socket.open()
    yield running
    running.socket.close()


def run(*words: str) -> Result:
    return CliRunner().invoke(app, ["wait", *words])


def test_a_condition_that_holds_is_met_at_once(daemon: Daemon) -> None:
    result = run("--until", "owner=echo@edge1")
    assert result.exit_code == 0
    assert re.fullmatch(r"owner=echo@edge1: met after \d\.\ds\n", result.stdout)
    assert len(daemon.asked) == 1


def test_time_over_exits_with_5_and_names_what_is_missing(daemon: Daemon) -> None:
    result = run("--until", "owner=echo@edge2", "--timeout", "0")
    assert (result.exit_code, len(daemon.asked)) == (5, 1)
    assert re.fullmatch(r"owner=echo@edge2: not met after \d\.\ds\n  echo: its owner is edge1\n", result.stdout)
    body = json.loads(run("--until", "owner=echo@edge2", "--timeout", "0", "--json").stdout)
    assert (faults(body), body["met"], body["missing"]) == ([], False, ["echo: its owner is edge1"])


def test_it_looks_again_until_the_condition_holds(daemon: Daemon) -> None:
    def move() -> None:
        until(lambda: len(daemon.asked) > 1, "it looks again")
        daemon.status["tasks"][0]["owner"] = "edge2"

    began = time.monotonic()
    mover = threading.Thread(target=move)
    mover.start()
    assert run("--until", "owner=echo@edge2", "--timeout", "60").exit_code == 0
    mover.join()
    assert len(daemon.asked) > 1
    within(time.monotonic() - began, 10.0)


def test_settled_asks_every_robot_that_is_alive(daemon: Daemon) -> None:
    daemon.status["nodes"][-1]["state"] = "gone"
    assert run("--until", "settled=echo", "--timeout", "0").exit_code == 0
    assert [request.get("node") for request in daemon.asked] == [None, "robot2"]


def test_a_robot_that_does_not_know_a_new_task_yet_is_asked_until_it_does(daemon: Daemon) -> None:
    daemon.behind = 1
    late = run("--until", "settled=echo", "--timeout", "0")
    assert (late.exit_code, late.stdout.splitlines()[1:]) == (5, ["  echo: robot2 has not learnt of it yet"])
    daemon.behind = 1
    assert (run("--until", "settled=echo", "--timeout", "60").exit_code, daemon.behind) == (0, 0)


def test_nobody_at_the_end_exits_with_3(folder: Path) -> None:
    result = run("--until", "healthy", "--timeout", "0.6")
    assert result.exit_code == 3
    assert f"no daemon in {folder}" in result.stderr


def test_a_daemon_that_comes_up_is_waited_for(folder: Path) -> None:
    late = Daemon(folder)
    opener = threading.Timer(0.7, late.socket.open)
    opener.start()
    assert run("--until", "healthy", "--timeout", "60").exit_code == 0
    opener.join()
    late.socket.close()
