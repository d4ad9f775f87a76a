"""`zsched status`: exit codes, what goes to stdout and to stderr, the screen."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner, Result

from support.recorded_daemon import Daemon
from support.schemas import faults
from zsched.cli import app
from zsched.commands.base import ask
from zsched.commands.base.ask import ask_door, find_door
from zsched.commands.base.common import CliError
from zsched.commands.look.status import _fitted
from zsched.core.values.fleet import MOST_ORDER_S

CLI = (sys.executable, "-m", "zsched.cli")


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_status_shows_the_only_daemon_without_colour_off_a_terminal(daemon: Daemon) -> None:
    result = run("status")
    assert (result.exit_code, result.stderr) == (0, "")
    assert "TASK       owner" in result.stdout
    assert "\x1b" not in result.stdout
    assert daemon.asked == [{"verb": "status"}]


def test_status_as_json_is_the_answer_itself_and_why_the_fleet_is_degraded(daemon: Daemon) -> None:
    result = run("status", "--json")
    assert json.loads(result.stdout) == {**daemon.status, "degraded": []}
    assert faults(json.loads(run("status", "--json=1").stdout)) == []
    assert daemon.status["schema"] == "zsched.status/1"


@pytest.mark.parametrize("flags", [(), ("--json",)])
def test_degraded_fleet_is_shown_and_exits_with_4(folder: Path, flags: tuple[str, ...]) -> None:
    with Daemon(folder, status="degraded"):
        result = run("status", *flags)
    assert result.exit_code == 4
    assert "echo" in result.stdout


def test_status_without_a_daemon_exits_with_3_and_says_where_it_looked(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ZSCHED_CONFIG", str(folder / "none.yaml"))
    result = run("status", "--json")
    assert (result.exit_code, result.stdout) == (3, "")
    assert str(folder) in result.stderr
    assert "zsched join INVITATION" in result.stderr


def test_status_of_a_daemon_that_refuses_exits_with_1(daemon: Daemon) -> None:
    daemon.status = {"error": "something \x1b[2Jbroke"}
    result = run("status")
    assert (result.exit_code, result.stdout) == (1, "")
    assert "something ?[2Jbroke" in result.stderr, "as text: it may be another node's"


def test_status_of_a_wedged_loop_exits_with_5(daemon: Daemon) -> None:
    daemon.status = {"error": "the decision loop of robot1 did not answer within 3 s"}
    assert run("status").exit_code == 5


def test_daemon_that_does_not_answer_in_time_is_told_from_one_that_is_not_there(
    daemon: Daemon, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    daemon.delay_s = 0.5
    monkeypatch.setattr(ask, "ASK_TIMEOUT_S", 0.1)
    door, order = find_door(folder, None), {"verb": "restart", "task": "echo"}
    for request, is_unsure in (({"verb": "status"}, False), (order, True)):
        with pytest.raises(CliError, match=r"did not answer within 0\.1 s") as raised:
            ask_door(door, request)
        assert raised.value.code == 5
        assert ("may or may not have been done" in str(raised.value)) == is_unsure


def test_an_order_that_is_agreed_is_waited_for_until_the_daemon_tells_its_end(
    daemon: Daemon, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert ask.ORDER_TIMEOUT_S > MOST_ORDER_S, "whatever the fleet's timing"
    daemon.delay_s = 0.5
    monkeypatch.setattr(ask, "ASK_TIMEOUT_S", 0.1)
    assert ask_door(find_door(folder, None), {"verb": "tune", "task": "echo"})["outcome"] == "ok"


def test_status_of_another_major_version_is_refused_with_advice(daemon: Daemon) -> None:
    daemon.status["schema"] = "zsched.status/2"
    result = run("status")
    assert result.exit_code == 1
    assert "update" in result.stderr


def test_status_of_several_daemons_needs_a_name(daemon: Daemon, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with Daemon(folder, "robot2") as other:
        refused = run("status")
        assert refused.exit_code == 2
        assert "robot1, robot2" in refused.stderr
        daemon.asked.clear()
        monkeypatch.setenv("ZSCHED_NODE", "robot2")
        assert run("status").exit_code == 0
        assert len(other.asked) == 1
        assert run("status", "--node", "robot1").exit_code == 0
        assert daemon.asked == [{"verb": "status"}]


def test_every_verb_that_asks_a_daemon_takes_the_node_that_several_daemons_make_it_name(
    daemon: Daemon, folder: Path
) -> None:
    def verbs(group: typer.core.TyperGroup, *before: str) -> Iterator[tuple[tuple[str, ...], set[str]]]:
        for name, command in group.commands.items():
            if isinstance(command, typer.core.TyperGroup):
                yield from verbs(command, *before, name)
            else:
                yield (*before, name), {option for one in command.params for option in one.opts}

    main = typer.main.get_command(app)
    assert isinstance(main, typer.core.TyperGroup)
    asking = [words for words, options in verbs(main) if "--runtime-dir" in options]
    arguments = {"write": [str(folder / "x.prom")], "wait": ["--until", "quorum", "--timeout", "0"]}
    arguments |= {
        "invite": ["edge9", "--plan"],
        "logs": ["echo"],
        "restart": ["echo", "--yes"],
        "tune": ["echo", "bonus=0.2", "--yes"],
        "explain": ["echo"],
        "move": ["echo", "edge1", "--plan"],
        "bw": ["in/0"],
        "hz": ["in/0"],
        "tail": ["in/0"],
        "rehearse": ["echo", "--plan"],
        "renew": ["--deliver"],
    }
    file = str(Path(__file__).parents[3] / "configs" / "fleet.yaml")
    arguments |= {"apply": [file], "add": [file], "remove": ["echo"], "forget": ["edge1"]}
    arguments |= {"record": ["-o", str(folder / "x.mcap"), "--for", "0.1s"], "trace": ["--once"]}
    arguments |= {"hand": ["echo", "hall-b", "--plan"], "ping": ["edge1"], "bugreport": [str(folder / "report.tar.gz")]}
    assert set(asking) >= {("status",), ("tune",), ("restart",), ("stream", "list"), ("stream", "tail")}
    del asking[asking.index(("up",))]  # it starts the daemon
    del asking[asking.index(("leave",))]  # the state folder says whose machine it is
    del asking[asking.index(("web",))]  # it serves until it is told to end: tests/parts/commands/watch
    with Daemon(folder, "robot2") as other:
        for words in asking:
            command = [*words, *arguments.get(words[-1], [])]
            refused = run(*command)
            assert (refused.exit_code, "say which one with --node" in refused.stderr) == (2, True), words
            daemon.asked.clear()
            other.asked.clear()
            result = run(*command, "--node", "robot2")
            assert "No such option" not in result.stderr, words
            assert (bool(other.asked), daemon.asked) == (True, []), words


@pytest.mark.parametrize("others", [("robot2",), ("robot2", "edge1")], ids=["one other", "two others"])
def test_the_machine_s_own_daemon_is_down_while_others_run(
    folder: Path, monkeypatch: pytest.MonkeyPatch, others: tuple[str, ...]
) -> None:
    """It is not one of several that the user must choose from, and no other is shown in its place."""
    monkeypatch.setenv("ZSCHED_NODE", "robot1")
    with contextlib.ExitStack() as stack:
        for name in others:
            stack.enter_context(Daemon(folder, name))
        for verb in (("status",), ("tune", "echo"), ("restart", "echo")):
            result = run(*verb)
            assert (result.exit_code, result.stdout) == (3, ""), result.stderr
            assert f"no daemon of robot1 in {folder} (here: {', '.join(sorted(others))})" in result.stderr
            assert "start it with `zsched up --node robot1`" in result.stderr


def test_a_host_name_that_is_a_node_s_is_this_machine_s(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket, "gethostname", lambda: "robot1.local")
    with Daemon(folder, "robot2"), Daemon(folder, "edge1"):
        result = run("status")
    assert result.exit_code == 3
    assert f"no daemon of robot1 in {folder} (here: edge1, robot2)" in result.stderr


def test_a_zsched_node_that_the_fleet_has_not_is_refused_with_the_nearest_name(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ZSCHED_NODE", "robt1")
    result = run("status")
    assert result.exit_code == 2
    assert "ZSCHED_NODE: fleet testbed has no node 'robt1'; did you mean robot1?" in result.stderr
    assert daemon.asked == [{"verb": "status"}], "only for the names"


def test_status_of_a_node_elsewhere_goes_through_a_daemon_here(daemon: Daemon) -> None:
    result = run("status", "--node", "robot3", "--json")
    assert result.exit_code == 0
    assert json.loads(result.stdout)["node"] == "robot3"
    assert daemon.asked[-1] == {"verb": "status", "node": "robot3"}


def test_status_of_a_silent_node_elsewhere_exits_with_3(daemon: Daemon) -> None:
    answer = daemon._answer
    silent = {"error": "robot3 did not answer within 3 s; is it up and reachable?"}
    daemon._socket._answer = lambda request: silent if "node" in request else answer(request)
    result = run("status", "--node", "robot3")
    assert result.exit_code == 3
    assert "no daemon of robot3 in " in result.stderr
    assert "and none answers in the network; look at zsched on the machine of robot3" in result.stderr
    assert "zsched up" not in result.stderr, "a second daemon of that name is none to start here"
    assert "within 3 s" not in result.stderr, "it may have been told at once"


def watch(folder: Path, *arguments: str) -> subprocess.Popen[str]:
    environment = {**os.environ, "ZSCHED_RUNTIME_DIR": str(folder)}
    command = [*CLI, "status", "--watch", "--interval", "0.1", *arguments]
    return subprocess.Popen(command, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def test_watch_with_json_gives_a_line_each_until_interrupted(folder: Path) -> None:
    """NDJSON through a pipe, line by line, and the last status's exit code at Ctrl-C."""
    with Daemon(folder, status="degraded"), watch(folder, "--json") as process:
        assert process.stdout is not None
        lines = [json.loads(process.stdout.readline()) for _ in range(3)]
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=60)
    assert {line["schema"] for line in lines} == {"zsched.status/1"}
    assert all(line["degraded"] for line in lines), "why it is 4"
    assert (process.returncode, error) == (4, "")


def test_watch_outlives_a_restart_of_the_daemon(folder: Path) -> None:
    with Daemon(folder), watch(folder, "--json") as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.readline()
        (folder / "robot1.sock").rename(folder / "away")
        assert "no daemon answers" in process.stderr.readline()
        (folder / "away").rename(folder / "robot1.sock")
        for _ in range(100):
            if json.loads(process.stdout.readline())["node"] == "robot1":
                break
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=60)
    assert process.returncode == 0


def test_watch_into_a_closed_pipe_ends_quietly(folder: Path) -> None:
    with Daemon(folder), watch(folder, "--json") as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.readline()
        process.stdout.close()
        error = process.stderr.read()
        process.wait(10)
    assert "Traceback" not in error


def test_a_reader_that_has_gone_changes_nothing_of_the_end(folder: Path) -> None:
    """`zsched status | true` ended in a traceback, and its exit code was lost."""
    reading, writing = os.pipe()
    os.close(reading)
    with Daemon(folder), os.fdopen(writing, "wb") as gone:
        command = [sys.executable, "-m", "zsched", "status", "--runtime-dir", str(folder)]
        buffered = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
        done = subprocess.run(
            command, env=buffered, stdout=gone, stderr=subprocess.PIPE, text=True, timeout=60, check=False
        )
    assert (done.returncode, done.stderr) == (0, "")


def test_screen_that_is_too_low_keeps_the_problems(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LINES", "10")
    text = "\n".join([*(f"line {i}" for i in range(20)), "", "PROBLEMS no quorum"])
    shown = _fitted(text).replace("\x1b[K", "").replace("\x1b[H", "").replace("\x1b[J", "").split("\n")
    assert len(shown) == 10
    assert shown[-1] == "PROBLEMS no quorum"
    assert shown[6] == "line 6"
    assert shown[7].startswith("... 13 more lines")
