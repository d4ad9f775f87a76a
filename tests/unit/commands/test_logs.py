"""`zsched logs` and `zsched restart`: what a worker has printed, and another one in its place."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from support.recorded_daemon import Daemon
from support.schemas import faults
from zsched.cli import app

CLI = (sys.executable, "-m", "zsched.cli")
Json = dict[str, Any]


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


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


def test_an_error_that_is_kept_no_more_is_not_said_never_to_have_been_printed(daemon: Daemon) -> None:
    daemon.lines = [{**line, "number": line["number"] + 100} for line in printed("[INFO] one", "[INFO] two")]
    result = run("logs", "echo", "--level", "error")
    told = (
        "printed nothing at error or above in the 2 lines that its daemon keeps; older ones are in the journal there\n"
    )
    assert (result.exit_code, result.stdout) == (0, "")
    assert result.stderr == f"the worker of echo on edge1 has {told}"


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


def test_logs_followed_go_along_with_the_task_to_its_next_owner(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who follows a task wants its work, not the silence of the machine that it has left."""
    printed_by = {
        "edge1": [{"number": 1, "age_s": 9.0, "text": "one"}],
        "edge2": [{"number": 7, "age_s": 60.0, "text": "long ago"}, {"number": 8, "age_s": 0.1, "text": "go"}],
    }

    def answer(request: Json) -> Json:
        if request["verb"] != "lines":
            return daemon.status
        lines = [one for one in printed_by[request["node"]] if one["number"] > request["after"]]
        newest = printed_by[request["node"]][-1]["number"]
        return {"node": request["node"], "task": "echo", "lines": lines, "newest": newest, "is_here": True}

    def sleep(_s: float) -> None:
        step = next(steps)
        if step == "end":
            raise KeyboardInterrupt
        if step == "move":
            printed_by["edge1"].append({"number": 2, "age_s": 0.2, "text": "last words"})
            daemon.status["tasks"][0]["owner"] = "edge2"
        if step == "print":
            printed_by["edge2"].append({"number": 9, "age_s": 0.0, "text": "on"})

    monkeypatch.setattr(daemon._socket, "_answer", answer)
    monkeypatch.setattr("zsched.commands.look.logs.OWNER_S", 0.0)
    monkeypatch.setattr("zsched.commands.look.logs.time", SimpleNamespace(sleep=sleep))
    for named, expected in (((), ["one", "last words", "go", "on"]), (("edge1",), ["one", "last words"])):
        daemon.status["tasks"][0]["owner"] = "edge1"
        printed_by["edge1"], printed_by["edge2"] = printed_by["edge1"][:1], printed_by["edge2"][:2]
        steps = iter(["wait", "move", "print", "end"])
        result = run("logs", "echo", *named, "-f")
        assert [line.split(" ", 1)[1] for line in result.stdout.splitlines()] == expected
        told = "echo is on edge2 now; `zsched logs echo edge1` has what edge1 printed\n"
        assert (result.exit_code, result.stderr) == (0, "" if named else told)


def test_logs_followed_says_once_that_nobody_answers(daemon: Daemon, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who follows over night finds what was printed, and not two lines a second of who was away."""
    daemon.lines = printed("one")
    steps = iter(["away", "away", "away", "back", "away", "end"])

    def sleep(_s: float) -> None:
        step = next(steps)
        if step == "end":
            raise KeyboardInterrupt
        daemon.is_here = step == "back"

    monkeypatch.setattr("zsched.commands.look.logs.time", SimpleNamespace(sleep=sleep))
    result = run("logs", "echo", "-f")
    assert result.exit_code == 0
    assert result.stderr.count("asking again") == 2


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


def test_restart_of_which_nobody_tells_the_end_may_have_been_done(daemon: Daemon) -> None:
    daemon.result = {"outcome": "unknown", "detail": "edge2 did not answer within 3 s", "revision": None}
    text, as_json = run("restart", "echo", "edge2", "--yes"), run("restart", "echo", "edge2", "--yes", "--json")
    assert (text.exit_code, as_json.exit_code) == (5, 5)
    told = "edge2 did not answer within 3 s; it may or may not start again, see `zsched logs echo edge2`"
    assert f"echo on edge2: {told}" in text.stderr
    assert faults(json.loads(as_json.stdout)) == []
