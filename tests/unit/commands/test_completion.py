"""Completion: which words may come next, and that a shell gets them."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from zsched.cli import app
from zsched.commands.completion import script_file
from zsched.host.operator_socket import OperatorSocket

ROOT = Path(__file__).parents[3]
RECORDED = Path(__file__).parent / "recorded_status"
NODES = ["edge1", "edge2", "robot1", "robot2", "robot3"]


@pytest.fixture(autouse=True)
def fleet_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No daemon; a fleet file with three nodes and a task."""
    nodes: dict[str, object] = {name: {"kind": "robot"} for name in ("bob", "eve")}
    listen = {"control": "tcp/127.0.0.1:7457", "data": "tcp/127.0.0.1:7458"}
    nodes["ada"] = {"kind": "robot", "host": "127.0.0.1", "listen": listen}
    rule = {"from": "{robot}/map", "to": "{target}/merge/{robot}/map"}
    tasks = {"merge": {"candidates": {"kind": "robot"}, "weights": {"cpu": 1}, "inputs": [rule]}}
    (tmp_path / "fleet.yaml").write_text(json.dumps({"fleet": "hall", "nodes": nodes, "tasks": tasks}))
    monkeypatch.setenv("ZSCHED_CONFIG", str(tmp_path / "fleet.yaml"))
    monkeypatch.setenv("ZSCHED_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("ZSCHED_NODE", raising=False)


def offered(*words: str) -> list[str]:
    result = CliRunner().invoke(app, ["complete", "--", *words])
    assert (result.exit_code, result.stderr) == (0, "")
    return result.stdout.splitlines()


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("st",), ["status", "stream"]),
        (("stream", ""), ["bw", "hz", "list", "tail"]),
        (("status", "--v"), ["--verbose"]),
        (("stream", "list", "--win"), ["--window"]),
        (("tune", ""), ["merge"]),
        (("tune", "--json", "m"), ["merge"]),
        (("tune", "--revision", "3", "m"), ["merge"]),
        (("restart", "merge", ""), ["ada", "bob", "eve"]),
        (("status", "--node", "b"), ["bob"]),
        (("status", "-n", ""), ["ada", "bob", "eve"]),
        (("apply", "--accept", "remove-"), ["remove-node", "remove-task"]),
        (("up", "--log-level", "D"), ["DEBUG"]),
        (("check", ""), []),
        (("nothing", ""), []),
        (("restart", "merge", "bob", ""), []),
    ],
)
def test_the_next_word(words: tuple[str, ...], expected: list[str]) -> None:
    assert offered(*words) == expected


def test_all_verbs_are_offered_but_hidden_ones() -> None:
    assert {"status", "tune", "install"} <= set(offered(""))
    assert "complete" not in offered("")


def test_a_daemon_here_knows_the_names_better_than_the_file(tmp_path: Path) -> None:
    status = json.loads((RECORDED / "healthy.json").read_text())
    daemon = OperatorSocket(tmp_path / "robot1.sock", lambda _request: status)
    daemon.open()
    try:
        assert offered("status", "--node", "") == NODES
        assert offered("tune", "") == ["echo"]
    finally:
        daemon.close()


def test_without_a_daemon_and_a_file_nothing_is_offered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ZSCHED_CONFIG", str(tmp_path / "none.yaml"))
    assert offered("tune", "") == []


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_script_is_one_that_the_shell_can_read(shell: str) -> None:
    script = script_file(shell).read_text()
    assert " complete -- " in script
    program = shutil.which(shell)
    if program is None:
        pytest.skip(f"no {shell} here")
    done = subprocess.run([program, "-n"], input=script, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_bash_completes_a_task_s_name(tmp_path: Path) -> None:
    program = tmp_path / "zsched"
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -m zsched.cli "$@"\n')
    program.chmod(0o755)
    script = script_file("bash").read_text()
    script += f'COMP_WORDS=({program} tune m); COMP_CWORD=2; _zsched {program}; echo "${{COMPREPLY[@]}}"\n'
    done = subprocess.run(["bash"], input=script, capture_output=True, text=True, timeout=60, check=False)
    assert (done.stdout, done.stderr) == ("merge\n", "")
