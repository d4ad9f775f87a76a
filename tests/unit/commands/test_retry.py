"""`zsched retry`: who is asked, and what is told of those who are not there."""

from __future__ import annotations

import json

import pytest
from typer.testing import CliRunner, Result

from support.recorded_daemon import Daemon
from support.schemas import faults
from zsched.cli import app


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_retry_asks_every_node_that_is_there_and_names_the_others(daemon: Daemon) -> None:
    daemon.status["nodes"][-1]["state"] = "gone"
    names = [node["name"] for node in daemon.status["nodes"]]
    result = run("retry", "echo", "edge1", "--yes", "-m", "new lens")
    assert result.exit_code == 5
    asked = sorted((request for request in daemon.asked if request["verb"] == "retry"), key=lambda one: one["node"])
    wish = {"verb": "retry", "task": "echo", "whose": "edge1", "by": asked[0]["by"], "reason": "new lens"}
    assert asked == [{**wish, "node": name} for name in names[:-1]]
    assert result.stdout.splitlines()[-1] == f"echo on {names[-1]}: not asked, it is gone"
    assert faults(json.loads(run("retry", "echo", "edge1", "--yes", "--json").stdout)) == []
    daemon.status["nodes"][-1]["state"] = "alive"
    assert run("retry", "echo", "--yes").exit_code == 0


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("ehco",), "did you mean echo?"),
        (("echo", "egde1"), "edge1"),
        (("echo", "robot2"), "robot2 is no candidate of echo and has no worker of it; there are: edge1, edge2"),
    ],
)
def test_retry_of_what_there_is_not_is_a_usage_error(daemon: Daemon, words: tuple[str, ...], says: str) -> None:
    result = run("retry", *words)
    assert result.exit_code == 2
    assert says in result.stderr
    assert [request["verb"] for request in daemon.asked] == ["status"]
