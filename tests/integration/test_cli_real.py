"""The command line against real daemons that it started itself, each verb as the process an operator would run."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from support.waiting import within
from zsched_lab.fleet.testbed import echo_fleet

CLI = (sys.executable, "-m", "zsched.cli")
VERB_S, UP_S = 20.0, 30.0
STOP_S = 4.0
"""The goal is 2 s; tests share their machine."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Site:
    """One machine of the fleet: its name in the fleet file and its folders."""

    file: Path
    node: str
    state: Path
    runtime: Path

    def environment(self) -> dict[str, str]:
        words = {"ZSCHED_CONFIG": self.file, "ZSCHED_NODE": self.node, "ZSCHED_STATE_DIR": self.state}
        words["ZSCHED_RUNTIME_DIR"] = self.runtime
        kept = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "NO_COLOR")}
        return kept | {name: str(value) for name, value in words.items()}

    def zsched(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run one verb to its end."""
        command = [*CLI, *arguments]
        return subprocess.run(
            command, env=self.environment(), capture_output=True, text=True, timeout=VERB_S, check=False
        )

    def status(self, *arguments: str) -> dict[str, Any]:
        """``zsched status --json``, empty while nobody answers."""
        out = self.zsched("status", "--json", *arguments).stdout
        body: dict[str, Any] = json.loads(out) if out else {}
        return body

    @contextlib.contextmanager
    def up(self) -> Iterator[subprocess.Popen[bytes]]:
        """``zsched up`` while the block runs; its stderr goes to ``up.log`` beside the state."""
        with (
            self.state.with_suffix(".log").open("ab") as log,
            subprocess.Popen([*CLI, "up"], env=self.environment(), stdin=subprocess.DEVNULL, stderr=log) as process,
        ):
            try:
                yield process
            finally:
                if process.poll() is None:
                    process.terminate()
                    with contextlib.suppress(subprocess.TimeoutExpired):
                        process.wait(60)
                process.kill()

    def log(self) -> str:
        return self.state.with_suffix(".log").read_text()

    def wait_owner(self) -> dict[str, Any]:
        """The first status in which the task has its owner."""
        end = time.monotonic() + UP_S
        while time.monotonic() < end:
            status = self.status()
            if status and status["tasks"][0]["owner"] and status["quorum"]["ok"]:
                return status
        raise AssertionError(f"no owner within {UP_S:g} s\n{self.log()}")


def sites(folder: Path, robots: int = 1, edges: int = 0, timing: str = "wifi") -> list[Site]:
    """The machines of a fleet whose daemons share no folder, so that no socket but its own is at hand."""
    tree = echo_fleet(robots=robots, edges=edges, timing=timing)
    file = folder / "fleet.yaml"
    file.write_text(json.dumps(tree))
    found = []
    for number, node in enumerate(tree["nodes"]):
        runtime = folder / f"r{number}"
        runtime.mkdir()
        found.append(Site(file=file, node=node, state=folder / f"{node}.state", runtime=runtime))
    return found


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    """A fleet of one robot, initialised and up, whose task has its owner."""
    (only,) = sites(tmp_path_factory.mktemp("one"))
    done = only.zsched("init")
    assert done.returncode == 0, done.stderr
    with only.up():
        only.wait_owner()
        yield only


# --- a running daemon ------------------------------------------------------------------------------------------------


def test_status_of_a_running_fleet_for_people_and_for_scripts(site: Site) -> None:
    text, as_json = site.zsched("status", "-v"), site.zsched("status", "--json")
    assert (text.returncode, as_json.returncode) == (0, 0), text.stderr
    assert "robot1 owns it" in text.stdout
    for stage in ("PROFILE", "GATEWAY", "SCHEDULER", "VOTE", "EXECUTOR", "ROUTE"):
        assert f"\n{stage} " in text.stdout
    assert "\x1b" not in text.stdout
    body = json.loads(as_json.stdout)
    assert (body["schema"], body["fleet"], body["node"]) == ("zsched.status/1", "testbed", "robot1")


def test_status_on_a_terminal_has_colour_unless_told_otherwise(site: Site) -> None:
    assert "\x1b[" in on_terminal(site)
    assert "\x1b[" not in on_terminal(site, NO_COLOR="1")
    assert "\x1b[" not in on_terminal(site, TERM="dumb")


def on_terminal(site: Site, **environment: str) -> str:
    """What ``zsched status`` writes when its stdout is a terminal."""
    controller, terminal = os.openpty()
    try:
        words = {**site.environment(), "TERM": "xterm", **environment}
        subprocess.run([*CLI, "status"], env=words, stdout=terminal, timeout=VERB_S, check=True)
        return os.read(controller, 1 << 16).decode()
    finally:
        os.close(controller)
        os.close(terminal)


def test_watch_gives_newer_and_newer_statuses(site: Site) -> None:
    command = [*CLI, "status", "--watch", "--json", "--interval", "0.2"]
    with subprocess.Popen(command, env=site.environment(), stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        ages = [json.loads(process.stdout.readline())["up_s"] for _ in range(3)]
        process.send_signal(signal.SIGINT)
        assert process.wait(VERB_S) == 0
    assert ages == sorted(set(ages))


def test_weights_are_agreed_shown_and_refused_on_an_old_revision(site: Site) -> None:
    (before,) = json.loads(site.zsched("tune", "echo", "--json").stdout)["tasks"]
    changed = site.zsched("tune", "echo", "cpu=0.6", "memory=0.4", "--yes", "--json")
    assert changed.returncode == 0, changed.stderr
    (body,) = json.loads(changed.stdout)["tasks"]
    assert body["outcome"] == "ok"
    assert body["revision"] > before["revision"]
    assert site.status()["tasks"][0]["tuning"]["weights"] == {"cpu": 0.6, "memory": 0.4, "network": 0.0, "gauges": {}}

    again = site.zsched("tune", "echo", "cpu=0.6", "memory=0.4")
    assert (again.returncode, again.stdout) == (0, "Nothing would change.\n")
    old = site.zsched("tune", "echo", "cpu=1", "memory=0", "--yes", "--revision", str(before["revision"]))
    assert old.returncode == 1
    assert "conflict" in old.stderr
    unknown = site.zsched("tune", "ecko", "cpu=1")
    assert unknown.returncode == 2
    assert "echo" in unknown.stderr


def test_second_daemon_in_the_same_folders_is_refused(site: Site) -> None:
    second = site.zsched("up")
    assert second.returncode == 1
    assert "in use by process" in second.stderr
    assert "Traceback" not in second.stderr


def test_a_new_generation_under_a_running_daemon_is_refused(site: Site) -> None:
    refused = site.zsched("fleet", "recover", "--generation", "1")
    assert refused.returncode == 1
    assert "stop that daemon first" in refused.stderr


# --- start and stop --------------------------------------------------------------------------------------------------


def test_up_keeps_its_process_id_and_ends_cleanly_on_sigterm(tmp_path: Path) -> None:
    """What systemd started is what it stops: the command line became the daemon, which takes its children along."""
    (only,) = sites(tmp_path)
    assert only.zsched("init").returncode == 0
    with only.up() as process:
        only.wait_owner()
        words = Path(f"/proc/{process.pid}/cmdline").read_bytes().split(b"\0")
        assert b"zsched.daemon" in words
        start = time.monotonic()
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 0
        within(time.monotonic() - start, STOP_S)
    gone = only.zsched("status")
    assert gone.returncode == 3
    assert "zsched up" in gone.stderr
    assert "Traceback" not in only.log()


def test_up_without_state_starts_and_says_how_to_make_it_an_elector(tmp_path: Path) -> None:
    (only,) = sites(tmp_path)
    with only.up():
        end = time.monotonic() + UP_S
        while not (status := only.status()):
            assert time.monotonic() < end, only.log()
        assert status["quorum"]["this_node"] == "lost_state"
        shown = only.zsched("status")
    assert shown.returncode == 4
    assert "DEGRADED" in shown.stdout
    assert "no quorum" in shown.stdout
    assert "never initialised" in shown.stdout
    assert f"zsched init --config {only.file} --node robot1" in only.log()


def test_up_with_faults_in_the_fleet_file_ends_with_78_and_names_them(tmp_path: Path) -> None:
    (only,) = sites(tmp_path)
    only.file.write_text("fleet: hall\nnodes: {robot1: {kind: rowboat}}\ntasks: {}\n")
    done = only.zsched("up")
    assert (done.returncode, done.stdout) == (78, "")
    assert f"{only.file}:2:" in done.stderr
    assert "Traceback" not in done.stderr


# --- more than one node ----------------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("is_elsewhere", [False, True], ids=["here", "connect"])
def test_an_order_without_a_quorum_is_told_so_by_the_slowest_timing(tmp_path: Path, *, is_elsewhere: bool) -> None:
    """Its round goes on for 6 s; it is no loop that hangs, and no daemon that is not there."""
    here = sites(tmp_path, robots=3, timing="wan")[0]
    assert here.zsched("init").returncode == 0
    endpoint = json.loads(here.file.read_text())["nodes"][here.node]["listen"]["control"]
    with here.up():
        end = time.monotonic() + UP_S
        while not (status := here.status()):
            assert time.monotonic() < end, here.log()
        assert (status["quorum"]["this_node"], status["quorum"]["ok"]) == ("elector", False)
        refused = here.zsched("pause", "echo", "--yes", *(("--connect", endpoint) if is_elsewhere else ()))
    assert refused.returncode == 4, refused.stderr
    assert "echo: no majority of the electors answered; nothing was changed" in refused.stderr
    assert "nothing was changed" in refused.stderr


def look_from_a_machine_without_a_daemon(folder: Path, here: Site, there: Site) -> None:
    """Through one node's endpoint every node is asked, in every way that changes nothing."""
    (folder / "laptop").mkdir()
    laptop = replace(here, node="laptop", runtime=folder / "laptop")
    endpoint = json.loads(here.file.read_text())["nodes"][here.node]["listen"]["control"]
    assert laptop.zsched("status").returncode == 3
    assert laptop.status("--connect", endpoint)["node"] == here.node, "the one at the endpoint"
    assert laptop.status("--connect", endpoint, "--node", there.node)["node"] == there.node
    for verb in (
        ("wait", "--until", "settled=echo"),
        ("metrics", "print"),
        ("tune", "echo"),
        ("stream", "list", "--node", there.node, "--window", "0.2"),
    ):
        done = laptop.zsched(*verb, "--connect", endpoint)
        assert (done.returncode, done.stderr) == (0, ""), verb
    silent = laptop.zsched("logs", "echo", "--connect", endpoint)
    assert (silent.returncode, silent.stdout, "has printed nothing" in silent.stderr) == (0, "", True), silent
    unknown = laptop.zsched("status", "--connect", endpoint, "--node", "robot9")
    assert (unknown.returncode, "robot9 did not answer within 3 s" in unknown.stderr) == (3, True)


@pytest.mark.long
def test_a_worker_is_restarted_through_another_node_and_what_it_prints_is_shown(tmp_path: Path) -> None:
    robot, edge = sites(tmp_path, robots=1, edges=1)
    tree = json.loads(robot.file.read_text())
    echo = f"echo it starts; exec {sys.executable} -m zsched.tasks.echo"
    tree["tasks"]["echo"]["worker"]["command"] = ["sh", "-c", echo]
    robot.file.write_text(json.dumps(tree))
    with contextlib.ExitStack() as stack:
        for site in (robot, edge):
            assert site.zsched("init").returncode == 0
            stack.enter_context(site.up())
        assert robot.zsched("wait", "--until", "settled=echo", "--timeout", f"{UP_S:g}").returncode == 0
        assert robot.zsched("logs", "echo").stdout.count("it starts") == 1
        refused = robot.zsched("restart", "echo")
        assert (refused.returncode, "--yes" in refused.stderr) == (2, True)
        done = robot.zsched("restart", "echo", edge.node, "--yes")
        assert done.returncode == 0, done.stderr
        end = time.monotonic() + UP_S
        while robot.zsched("logs", "echo", edge.node).stdout.count("it starts") < 2:
            assert time.monotonic() < end, robot.log()
        assert robot.zsched("wait", "--until", "settled=echo", "--timeout", f"{UP_S:g}").returncode == 0
        assert robot.zsched("logs", "echo", robot.node).returncode == 1


@pytest.mark.long
def test_any_node_of_the_fleet_can_be_asked_through_the_one_here(tmp_path: Path) -> None:
    here, there = sites(tmp_path, robots=1, edges=1)[::-1]
    with contextlib.ExitStack() as stack:
        for site in (here, there):
            assert site.zsched("init").returncode == 0
            stack.enter_context(site.up())
        there.wait_owner()
        here.wait_owner()
        assert (here.node, there.node) == ("edge1", "robot1")
        asked = here.status("--node", there.node)
        assert asked["node"] == there.node
        assert asked["tasks"][0]["decision"] is not None, "an edge does not decide, the robot does"
        changed = here.zsched("tune", "echo", "cpu=0.7", "memory=0.3", "--yes", "--node", there.node)
        assert changed.returncode == 0, changed.stderr
        look_from_a_machine_without_a_daemon(tmp_path, here, there)
        nowhere = here.zsched("status", "--node", "robot9")
        assert nowhere.returncode == 2
        assert "robot1" in nowhere.stderr


def test_a_paused_task_is_moved_by_order_and_every_node_says_who_did_it(tmp_path: Path) -> None:
    edge1, edge2, robot = sorted(sites(tmp_path, robots=1, edges=2), key=lambda site: site.node)
    with contextlib.ExitStack() as stack:
        for site in (robot, edge1, edge2):
            assert site.zsched("init").returncode == 0
            stack.enter_context(site.up())
        assert robot.zsched("wait", "--until", "settled=echo", "--timeout", f"{UP_S:g}").returncode == 0
        owner = robot.status()["tasks"][0]["owner"]
        there = edge1 if owner == edge2.node else edge2
        end = time.monotonic() + UP_S
        while (plan := robot.zsched("move", "echo", there.node, "--plan")).returncode != 10:
            assert time.monotonic() < end, plan.stderr  # its worker is still starting
        paused = there.zsched("pause", "echo", "-m", "new lens", "--yes")
        assert paused.returncode == 0, paused.stderr
        moved = robot.zsched("move", "echo", there.node, "--from", owner, "-m", "by hand", "--yes", "--json")
        assert moved.returncode == 0, moved.stderr
        body = json.loads(moved.stdout)
        assert (body["from"], body["to"], body["settled"], body["lost"], body["doubled"]) == (
            owner,
            there.node,
            True,
            0,
            0,
        )
        assert body["switched_s"] is not None
        assert body["gap_s"] is None, "nothing flows"
        for site in (robot, edge1, edge2):
            end = time.monotonic() + UP_S
            while (task := site.status()["tasks"][0])["owner"] != there.node:
                assert time.monotonic() < end, task
            assert task["history"][-1]["by"].endswith("@robot1")
            assert task["pause"]["reason"] == "new lens"
            (move,) = json.loads(site.zsched("history", "echo", "--json").stdout)["moves"][-1:]
            assert move["reason"].startswith("moved by ")
            assert move["reason"].endswith("@robot1 (by hand)")
        assert "echo: paused by " in there.zsched("status").stdout
        resumed = robot.zsched("resume", "echo", "--yes")
        assert resumed.returncode == 0, resumed.stderr
        assert robot.zsched("pause").stdout == "no task is paused\n"


# --- why, and what was ------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_a_move_is_explained_remembered_and_judged_again(tmp_path: Path) -> None:
    """The owner is told to stop; its robot says why the task went, also after a restart, and can show it again."""
    edge1, edge2, robot = sorted(sites(tmp_path, robots=1, edges=2), key=lambda site: site.node)
    with contextlib.ExitStack() as stack:
        processes = {}
        for site in (robot, edge1, edge2):
            assert site.zsched("init").returncode == 0
            processes[site.node] = stack.enter_context(site.up())
        owner = robot.wait_owner()["tasks"][0]["owner"]
        end = time.monotonic() + UP_S
        body: dict[str, Any] = {}
        while body.get("owner") != owner:  # the last judgement may be the one that led to the first placement
            assert time.monotonic() < end, body
            explained = robot.zsched("explain", "echo", "--json")
            assert explained.returncode == 0, explained.stderr
            body = json.loads(explained.stdout)
        assert (body["schema"], body["node"]) == ("zsched.explain/1", "robot1")
        for one in body["candidates"]:
            if one["total"] is not None:
                assert one["total"] == one["joint"] - one["unkept"] + one["bonus"]
        plan = robot.zsched("explain", "echo", "--plan", f"{owner}=down")
        assert plan.returncode == 10, plan.stderr
        assert f"{owner} is gone" in plan.stdout
        here = edge1 if owner == "edge2" else edge2
        passed_on = here.zsched("explain", "echo")
        assert passed_on.returncode == 0, passed_on.stderr
        assert "as robot1 judged it" in passed_on.stdout

        processes[owner].send_signal(signal.SIGTERM)
        assert processes[owner].wait(60) == 0
        end = time.monotonic() + UP_S
        while (newest := robot.wait_owner()["tasks"][0]["owner"]) == owner:
            assert time.monotonic() < end, robot.log()
        moves = json.loads(robot.zsched("history", "echo", "--json").stdout)["moves"]
        assert [(move["from"], move["to"]) for move in moves][-1] == (owner, newest)
        assert f"{owner} is draining" in moves[-1]["reason"]
        assert moves[-1]["votes"] == {"robot1": newest}
        past = json.loads(robot.zsched("explain", "echo", "--at", str(moves[-1]["epoch"]), "--json").stdout)
        assert (past["outcome"], past["candidate"], past["made"]["to"]) == ("propose", newest, newest)
        assert past["owner"] == owner
        seen = robot.zsched("explain", "echo", "--robot", "robot1")
        assert seen.returncode == 0, seen.stderr
        assert "HEARS      robots robot1" in seen.stdout
        told = robot.zsched("events", "--about", "task/echo", "--since", "1h")
        assert f"propose {newest}: {owner} is draining" in told.stdout
        assert "settled on" in told.stdout or "flipped to" in told.stdout

        processes["robot1"].send_signal(signal.SIGTERM)
        processes["robot1"].wait(60)
        stack.enter_context(robot.up())
        robot.wait_owner()
        kept = json.loads(robot.zsched("history", "--json").stdout)["moves"]
        assert kept[: len(moves)] == [{**move, "age_s": old["age_s"]} for move, old in zip(moves, kept, strict=False)]
        again = robot.zsched("explain", "--replay", str(robot.state / "decisions.ndjson"))
        assert again.returncode == 0, again.stdout
        assert int(again.stdout.split(" ")[0]) >= 3
        changed = tmp_path / "changed.ndjson"
        text = (robot.state / "decisions.ndjson").read_text()
        assert '"spent":0.0' not in text, "defaults are left out"
        changed.write_text(text.replace('"outcome":"propose"', '"outcome":"stay"', 1))
        differs = robot.zsched("explain", "--replay", str(changed))
        assert differs.returncode == 1
        assert "and again" in differs.stdout
