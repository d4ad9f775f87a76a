"""`zsched weights`: shown, changed, refused; names that are nearly right."""

from __future__ import annotations

import json
import re
import time

import pytest
from typer.testing import CliRunner, Result

from support.recorded_daemon import Daemon
from support.schemas import faults
from support.waiting import within
from zsched.cli import app
from zsched.commands.common import CliError, nearest
from zsched.commands.weight_words import parse_weights


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_retry_waits_for_silent_nodes_all_at_once(daemon: Daemon) -> None:
    daemon.delay_s = 1.0
    began = time.monotonic()
    assert run("retry", "echo", "--yes").exit_code == 0
    assert len([request for request in daemon.asked if request["verb"] == "retry"]) == 5
    within(time.monotonic() - began, 5.0, "instead of one second for the status, one for the five nodes")


def test_weights_without_values_shows_those_in_force(daemon: Daemon) -> None:
    assert run("weights", "echo").stdout == "echo: cpu=0.3 memory=0.3 network=0.4 (revision 1)\n"
    assert json.loads(run("weights", "echo", "--json").stdout) == {
        "schema": "zsched.weights/1",
        "task": "echo",
        "weights": {"cpu": 0.3, "memory": 0.3, "network": 0.4},
        "revision": 1,
    }
    assert faults(json.loads(run("weights", "echo", "--json").stdout)) == []
    assert {asked["verb"] for asked in daemon.asked} == {"status"}


def test_weights_of_an_unknown_task_is_a_usage_error(daemon: Daemon) -> None:
    result = run("weights", "ehco")
    assert result.exit_code == 2
    assert "did you mean echo?" in result.stderr
    assert daemon.asked


def test_new_weights_are_sent_and_the_revision_is_shown(daemon: Daemon) -> None:
    result = run("weights", "echo", "cpu=0.6", "memory=0.4", "--revision", "1", "--yes", "-m", "calm")
    assert (result.exit_code, result.stderr) == (0, "")
    heads, *rows, told = result.stdout.splitlines()
    assert heads.split() == ["TASK", "WHAT", "NOW", "AFTER"]
    assert [row.split()[1:] for row in rows] == [
        ["cpu", "0.3", "0.6"],
        ["memory", "0.3", "0.4"],
        ["network", "0.4", "0"],
    ]
    assert told == "echo: cpu=0.6 memory=0.4 network=0 (revision 2)"
    asked = daemon.asked[-1]
    expected = {"verb": "weights", "task": "echo", "cpu": 0.6, "memory": 0.4, "network": 0.0, "base_revision": 1}
    assert {key: asked[key] for key in expected} == expected
    assert (asked["reason"], asked["by"].endswith("@robot1")) == ("calm", True)


def test_the_weights_in_force_change_nothing(daemon: Daemon) -> None:
    same = ("cpu=0.3", "memory=0.3", "network=0.4")
    assert run("weights", "echo", *same).stdout == "Nothing would change.\n"
    assert {asked["verb"] for asked in daemon.asked} == {"status"}


@pytest.mark.usefixtures("daemon")
def test_all_weights_are_listed_when_no_task_is_given() -> None:
    assert run("weights").stdout == "echo: cpu=0.3 memory=0.3 network=0.4 (revision 1)\n"
    (line,) = run("weights", "--json").stdout.splitlines()
    assert faults(json.loads(line)) == []


@pytest.mark.parametrize(
    ("outcome", "code"),
    [("ok", 0), ("unchanged", 0), ("conflict", 1), ("invalid", 2), ("no_quorum", 4), ("unknown", 5), ("new_word", 1)],
)
def test_outcome_of_a_change_is_the_exit_code(daemon: Daemon, outcome: str, code: int) -> None:
    daemon.result = {"outcome": outcome, "detail": "because", "revision": None}
    text, as_json = run("weights", "echo", "cpu=1", "--yes"), run("weights", "echo", "cpu=1", "--yes", "--json")
    assert (text.exit_code, as_json.exit_code) == (code, code)
    body = json.loads(as_json.stdout)
    assert (body["schema"], body["outcome"], body["detail"]) == ("zsched.weights/1", outcome, "because")
    assert faults(body) == []
    assert ("echo: cpu=1" in text.stdout) is (code == 0)
    assert ("because" in text.stderr) is (code != 0)


@pytest.mark.parametrize(
    ("pairs", "said"),
    [
        (["cpu"], "write them like cpu=0.6"),
        (["memroy=1"], "did you mean memory?"),
        (["speed=1"], "there are cpu, memory, network"),
        (["cpu=x"], "is not a number"),
        (["cpu=nan"], "not in [0, 1]"),
        (["cpu=1.5"], "not in [0, 1]"),
        (["cpu=-1"], "not in [0, 1]"),
        (["cpu=0.5", "cpu=0.5"], "given twice"),
        (["cpu=0.6"], "sum is 0.6 (memory, network left out: 0), not 1"),
        (["cpu=0.6", "memory=0.6", "network=0"], "sum is 1.2, not 1"),
    ],
)
def test_wrong_weights_are_a_usage_error_before_anybody_is_asked(daemon: Daemon, pairs: list[str], said: str) -> None:
    with pytest.raises(CliError, match=re.escape(said)) as raised:
        parse_weights(pairs)
    assert raised.value.code == 2
    assert run("weights", "echo", *pairs).exit_code == 2
    assert daemon.asked == []


def test_weights_add_up_as_people_write_them() -> None:
    thirds = {"cpu": 0.3333333, "memory": 0.3333333, "network": 0.3333334}
    assert parse_weights([f"{name}={value}" for name, value in thirds.items()]) == thirds
    assert parse_weights(["network=0.1", "cpu=0.7", "memory=0.2"])["network"] == 0.1


def test_revision_without_new_weights_is_a_usage_error(daemon: Daemon) -> None:
    assert run("weights", "echo", "--revision", "3").exit_code == 2
    assert daemon.asked == []


def test_nearest_name_or_all_names() -> None:
    assert nearest("robo1", ["edge1", "robot1"]) == "; did you mean robot1?"
    assert nearest("x", ["edge1", "robot1"]) == "; there are edge1, robot1"
