"""`zsched ping` against sessions that answer as a node's do, or do not."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh
from typer.testing import CliRunner, Result

from support.clinic import FLEET
from support.schemas import faults
from zsched.cli import app
from zsched.config.load import load_fleet
from zsched.core.values import codec as wire
from zsched.core.values.snapshot import NodeStatus, QuorumStatus, Snapshot
from zsched.link.keyspace import Keyspace
from zsched.link.sessions import config as zenoh_config
from zsched_lab.fleet.loopback import free_endpoint

KEYS = Keyspace("hall")
SLOW_S = 0.05


class Node:
    """A control and a data session at two addresses; ``edge1`` finds robot1 gone."""

    def __init__(self) -> None:
        self.control, self.data = free_endpoint(), free_endpoint()
        self._sessions: dict[str, zenoh.Session] = {}

    def open_control(self, *, is_slow: bool = False) -> None:
        session = self._open("control", self.control)
        session.declare_queryable(KEYS.status("edge1", "*"), lambda query: self._answer(query, is_slow=is_slow))

    def open_data(self) -> None:
        self._open("data", self.data)

    def _open(self, name: str, endpoint: str) -> zenoh.Session:
        config = zenoh_config.data_config(listen=(endpoint,), connect=())
        self._sessions[name] = zenoh.open(zenoh.Config.from_json5(config))
        return self._sessions[name]

    @staticmethod
    def _answer(query: zenoh.Query, *, is_slow: bool) -> None:
        if is_slow:
            time.sleep(SLOW_S)
        answer = Snapshot(
            schema="zsched.status/1",
            version="0.1.0",
            fleet="hall",
            node="edge1",
            kind="edge",
            incarnation=1,
            up_s=5.0,
            loop_lag_s=0.0,
            quorum=QuorumStatus(electors=3, needed=2, alive=3, ok=True, this_node="no_elector"),
            nodes=(NodeStatus(name="robot1", kind="robot", state="gone", age_s=None),),
            tasks=(),
        )
        with query:
            query.reply(KEYS.status("edge1", "robot1"), wire.encode(answer))

    def close(self) -> None:
        for session in self._sessions.values():
            session.close()


@pytest.fixture
def node() -> Iterator[Node]:
    made = Node()
    yield made
    made.close()


@pytest.fixture(autouse=True)
def file(node: Node, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    made = tmp_path / "fleet.yaml"
    text = FLEET.replace("tcp/0.0.0.0:21257", node.control).replace("tcp/0.0.0.0:21258", node.data)
    made.write_text(text)
    assert load_fleet(made).node("edge1").listen_data == node.data
    monkeypatch.setenv("ZSCHED_CONFIG", str(made))
    monkeypatch.setenv("ZSCHED_NODE", "robot1")
    monkeypatch.setenv("ZSCHED_RUNTIME_DIR", str(tmp_path))
    return made


def run(*arguments: str) -> Result:
    return CliRunner().invoke(app, ["ping", *arguments])


def ways(result: Result) -> dict[str, Any]:
    return {way["way"]: way for way in json.loads(result.stdout)["ways"]}


def test_both_sessions_are_measured_and_both_ears_told(node: Node) -> None:
    node.open_control(is_slow=True)
    node.open_data()
    result = run("edge1", "--count", "3", "--interval", "0", "--json")
    found = ways(result)
    assert (result.exit_code, set(found)) == (0, {"control", "data", "data 64 KiB", "data 1 MiB"})
    assert {found[way]["answered"] for way in ("data 64 KiB", "data 1 MiB")} == {1}
    assert (found["control"]["answered"], found["control"]["endpoint"]) == (3, node.control)
    assert SLOW_S <= found["control"]["least_s"] <= found["control"]["mean_s"] <= found["control"]["most_s"]
    assert (found["data"]["answered"], found["data"]["missed"]) == (3, 0)
    assert faults(json.loads(result.stdout)) == []
    assert json.loads(result.stdout)["heard"] == {"edge1": {"robot1": "gone"}}
    text = run("edge1", "-c", "1").stdout.splitlines()
    assert text[0].startswith(f"control     {node.control}: 1 of 1 answered, ")
    assert text[-1] == "edge1 finds robot1 gone"


def test_a_session_that_is_not_there_is_told_and_the_other_measured(node: Node) -> None:
    node.open_control()
    result = run("edge1", "-c", "1")
    assert result.exit_code == 1
    assert f"data        {node.data}: edge1 does not answer: " in result.stdout


def test_a_session_of_somebody_else_is_no_answer(node: Node) -> None:
    node._open("control", node.control)
    result = run("edge1", "-c", "2", "--interval", "0", "--json")
    assert (result.exit_code, ways(result)["control"]["missed"]) == (3, 2)
    assert faults(json.loads(result.stdout)) == []


def test_nobody_at_all_is_3_and_an_unknown_name_2() -> None:
    assert run("edge1", "-c", "1").exit_code == 3
    result = run("edge7")
    assert (result.exit_code, result.stdout) == (2, "")
    assert "did you mean edge1?" in result.stderr


def test_a_node_without_an_address_needs_a_daemon_here() -> None:
    result = run("robot2")
    assert result.exit_code == 3
    assert "robot2 has no address in the fleet file, and no daemon runs here" in result.stderr
