"""The datagrams that systemd would get, through real sockets; and the unit file under systemd's own checks."""

from __future__ import annotations

import configparser
import os
import re
import shutil
import socket
import subprocess
import tomllib
from pathlib import Path

import pytest

from zsched.core.values.exits import EXIT_CONFIG, EXIT_LEFT, EXIT_USAGE
from zsched.daemon import RELOAD_SIGNAL, RESTART_SIGNAL
from zsched.host.systemd import Notifier, watchdog_interval_s
from zsched.runtime.descriptors import WANTED

UNIT = Path(__file__).parents[3] / "systemd" / "zsched.service"
RELAY = UNIT.with_name("zsched-relay.service")
MAX_EXPOSURE = 1.5


def test_notices_arrive_at_a_path(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / "notify"))
        systemd.settimeout(2.0)
        notifier = Notifier({"NOTIFY_SOCKET": str(tmp_path / "notify")})
        assert notifier.is_connected
        sent = (
            notifier.ready("3 nodes\nepoch 4"),
            notifier.status("x" * 999),
            notifier.watchdog(),
            notifier.stopping(),
        )
        assert sent == (True, True, True, True)
        received = [systemd.recv(4096) for _ in range(4)]
        assert received == [b"READY=1\nSTATUS=3 nodes epoch 4", b"STATUS=" + b"x" * 400, b"WATCHDOG=1", b"STOPPING=1"]
        notifier.close()
        assert not notifier.watchdog()


def test_notices_arrive_at_an_abstract_name() -> None:
    name = f"zsched-test-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(f"\0{name}")
        systemd.settimeout(2.0)
        notifier = Notifier({"NOTIFY_SOCKET": f"@{name}"})
        assert notifier.watchdog()
        assert systemd.recv(100) == b"WATCHDOG=1"
        notifier.close()


@pytest.mark.parametrize("environment", [{}, {"NOTIFY_SOCKET": ""}, {"NOTIFY_SOCKET": "vsock:2:1"}])
def test_without_a_socket_nothing_happens(environment: dict[str, str]) -> None:
    notifier = Notifier(environment)
    assert not notifier.is_connected
    assert not notifier.ready("x")


def test_systemd_that_went_away_or_does_not_read_never_blocks(tmp_path: Path) -> None:
    path = tmp_path / "notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(path))
        notifier = Notifier({"NOTIFY_SOCKET": str(path)})
        assert not all(notifier.status(f"line {n}") for n in range(10_000))
    path.unlink()
    assert not notifier.watchdog()
    notifier.close()


def test_watchdog_interval_is_half_and_only_ours() -> None:
    assert watchdog_interval_s({}) is None
    assert watchdog_interval_s({"WATCHDOG_USEC": "10000000"}) == 5.0
    assert watchdog_interval_s({"WATCHDOG_USEC": "10000000", "WATCHDOG_PID": str(os.getpid())}) == 5.0
    assert watchdog_interval_s({"WATCHDOG_USEC": "10000000", "WATCHDOG_PID": "1"}) is None
    assert watchdog_interval_s({"WATCHDOG_USEC": "0"}) is None
    assert watchdog_interval_s({"WATCHDOG_USEC": "soon"}) is None


def test_unit_promises_what_the_daemon_keeps() -> None:
    unit = configparser.RawConfigParser(strict=False)
    unit.read(UNIT)
    service = unit["Service"]
    assert service["Type"] == "notify"
    assert service["ExecStart"] == "/opt/zsched/bin/zsched up --config /etc/zsched/fleet.yaml"
    assert service["Restart"] == "always"
    assert service["RestartPreventExitStatus"] == f"{EXIT_USAGE} {EXIT_CONFIG} {EXIT_LEFT}"
    assert service["SuccessExitStatus"] == str(EXIT_LEFT)
    assert service["WatchdogSec"] == "10"
    assert service["KillMode"] == "mixed"
    assert service["RestartKillSignal"] == RESTART_SIGNAL.name
    assert service["ExecReload"] == f"/bin/kill -{RELOAD_SIGNAL.name.removeprefix('SIG')} $MAINPID"
    assert service["RuntimeDirectoryPreserve"] == "restart"
    assert int(service["LimitNOFILE"]) == WANTED


def test_what_the_unit_names_as_its_documentation_is_installed() -> None:
    unit = configparser.RawConfigParser(strict=False)
    unit.read(UNIT)
    page = unit["Unit"]["Documentation"].removeprefix("file:///opt/zsched/")
    project = tomllib.loads((UNIT.parents[1] / "pyproject.toml").read_text())
    installed = project["tool"]["setuptools"]["data-files"]
    found = {pattern: sorted(UNIT.parents[1].glob(pattern)) for files in installed.values() for pattern in files}
    assert all(found.values()), found
    assert page in {
        f"{folder}/{file.name}" for folder, files in installed.items() for name in files for file in found[name]
    }


def analyze(*arguments: str) -> subprocess.CompletedProcess[str]:
    tool = shutil.which("systemd-analyze")
    if tool is None:
        pytest.skip("systemd-analyze is not installed")
    return subprocess.run([tool, *arguments], capture_output=True, text=True, timeout=30, check=False)


def test_the_relays_unit_is_what_the_daemons_unit_waits_for() -> None:
    units = [configparser.RawConfigParser(strict=False) for _ in range(2)]
    for unit, path in zip(units, (UNIT, RELAY), strict=True):
        unit.read(path)
    daemon, relay = units
    socket_path = dict(word.split("=") for word in daemon["Service"]["Environment"].split())["ZSCHED_RELAY"]
    assert relay["Service"]["ExecStart"].endswith(f"-m zsched.relay --socket {socket_path}")
    assert daemon["Unit"]["Wants"] == RELAY.name
    assert RELAY.name in daemon["Unit"]["After"]
    assert relay["Service"]["Restart"] == "on-failure"
    sandbox = [name for name in daemon["Service"] if name.startswith(("protect", "private", "restrict", "systemcall"))]
    assert {name: relay["Service"][name] for name in sandbox} == {name: daemon["Service"][name] for name in sandbox}


@pytest.mark.parametrize("path", [UNIT, RELAY], ids=["daemon", "relay"])
def test_unit_is_accepted_by_systemd(tmp_path: Path, path: Path) -> None:
    program = tmp_path / "zsched"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    unit = tmp_path / path.name
    unit.write_text(path.read_text().replace("/opt/zsched/bin/", f"{tmp_path}/"))
    (tmp_path / "python").symlink_to(program)
    done = analyze("verify", "--man=no", str(unit))
    assert (done.returncode, done.stderr) == (0, "")


def test_the_units_that_renew_are_accepted_by_systemd(tmp_path: Path) -> None:
    program = tmp_path / "zsched"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    for name in ("zsched-renew.service", "zsched-renew.timer"):
        text = (UNIT.parent / name).read_text()
        (tmp_path / name).write_text(text.replace("/opt/zsched/bin/zsched", str(program)))
    done = analyze("verify", "--man=no", *(str(tmp_path / f"zsched-renew.{kind}") for kind in ("service", "timer")))
    assert (done.returncode, done.stderr) == (0, "")


def test_unit_exposes_little() -> None:
    done = analyze("security", "--offline=true", "--no-pager", str(UNIT))
    if "--offline" in done.stderr:
        pytest.skip("this systemd-analyze cannot judge a unit offline")
    found = re.search(r"Overall exposure level for \S+: ([0-9.]+)", done.stdout)
    assert found is not None, done.stdout + done.stderr
    assert float(found[1]) <= MAX_EXPOSURE, done.stdout
