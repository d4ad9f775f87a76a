"""What is left in a stopped service's control group is ended, but a relay for which a daemon comes."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from support.waiting import until
from zsched.runtime.cleanup import GROUPS, end_all, members, own_group, spares_relay


@pytest.mark.parametrize(
    ("said", "spares"),
    [
        ({"SERVICE_RESULT": "success", "EXIT_CODE": "exited", "EXIT_STATUS": "0"}, True),
        ({"SERVICE_RESULT": "signal", "EXIT_CODE": "killed", "EXIT_STATUS": "KILL"}, True),
        ({"SERVICE_RESULT": "watchdog", "EXIT_CODE": "dumped", "EXIT_STATUS": "ABRT"}, True),
        ({"SERVICE_RESULT": "exit-code", "EXIT_CODE": "exited", "EXIT_STATUS": "1"}, True),
        ({"SERVICE_RESULT": "timeout", "EXIT_CODE": "killed", "EXIT_STATUS": "KILL"}, False),
        ({"SERVICE_RESULT": "exit-code", "EXIT_CODE": "exited", "EXIT_STATUS": "2"}, False),
        ({"SERVICE_RESULT": "exit-code", "EXIT_CODE": "exited", "EXIT_STATUS": "78"}, False),
        ({"SERVICE_RESULT": "success", "EXIT_CODE": "exited", "EXIT_STATUS": "79"}, False),
    ],
    ids=[
        "stopped or restarted",
        "killed",
        "wedged",
        "failed",
        "hung at the stop",
        "a wrong word",
        "misconfigured",
        "left",
    ],
)
def test_a_relay_is_spared_when_a_daemon_follows(said: dict[str, str], *, spares: bool) -> None:
    assert spares_relay(said) is spares


def test_the_own_control_group_of_either_version() -> None:
    assert own_group("0::/system.slice/zsched.service\n") == GROUPS / "system.slice/zsched.service"
    first = "12:cpu:/x\n1:name=systemd:/system.slice/zsched.service\n0::/\n"
    assert own_group(first) == GROUPS / "systemd/system.slice/zsched.service"
    assert own_group("0::/\n") is None  # never the whole machine


@pytest.fixture
def group(request: pytest.FixtureRequest) -> Iterator[Path]:
    """A control group of our own, where one can be made."""
    root = next((path for path in (GROUPS / "systemd", GROUPS) if (path / "cgroup.procs").exists()), GROUPS)
    path = root / f"zsched-test-{abs(hash(request.node.nodeid))}"
    try:
        path.mkdir()
    except OSError as error:
        pytest.skip(f"no control group can be made here: {error}")
    try:
        yield path
    finally:
        until(lambda: not members(path), "the group is empty")
        path.rmdir()


def test_all_but_the_spared_are_ended(group: Path) -> None:
    sleepers = [subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"]) for _ in range(3)]
    try:
        for sleeper in sleepers:
            (group / "cgroup.procs").write_text(str(sleeper.pid))
        spared, *others = sleepers
        assert sorted(end_all(group, frozenset({spared.pid}))) == sorted(other.pid for other in others)
        assert [other.wait(60) for other in others] == [-9, -9]
        assert spared.poll() is None
    finally:
        for sleeper in sleepers:
            sleeper.kill()
            sleeper.wait(60)
