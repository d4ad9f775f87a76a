"""The small real fleet: its file is valid, its daemons come, answer and go, whatever happens inside."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import pytest

from zsched.config.load import load_fleet
from zsched.core.values.errors import AdapterError
from zsched.host.state_file import StateFile
from zsched_lab.fleet import testbed
from zsched_lab.fleet.loopback import own_address
from zsched_lab.fleet.testbed import TASK, Testbed, TestbedError, echo_fleet


def is_there(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


def small(folder: Path) -> Testbed:
    """One robot, one edge."""
    return Testbed(folder, echo_fleet(robots=1, edges=1))


# --- the file --------------------------------------------------------------------------------------------------------


def test_file_is_valid_and_every_session_has_a_port_of_its_own(tmp_path: Path) -> None:
    bed = Testbed(tmp_path, echo_fleet())
    assert load_fleet(bed.file) == bed.fleet
    assert bed.names == ("edge1", "edge2", "edge3", "robot1", "robot2", "robot3")
    endpoints = [end for node in bed.fleet.nodes for end in (node.listen_control, node.listen_data)]
    assert len(set(endpoints)) == 12
    assert all(end.startswith(f"tcp/{own_address()}:") for end in endpoints)


def test_init_gives_every_node_a_state_of_its_own(tmp_path: Path) -> None:
    bed = small(tmp_path)
    bed.init()
    for name in bed.names:
        loaded = StateFile(tmp_path / name, fleet="testbed", node=name).load()
        assert loaded.state is not None, loaded.problem
        assert loaded.state.node == name


# --- waiting ---------------------------------------------------------------------------------------------------------


def test_wait_returns_what_came_true_and_takes_silence_for_not_yet(tmp_path: Path) -> None:
    bed = small(tmp_path)
    answers = iter([AdapterError("not up yet"), None, "", "there"])

    def condition() -> str | None:
        answer = next(answers)
        if isinstance(answer, AdapterError):
            raise answer
        return answer

    assert bed.wait(condition, 60, "an answer") == "there"


def test_wait_ends_at_its_deadline_and_says_for_what(tmp_path: Path) -> None:
    bed = small(tmp_path)
    start = time.monotonic()
    with pytest.raises(TestbedError, match=r"waited 0\.05 s for godot"):
        bed.wait(lambda: False, 0.05, "godot")
    assert time.monotonic() - start < 30.0
    with pytest.raises(ZeroDivisionError):  # a mistake in a test is no "not yet"
        bed.wait(lambda: 1 // 0, 5, "nothing")


def test_wait_tells_at_once_that_a_daemon_has_ended_and_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    broken = "import sys; print('no port for me', file=sys.stderr); sys.exit(7)"
    monkeypatch.setattr(testbed, "DAEMON", (testbed.DAEMON[0], "-c", broken))
    with small(tmp_path) as bed:
        bed.start("robot1")
        start = time.monotonic()
        with pytest.raises(TestbedError, match=r"(?s)for godot, but .*: robot1 with 7\n--- robot1\nno port for me"):
            bed.wait(lambda: False, 60, "godot")
        assert time.monotonic() - start < 30.0
        assert bed.wait(lambda: bed.has_ended("robot1"), 60, "what the condition itself looks for")


# --- daemons ---------------------------------------------------------------------------------------------------------


def test_fleet_settles_loses_a_node_and_leaves_nothing_behind(tmp_path: Path) -> None:
    with small(tmp_path) as bed:
        bed.init()
        bed.start()
        assert bed.wait_settled() == "edge1"
        pids = {name: bed.pid(name) for name in bed.names}
        assert bed.status("robot1")["node"] == "robot1"
        assert (bed.task("robot1")["name"], bed.task("robot1")["owner"]) == (TASK, "edge1")
        assert bed.owner("robot1") == "edge1"
        assert "ready node=robot1" in bed.log("robot1")

        bed.kill("edge1")
        assert not is_there(pids["edge1"])
        with pytest.raises(AdapterError):
            bed.status("edge1")
        with pytest.raises(TestbedError, match="--- robot1\n"):
            bed.wait(lambda: False, 0.01, "something")

        bed.send("robot1", signal.SIGSTOP)
        ((code, _),) = bed.stop("robot1", within_s=60.0).values()
        assert code == 0, "a stopped one is woken up to end in order"
    assert not any(is_there(pid) for pid in pids.values())


def test_daemons_go_when_the_test_inside_fails(tmp_path: Path) -> None:
    bed, pids = small(tmp_path), []

    def fail() -> None:
        with bed:
            bed.start("robot1")
            pids.append(bed.pid("robot1"))
            assert is_there(pids[0])
            raise RuntimeError("inside")

    with pytest.raises(RuntimeError, match="inside"):
        fail()
    assert not is_there(pids[0])


def test_daemon_that_does_not_stop_is_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its exit code tells."""
    ignores = "signal.signal(signal.SIGTERM, signal.SIG_IGN)"
    says = "print('up', file=sys.stderr, flush=True)"
    stubborn = f"import signal, sys, time; {ignores}; {says}; time.sleep(60)"
    monkeypatch.setattr(testbed, "DAEMON", (testbed.DAEMON[0], "-c", stubborn))
    with small(tmp_path) as bed:
        bed.start("robot1")
        bed.wait(lambda: "up" in bed.log("robot1"), 60, "the stubborn one")
        assert bed.stop("robot1", within_s=0.2)["robot1"][0] == -signal.SIGKILL
    assert os.path.lexists(tmp_path / "robot1.log")
