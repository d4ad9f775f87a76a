"""Verbs that ask a daemon: exit codes, what goes to stdout and what to stderr, and what is never imported.

The daemon's side is its real operator socket; what stands behind it answers with recorded statuses.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

import pytest
import typer
from typer.testing import CliRunner, Result

from support.clinic import FLEET
from support.schemas import faults
from support.waiting import within
from zsched.adapters.host.operator_socket import OperatorSocket
from zsched.cli import app
from zsched.commands.ask import ask_door, endpoint_of, find_door
from zsched.commands.common import CliError, nearest
from zsched.commands.report import render_status
from zsched.commands.status import _fitted
from zsched.commands.weight_words import parse_weights

RECORDED = Path(__file__).parent / "commands" / "recorded_status"
CLI = (sys.executable, "-m", "zsched.cli")
Json = dict[str, Any]


class Daemon:
    """An operator socket in ``folder`` that answers like a daemon, and remembers what it was asked."""

    def __init__(self, folder: Path, node: str = "robot1", status: str = "healthy") -> None:
        self.status: Json = json.loads((RECORDED / f"{status}.json").read_text())
        self.result: Json = {"outcome": "ok", "detail": "committed", "revision": 2}
        self.asked: list[Json] = []
        self.delay_s = 0.0
        self.lines: list[Json] = []
        self.is_here = True
        self._socket = OperatorSocket(folder / f"{node}.sock", self._answer)

    def _answer(self, request: Json) -> Json:
        self.asked.append(request)
        time.sleep(self.delay_s)
        if request["verb"] in ("weights", "retry", "restart"):
            return self.result
        if request["verb"] == "lines":
            lines = [one for one in self.lines if one["number"] > request["after"]][:2]
            newest = max((one["number"] for one in self.lines), default=0)
            return {"node": request["node"], "task": "echo", "lines": lines, "newest": newest, "is_here": self.is_here}
        if "error" in self.status:
            return self.status
        return {**self.status, "node": request.get("node", self.status["node"])}

    def __enter__(self) -> Self:
        self._socket.open()
        return self

    def __exit__(self, *_error: object) -> None:
        self._socket.close()


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty runtime folder that the verbs look into, and no other word from the environment."""
    for name in ("ZSCHED_NODE", "ZSCHED_CONFIG", "ZSCHED_STATE_DIR", "STATE_DIRECTORY", "RUNTIME_DIRECTORY", "COLUMNS"):
        monkeypatch.delenv(name, raising=False)
    runtime = tmp_path / "run"
    runtime.mkdir()
    monkeypatch.setenv("ZSCHED_RUNTIME_DIR", str(runtime))
    return runtime


@pytest.fixture
def daemon(folder: Path) -> Iterator[Daemon]:
    with Daemon(folder) as running:
        yield running


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


# --- status ----------------------------------------------------------------------------------------------------------


def test_status_shows_the_only_daemon_without_colour_off_a_terminal(daemon: Daemon) -> None:
    result = run("status")
    assert (result.exit_code, result.stderr) == (0, "")
    assert "TASK       owner" in result.stdout
    assert "\x1b" not in result.stdout
    assert daemon.asked == [{"verb": "status"}]


def test_streams_are_listed_with_the_rates_of_the_window_not_the_daemon_s(daemon: Daemon) -> None:
    for stream in daemon.status["tasks"][0]["streams"]:
        stream |= {"hz": 77.0, "bytes_per_s": 7.0}
    body = json.loads(run("stream", "list", "--window", "0.1", "--json").stdout)
    assert faults(body) == []
    assert [stream["hz"] for stream in body["streams"]] == [0.0, 0.0], "the recorded totals stand still"


def test_status_with_v_shows_all_stages(daemon: Daemon) -> None:
    assert daemon.status["node"] == "robot1"
    short, whole = run("status").stdout, run("status", "-v").stdout
    assert run("status", "--verbose").stdout.count("\n") == whole.count("\n") > short.count("\n")
    for stage in ("PROFILE", "GATEWAY", "SCHEDULER", "VOTE", "EXECUTOR", "ROUTE"):
        assert f"\n{stage} " in whole
        assert stage not in short
    assert re.search(r"known here for 4\.5s, since \d\d:\d\d:\d\d", whole)


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


def test_status_without_a_daemon_exits_with_3_and_says_where_it_looked(folder: Path) -> None:
    result = run("status", "--json")
    assert (result.exit_code, result.stdout) == (3, "")
    assert str(folder) in result.stderr
    assert "zsched up" in result.stderr


def test_status_at_a_socket_nobody_listens_on_exits_with_3(folder: Path) -> None:
    with Daemon(folder) as left_behind:
        path = folder / "robot1.sock"
        kept = path.with_name("kept")
        path.rename(kept)
    kept.rename(path)
    assert left_behind.asked == []
    result = run("status")
    assert result.exit_code == 3
    assert str(path) in result.stderr


def test_status_of_a_daemon_that_refuses_exits_with_1(daemon: Daemon) -> None:
    daemon.status = {"error": "something \x1b[2Jbroke"}
    result = run("status")
    assert (result.exit_code, result.stdout) == (1, "")
    assert "something ?[2Jbroke" in result.stderr, "as text: it may be another node's"


def test_status_of_a_wedged_loop_exits_with_5(daemon: Daemon) -> None:
    daemon.status = {"error": "the decision loop of robot1 did not answer within 3 s"}
    assert run("status").exit_code == 5


def test_daemon_that_does_not_answer_in_time_is_told_from_one_that_is_not_there(daemon: Daemon, folder: Path) -> None:
    daemon.delay_s = 0.5
    with pytest.raises(CliError, match=r"did not answer within 0\.1 s") as raised:
        ask_door(find_door(folder, None), {"verb": "status"}, timeout_s=0.1)
    assert raised.value.code == 5


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
    arguments = {"write": [str(folder / "x.prom")], "wait": ["--for", "quorum", "--timeout", "0"]}
    arguments |= {
        "invite": ["edge9", "--plan"],
        "logs": ["echo"],
        "restart": ["echo", "--yes"],
        "weights": ["echo", "cpu=1", "--yes"],
        "explain": ["echo"],
        "move": ["echo", "edge1", "--plan"],
        "retry": ["echo", "--yes"],
        "bw": ["in/0"],
        "hz": ["in/0"],
        "tail": ["in/0"],
        "rehearse": ["echo", "--plan"],
        "renew": ["--deliver"],
    }
    file = str(Path(__file__).parents[2] / "configs" / "fleet.yaml")
    arguments |= {"apply": [file], "add": [file], "remove": ["echo"], "forget": ["edge1"]}
    arguments |= {"record": ["-o", str(folder / "x.mcap"), "--for", "0.1s"], "trace": ["--once"]}
    arguments |= {"ping": ["edge1"], "bugreport": [str(folder / "report.tar.gz")]}
    assert set(asking) >= {("status",), ("weights",), ("retry",), ("stream", "list"), ("stream", "tail")}
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
        for verb in (("status",), ("weights", "echo"), ("retry", "echo")):
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


def test_status_of_a_node_that_the_fleet_has_not_is_refused_with_the_nearest_name(daemon: Daemon) -> None:
    result = run("status", "--node", "robo2")
    assert result.exit_code == 2
    assert "did you mean robot" in result.stderr
    assert [asked for asked in daemon.asked if "node" in asked] == []


def test_status_of_a_silent_node_elsewhere_exits_with_3(daemon: Daemon) -> None:
    answer = daemon._answer
    silent = {"error": "robot3 did not answer within 3 s; is it up and reachable?"}
    daemon._socket._answer = lambda request: silent if "node" in request else answer(request)
    result = run("status", "--node", "robot3")
    assert result.exit_code == 3
    assert "no daemon of robot3 in " in result.stderr
    assert "and none answers in the network; start it with `zsched up --node robot3`" in result.stderr
    assert "within 3 s" not in result.stderr, "it may have been told at once"


def test_status_is_not_asked_twice_a_second_without_watch(daemon: Daemon) -> None:
    run("status", "--interval", "0.1")
    assert len(daemon.asked) == 1


@pytest.mark.parametrize("interval", ["0", "soon"])
def test_impossible_interval_is_a_usage_error(daemon: Daemon, interval: str) -> None:
    result = run("status", "--watch", "--interval", interval)
    assert result.exit_code == 2
    assert "--interval" in result.stderr
    assert daemon.asked == []


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


def test_screen_that_is_too_low_keeps_the_problems(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LINES", "10")
    text = "\n".join([*(f"line {i}" for i in range(20)), "", "PROBLEMS no quorum"])
    shown = _fitted(text).replace("\x1b[K", "").replace("\x1b[H", "").replace("\x1b[J", "").split("\n")
    assert len(shown) == 10
    assert shown[-1] == "PROBLEMS no quorum"
    assert shown[6] == "line 6"
    assert shown[7].startswith("... 13 more lines")


@pytest.mark.parametrize("height", [20, 24, 30])
def test_many_problems_of_many_tasks_stay_in_the_lower_half_of_the_screen(
    monkeypatch: pytest.MonkeyPatch, height: int
) -> None:
    monkeypatch.setenv("LINES", str(height))
    status = json.loads((RECORDED / "healthy.json").read_text())
    status["tasks"] = [{**status["tasks"][0], "name": f"task{number}"} for number in range(8)]
    status["problems"] = [f"problem {number}" for number in range(20)]
    shown = _fitted(render_status(status, 80, color=True))
    lines = shown.replace("\x1b[K", "").replace("\x1b[H", "").replace("\x1b[J", "").split("\n")
    assert len(lines) == height
    assert lines[0].startswith("\x1b[1mfleet")
    assert "PROBLEMS" in lines[height - height // 2 + 1]
    assert "problem 0" in lines[height - height // 2 + 1]
    assert lines[-1] == f"... {22 - height // 2} more lines of problems: a higher window shows them"


def test_screen_that_is_high_enough_shows_all(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LINES", "10")
    assert _fitted("\n".join("abcdefghij")).count("\n") == 9


# --- retry -----------------------------------------------------------------------------------------------------------


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


# --- logs, restart ---------------------------------------------------------------------------------------------------


def printed(*texts: str) -> list[Json]:
    return [{"number": number, "age_s": 0.5, "text": text} for number, text in enumerate(texts, 1)]


def test_logs_shows_the_owner_s_lines_page_after_page(daemon: Daemon) -> None:
    daemon.lines = printed("one", "two", "three\x1b[2J")
    result = run("logs", "echo")
    assert (result.exit_code, result.stderr) == (0, "")
    assert [re.sub(r"^\d\d:\d\d:\d\d ", "", line) for line in result.stdout.splitlines()] == ["one", "two", "three?[2J"]
    asked = [request for request in daemon.asked if request["verb"] == "lines"]
    assert asked == [{"verb": "lines", "task": "echo", "after": after, "node": "edge1"} for after in (0, 2)]
    assert run("logs", "echo", "--lines", "1").stdout.endswith(" three?[2J\n")
    assert run("logs", "echo", "--lines", "0").stdout == ""
    bodies = [json.loads(line) for line in run("logs", "echo", "edge2", "--json").stdout.splitlines()]
    assert ([faults(body) for body in bodies], {body["node"] for body in bodies}) == ([[], [], []], {"edge2"})


def test_logs_of_a_worker_that_has_printed_nothing_says_so(daemon: Daemon) -> None:
    daemon.lines = []
    result = run("logs", "echo")
    told = "the worker of echo on edge1 has printed nothing since the daemon there started\n"
    assert (result.exit_code, result.stdout, result.stderr) == (0, "", told)
    assert run("logs", "echo", "--level", "error").stderr == told.replace("nothing", "nothing at error or above")


def test_logs_of_a_node_that_starts_no_worker_says_so(daemon: Daemon) -> None:
    daemon.is_here = False
    result = run("logs", "echo", "robot2")
    assert (result.exit_code, result.stdout) == (1, "")
    assert "robot2 starts no worker of echo" in result.stderr


def test_logs_of_a_task_without_an_owner_needs_a_node(daemon: Daemon) -> None:
    daemon.status["tasks"][0]["owner"] = None
    result = run("logs", "echo")
    assert result.exit_code == 1
    assert "echo has no owner; name a node, there are edge1, edge2" in result.stderr
    assert run("logs", "ecko").exit_code == run("logs", "echo", "egde1").exit_code == 2


def test_logs_followed_prints_what_comes_and_starts_anew_with_another_daemon(folder: Path) -> None:
    with Daemon(folder) as daemon:
        daemon.lines = printed("one", "two", "three")
        command = [*CLI, "logs", "echo", "-f", "--json", "--runtime-dir", str(folder)]
        with subprocess.Popen(command, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
            assert process.stdout is not None
            first = [json.loads(process.stdout.readline())["text"] for _ in range(3)]
            daemon.lines += [{"number": 4, "age_s": 0.0, "text": "four"}]
            first.append(json.loads(process.stdout.readline())["text"])
            daemon.lines = printed("anew")
            first.append(json.loads(process.stdout.readline())["text"])
            process.send_signal(signal.SIGINT)
            _, error = process.communicate(timeout=60)
    assert first == ["one", "two", "three", "four", "anew"]
    assert (process.returncode, error) == (0, "")


def test_logs_of_a_level_keep_a_traceback_whole(daemon: Daemon) -> None:
    texts = (
        "it starts",
        "2026-11-24 INFO ready",
        "2026-11-24 ERROR no map",
        "Traceback (most recent call last):",
        '  File "worker.py", line 3',
        "[WARN] [camera]: late",
        "DEBUG done",
        '{"level": "info", "msg": "error 7 is over"}',
        "{'severity': 'fatal'}",
    )
    daemon.lines = [{"number": number, "age_s": 1.0, "text": text} for number, text in enumerate(texts, 1)]

    def shown(*words: str) -> list[int]:
        lines = run("logs", "echo", "--json", *words).stdout.splitlines()
        return [json.loads(line)["number"] for line in lines]

    assert shown() == shown("--level", "debug") == list(range(1, 10))
    assert shown("--level", "warning") == [1, 3, 4, 5, 6, 9], "a line before the first level is shown"
    assert shown("--level", "error") == [1, 3, 4, 5, 9]
    assert shown("--level", "error", "--lines", "2") == [5, 9]
    refused = run("logs", "echo", "--level", "warn")
    assert (refused.exit_code, "did you mean warning" in refused.stderr) == (2, True)


def test_restart_shows_what_becomes_of_the_worker_and_says_who_wants_it(daemon: Daemon) -> None:
    daemon.result = {"outcome": "ok", "detail": "its worker is started again, it was ready", "revision": None}
    result = run("restart", "echo", "edge2", "--yes", "-m", "new code")
    assert (result.exit_code, result.stderr) == (0, "")
    heads, row, told = result.stdout.splitlines()
    assert heads.split() == ["TASK", "WHAT", "NOW", "AFTER"]
    assert re.split(r"  +", row) == ["echo", "worker on edge2", "ready", "started again"]
    assert told == "echo on edge2: its worker is started again, it was ready"
    asked = daemon.asked[-1]
    assert (asked["verb"], asked["task"], asked["node"], asked["reason"]) == ("restart", "echo", "edge2", "new code")
    assert asked["by"].endswith("@robot1")


def test_restart_of_the_owner_s_worker_says_that_the_task_pauses(daemon: Daemon) -> None:
    refused = run("restart", "echo")
    assert (refused.exit_code, [asked["verb"] for asked in daemon.asked]) == (2, ["status"])
    assert "started again; the task pauses until it is ready" in refused.stdout
    assert run("restart", "echo", "--yes").exit_code == 0
    assert daemon.asked[-1]["node"] == "edge1"


def test_restart_that_is_refused_exits_with_1(daemon: Daemon) -> None:
    daemon.result = {"outcome": "invalid", "detail": "its worker does not run", "revision": None}
    text, as_json = run("restart", "echo", "edge2", "--yes"), run("restart", "echo", "edge2", "--yes", "--json")
    assert (text.exit_code, as_json.exit_code) == (1, 1)
    assert "echo on edge2: its worker does not run" in text.stderr
    assert faults(json.loads(as_json.stdout)) == []


# --- weights ---------------------------------------------------------------------------------------------------------


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


# --- without a daemon here -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("robot1", "tcp/robot1:7457"),
        ("tcp/robot1", "tcp/robot1:7457"),
        ("192.0.2.11:7500", "tcp/192.0.2.11:7500"),
        ("tls/robot1:7500", "tls/robot1:7500"),
        ("[2001:db8::1]", "tcp/[2001:db8::1]:7457"),
        ("tcp/[2001:db8::1]:7500", "tcp/[2001:db8::1]:7500"),
    ],
)
def test_an_endpoint_may_be_given_without_its_protocol_and_port(text: str, expected: str) -> None:
    assert endpoint_of(text) == expected


@pytest.mark.parametrize("text", ["", "tcp/", "/robot1", "robot1:port", "tcp/:7457"])
def test_what_is_no_endpoint_is_a_usage_error(folder: Path, text: str) -> None:
    result = run("status", "--connect", text, "--runtime-dir", folder)
    assert (result.exit_code, result.stdout) == (2, "")
    assert "is no endpoint; write tcp/robot1:7457" in result.stderr


@pytest.mark.usefixtures("folder")
def test_connect_takes_the_name_of_a_node() -> None:
    assert run("status", "--connect", "robot1", "--node", "*").exit_code == 2


# --- words that are wrong --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--generation", "99999999999", "--node", "edge1"), "--generation 99999999999: at most 1048575"),
        (("--node", "edg1"), "no node 'edg1' under 'nodes' (there are"),
    ],
)
def test_init_with_a_wrong_word_ends_as_usage_and_writes_nothing(
    words: tuple[str, ...], says: str, tmp_path: Path
) -> None:
    file = tmp_path / "fleet.yaml"
    file.write_text(FLEET)
    state = tmp_path / "state"
    result = CliRunner().invoke(app, ["init", "--config", str(file), "--state-dir", str(state), *words])
    assert result.exit_code == 2, result.stderr
    assert says in result.stderr
    assert not state.exists()


def test_the_module_runs_the_verb_as_the_program_does(tmp_path: Path) -> None:
    file = tmp_path / "fleet.yaml"
    file.write_text(FLEET.replace("kind: edge", "kind: ege"))
    done = subprocess.run(
        [sys.executable, "-m", "zsched", "check", str(file)], capture_output=True, text=True, check=False
    )
    assert (done.returncode, "ege" in done.stderr + done.stdout) == (78, True)


# --- what is imported ------------------------------------------------------------------------------------------------

FOREIGN = ("zenoh", "numpy", "cv2", "pydantic", "rich", "asyncio", "psutil", "ruamel", "msgpack", "matplotlib")
LOADED = """
import sys
sys.argv = ["zsched", *{arguments!r}]
try:
    from zsched.cli import main
    main()
finally:
    print("LOADED", *sorted({{name.partition(".")[0] for name in sys.modules}}), file=sys.stderr)
"""


def loaded_by(folder: Path, *arguments: str) -> tuple[int, set[str]]:
    """(exit code, top packages) of one run in an interpreter of its own."""
    code = LOADED.format(arguments=[*arguments, "--runtime-dir", str(folder)])
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("LOADED")]
    return done.returncode, set(line.split()[1:])


def test_status_loads_nothing_heavy_even_when_nobody_answers(folder: Path) -> None:
    code, loaded = loaded_by(folder, "status")
    assert code == 3
    assert loaded & set(FOREIGN) == set()
    assert "typer" in loaded


def test_status_and_weights_load_nothing_heavy(daemon: Daemon, folder: Path) -> None:
    for arguments in (("status",), ("status", "--json", "--node", "robot1"), ("weights", "echo")):
        code, loaded = loaded_by(folder, *arguments)
        assert code == 0
        assert loaded & set(FOREIGN) == set()
    assert daemon.asked


def test_command_line_has_no_side_effect_on_import() -> None:
    command = [sys.executable, "-c", "import zsched.cli"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    assert (done.stdout, done.stderr) == ("", "")


def test_the_list_of_verbs_cuts_no_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    text = CliRunner().invoke(app, ["--help"]).stdout
    _, listed = text.split("Commands:\n")
    assert "..." not in listed
    assert max(map(len, text.splitlines())) <= 80
    assert "Run this machine's daemon in the foreground (what systemd runs)." in listed
