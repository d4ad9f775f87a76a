"""Verbs that need no daemon, usage errors, help, and the manual: exit codes, and what goes to stdout and to stderr."""

from __future__ import annotations

import json
import os
import re
import signal
import threading
import time
from pathlib import Path
from typing import Any

import pytest
import typer.main
from typer.testing import CliRunner, Result

from support.authorities import install, make_authority
from zsched import __version__
from zsched.cli import app
from zsched.commands.look.ping import Question, _ways
from zsched.config.load import load_fleet
from zsched.host.machine import core_speed
from zsched.link.bus.node_ping import Pinged

RECORDED = Path(__file__).parent / "recorded_status"

FLEET = """
fleet: hall
nodes:
  robot1: {kind: robot, host: 127.0.0.1, listen: {control: tcp/127.0.0.1:7457, data: tcp/127.0.0.1:7458}}
  robot2: {kind: robot}
  robot3: {kind: robot}
tasks:
  merge:
    candidates: {kind: robot}
    weights: {cpu: 0.5, memory: 0.5}
    inputs: [{from: "{robot}/map", to: "{target}/merge/{robot}/map"}]
"""


@pytest.fixture(autouse=True)
def no_words_from_outside(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("ZSCHED_NODE", "ZSCHED_CONFIG", "ZSCHED_STATE_DIR", "STATE_DIRECTORY", "COLUMNS"):
        monkeypatch.delenv(name, raising=False)


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


# --- check, init, up, version, demo ----------------------------------------------------------------------------------


def test_check_of_a_good_file_counts_what_is_in_it(tmp_path: Path) -> None:
    file = tmp_path / "fleet.yaml"
    file.write_text(FLEET)
    result = run("check", file)
    assert (result.exit_code, result.stdout.partition("; hash ")[0]) == (0, "ok: 3 nodes, 1 task, 3 electors")
    assert len(result.stdout.splitlines()) == 1, "-v has the rules"
    body = json.loads(run("check", file, "--json").stdout)
    assert (body["schema"], body["ok"], body["faults"]) == ("zsched.check/1", True, [])
    assert body["fleet"] == {"name": "hall", "nodes": 3, "tasks": 1, "electors": 3}


@pytest.mark.parametrize(
    ("scheduling", "words"),
    [
        ("{}", ["share of its work", "leads by 0.05", "owes 0.3 s more (price_s)"]),
        ("{price_s: 0.7}", ["owes 0.7 s more (price_s)"]),
        ("{score: paper}", ["Eq. 1 and 2"]),
        ("{reach: all}", ["6 moves", "a robot cannot reach it", "the mean of the robots"]),
        ("{objective: latency, deadline_ms: 80}", ["within 80 ms"]),
    ],
)
def test_check_says_in_words_when_a_task_moves(tmp_path: Path, scheduling: str, words: list[str]) -> None:
    file = tmp_path / "fleet.yaml"
    weights = next(line for line in FLEET.splitlines() if "weights:" in line)
    file.write_text(FLEET.replace(weights, f"{weights}\n    scheduling: {scheduling}"))
    text = run("check", file, "-v").stdout
    assert [word for word in words if word not in text] == [], text


def test_check_of_a_bad_file_reports_every_fault_with_its_place_and_exits_with_78(tmp_path: Path) -> None:
    file = tmp_path / "fleet.yaml"
    file.write_text(FLEET.replace("kind: robot}\n  robot3", "kind: rowboat}\n  robot3").replace("cpu: 0.5", "cpu: 5"))
    text, as_json = run("check", file), run("check", file, "--json")
    assert (text.exit_code, as_json.exit_code) == (78, 78)
    assert (text.stdout, as_json.stderr) == ("", "")
    assert f"{file}:5:" in text.stderr
    assert f"{file}:10:" in text.stderr
    body = json.loads(as_json.stdout)
    assert (body["ok"], body["fleet"]) == (False, None)
    assert [fault["line"] for fault in body["faults"]] == [5, 10]
    assert {"line", "col", "message", "hint", "source_line"} == set(body["faults"][0])


def test_check_takes_the_file_that_up_would(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "fleet.yaml"
    file.write_text(FLEET)
    monkeypatch.setenv("ZSCHED_CONFIG", str(file))
    for arguments in (("check",), ("check", "-c", file), ("check", "--config", file)):
        assert run(*arguments).stdout.startswith("ok: 3 nodes, 1 task, 3 electors; hash ")
    monkeypatch.setenv("ZSCHED_CONFIG", str(tmp_path / "none.yaml"))
    result = run("check")
    assert result.exit_code == 78
    assert f"{tmp_path / 'none.yaml'}: error: cannot be read" in result.stderr


@pytest.mark.root
def test_check_of_a_file_that_only_another_may_read_says_whose_it_is(tmp_path: Path) -> None:
    file = tmp_path / "fleet.yaml"
    file.write_text(FLEET)
    file.chmod(0o600)
    os.chown(file, 65533, 65533)
    os.setegid(65534)
    os.seteuid(65534)
    try:
        for arguments in (("check", file), ("up", "--config", file, "--node", "robot1")):
            result = run(*arguments)
            assert result.exit_code == 78
            assert "Permission denied" in result.stderr
            assert "user 65534" in result.stderr
    finally:
        os.seteuid(0)
        os.setegid(0)


def test_check_of_what_is_no_file_answers_at_once(tmp_path: Path) -> None:
    """A pipe was waited for, and /dev/zero was a traceback."""
    os.mkfifo(tmp_path / "pipe")
    for path, kind in ((tmp_path / "pipe", "a pipe"), (Path("/dev/zero"), "a device"), (tmp_path, "a folder")):
        for arguments in (("check", path), ("up", "--config", path, "--node", "robot1")):
            result = run(*arguments)
            assert result.exit_code == 78
            assert f"cannot be read: it is {kind}, not a regular file" in result.stderr


def test_check_of_thousands_of_rules_ends_in_seconds(tmp_path: Path) -> None:
    """Checked, or refused for their size with what to do: 8000 took over a minute."""
    file = tmp_path / "fleet.yaml"
    for count, code in ((2000, 0), (8000, 78)):
        rules = "".join(
            f'      - {{from: "{{robot}}/i{i}", to: "{{target}}/m/{{robot}}/i{i}"}}\n' for i in range(count)
        )
        file.write_text(FLEET[: FLEET.index("    inputs")] + f"    inputs:\n{rules}")
        began = time.process_time()
        result = run("check", file)
        assert result.exit_code == code, result.stderr[:500]
        assert time.process_time() - began < 20.0
    assert "it holds more than 256 KiB" in result.stderr
    assert "write {robot} and {target}" in result.stderr


def test_init_creates_the_state_once(tmp_path: Path) -> None:
    file, state = tmp_path / "fleet.yaml", tmp_path / "state"
    file.write_text(FLEET)
    place = ("--config", file, "--node", "robot1", "--state-dir", state)
    arguments, anew = ("init", *place), ("fleet", "recover", *place, "--generation", 1)
    first, second = run(*arguments), run(*arguments)
    assert first.exit_code == 0
    speed, path = first.stdout.splitlines()
    assert speed == f"a core of this machine has speed {core_speed.kept(state):.2f}"
    assert path == f"{state}/state: blank state of robot1 in fleet hall, generation 0"
    said = f"{state}: robot1 has its state in fleet hall, generation 0: nothing to do\n"
    assert (second.exit_code, second.stdout) == (0, said)
    assert run(*anew, "--force").exit_code == 0
    before = (state / "state").read_bytes()
    for again in (arguments, anew):
        assert "generation 1: nothing to do" in run(*again).stdout
    assert (state / "state").read_bytes() == before


def test_a_new_generation_keeps_a_good_state_unless_told(tmp_path: Path) -> None:
    """Nobody answers here, so nobody says that the fleet needs a new generation."""
    file, state = tmp_path / "fleet.yaml", tmp_path / "state"
    file.write_text(FLEET)
    place = ("--config", file, "--node", "robot2", "--state-dir", state)
    arguments = ("fleet", "recover", *place)
    assert run("init", *place).exit_code == 0
    before = (state / "state").read_bytes()
    refused = run(*arguments, "--generation", 1)
    assert (refused.exit_code, refused.stdout) == (1, "")
    assert "robot2 has a good state of generation 0 here, and no other node answered" in refused.stderr
    assert "on another node, has said so, stop every daemon and add --force" in refused.stderr
    assert (state / "state").read_bytes() == before
    done = run(*arguments, "--generation", 2, "--force")
    assert (done.exit_code, done.stderr.count("asked 1 other node: none answered")) == (0, 1), done.stderr
    older = run(*arguments, "--generation", 1, "--force")
    assert older.exit_code == 1
    assert "which is newer than 1" in older.stderr


def test_a_recovery_with_force_alone_is_a_usage_error(tmp_path: Path) -> None:
    file = tmp_path / "fleet.yaml"
    file.write_text(FLEET)
    place = ("--config", file, "--node", "robot1", "--state-dir", tmp_path / "state")
    result = run("fleet", "recover", *place, "--force")
    assert result.exit_code == 2
    assert "--generation" in result.stderr
    assert not (tmp_path / "state").exists()


def test_init_of_a_secured_fleet_that_nobody_answers_for_warns_of_an_old_file(tmp_path: Path) -> None:
    """The file that `fleet create` wrote names the founder alone: whoever lost its state would be a fleet of one."""
    file = tmp_path / "fleet.yaml"
    install(make_authority(tmp_path / "authority", "hall"), tmp_path / "pki", "robot1")
    file.write_text("fleet: hall\nsecurity: {}\nnodes:\n  robot1: {kind: robot}\ntasks: {}\n")
    told = run("init", "--config", file, "--node", "robot1", "--state-dir", tmp_path / "state")
    assert told.exit_code == 0
    assert f"take {tmp_path / 'state' / 'state'} away, bring here what `zsched fleet export` writes" in told.stderr


@pytest.mark.parametrize(
    "words", [("init",), ("fleet", "recover", "--generation", 1)], ids=["plain", "as the old advice"]
)
def test_init_in_another_nodes_folder_says_whose_it_is_and_leaves_it(tmp_path: Path, words: tuple[object, ...]) -> None:
    file, state = tmp_path / "fleet.yaml", tmp_path / "state"
    file.write_text(FLEET)
    place = ("--config", file, "--state-dir", state)
    assert run("init", *place, "--node", "robot1").exit_code == 0
    before = (state / "state").read_bytes()
    result = run(*words, *place, "--node", "robot2")
    assert (result.exit_code, result.stdout) == (1, "")
    assert "belongs to the node 'robot1', not 'robot2', and is left as it is" in result.stderr
    assert "give robot2 a folder of its own with --state-dir, or say with --node robot1" in result.stderr
    assert "--generation" not in result.stderr
    assert (state / "state").read_bytes() == before


@pytest.mark.parametrize(("name", "said"), [("robt2", "did you mean 'robot2'? Say which"), ("hut", "); say which")])
def test_init_of_a_name_that_is_not_in_the_file_suggests_the_nearest(tmp_path: Path, name: str, said: str) -> None:
    file = tmp_path / "fleet.yaml"
    file.write_text(FLEET)
    result = run("init", "--config", file, "--node", name, "--state-dir", tmp_path / "state")
    assert result.exit_code == 2
    assert f"no node {name!r} under 'nodes' (there are robot1, robot2, robot3); " in result.stderr
    assert said in result.stderr


def test_demo_hands_its_options_on_to_the_lab() -> None:
    """The lab refuses an impossible duration before it starts anything."""
    result = run("demo", "--headless", "--duration", "1")
    assert result.exit_code == 2


def test_version_names_what_a_bug_report_needs() -> None:
    body = json.loads(run("version", "--json").stdout)
    assert body["schema"] == "zsched.version/1"
    assert body["zsched"] == __version__
    assert {"wire", "zenoh", "python"} < set(body)
    assert run("version").stdout.splitlines()[0] == f"zsched {__version__}"


@pytest.mark.parametrize("verb", ["up", "init", "status", "tune", "stream", "check", "demo", "version"])
def test_help_of_every_verb_fits_a_small_terminal(verb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    result = run(verb, "--help")
    assert result.exit_code == 0
    assert result.stdout.startswith("Usage: ")
    assert max(map(len, result.stdout.splitlines())) <= 80
    assert re.search(rf"^ +{verb} ", run("--help-all").stdout, re.MULTILINE)


# --- what is written about it ----------------------------------------------------------------------------------------


def test_the_manual_has_the_verbs_and_the_exit_codes() -> None:
    manual = (Path(__file__).parents[3] / "docs" / "guide" / "cli.md").read_text()
    for verb in ("up", "init", "status", "tune", "check", "demo", "version"):
        assert f"| `zsched {verb}` |" in manual
    for code in (0, 1, 2, 3, 4, 5, 10, 75, 78, 79):
        assert f"\n| {code} | " in manual


def test_the_manual_names_every_field_of_the_status() -> None:
    manual = (Path(__file__).parents[3] / "docs" / "guide" / "cli.md").read_text()
    (row,) = [line for line in manual.splitlines() if "`zsched.status/1`" in line]
    fields = json.loads((RECORDED / "healthy.json").read_text()).keys() - {"schema"} | {"degraded"}
    assert fields == set(row.split("|")[3].strip(" `").split())


@pytest.mark.parametrize(
    ("verb", "usage", "argument"),
    [
        ("move", "[OPTIONS] TASK NODE", "TASK"),
        ("history", "[OPTIONS] [TASK]", "[TASK]"),
        ("drain", "[OPTIONS] [NODE]...", "[NODE]..."),
        ("restart", "[OPTIONS] TASK [NODE]", "TASK"),
        ("tune", "[OPTIONS] [TASK] [KEY=VALUE]...", "[KEY=VALUE]..."),
        ("dev", "[OPTIONS] [FILE]", "[FILE]"),
        ("status", "[OPTIONS]", ""),
    ],
)
def test_help_shows_arguments_as_they_are_typed(verb: str, usage: str, argument: str) -> None:
    told = run(verb, "--help").stdout
    assert told.splitlines()[0] == f"Usage: zsched {verb} {usage}"
    assert ("Arguments:" in told, f"\n  {argument}  " in told) == (bool(argument), bool(argument))
    assert "<" not in told.partition("Options:")[0], "no type of Python's"


def test_every_argument_of_every_verb_says_how_it_is_typed() -> None:
    group: Any = typer.main.get_command(app)
    verbs = list(group.commands.values())
    verbs += [verb for one in verbs for verb in getattr(one, "commands", {}).values()]
    arguments = [(verb.name, one) for verb in verbs for one in verb.params if one.param_type_name == "argument"]
    assert len(arguments) > 20
    assert [(verb, one.name) for verb, one in arguments if not one.metavar] == []


def test_ctrl_c_ends_a_ping_that_waits_for_answers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It waited for every answer that was still to come: minutes, where nobody answers."""
    end, under_way = threading.Event(), threading.Event()

    def ask(*_given: object, **_more: object) -> Pinged:
        under_way.set()
        end.wait(60.0)
        return Pinged()

    def interrupt(_number: int, _frame: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("zsched.commands.look.ping.measure", ask)
    (tmp_path / "fleet.yaml").write_text(FLEET)
    fleet = load_fleet(tmp_path / "fleet.yaml")
    before = signal.signal(signal.SIGALRM, interrupt)
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.2)
        began = time.monotonic()
        with pytest.raises(KeyboardInterrupt):
            list(_ways(fleet, "robot2", Question(node="robot1", count=1000, timeout_s=1.0, interval_s=0.2)))
        assert under_way.is_set()
        assert time.monotonic() - began < 30.0
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
        end.set()
