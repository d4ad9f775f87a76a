"""Workers of users of their own on a real, booted systemd: what they may not read, and that they live as any worker.

Needs what `test_systemd_boot.py` needs.
"""

from __future__ import annotations

import json
import sysconfig
from pathlib import Path
from typing import Any

import pytest

from support import machine
from support.authorities import install, make_authority
from support.debian import NoDebianError, debian_root
from zsched_lab.fleet.loopback import free_endpoints

HERE, REPO = Path(__file__).parent, Path(__file__).parents[2]
BOOT_TIMEOUT_S = 300.0
pytestmark = [pytest.mark.long, pytest.mark.root, pytest.mark.timeout(420)]

FLEET = """
fleet: users
timing: wired
nodes:
  robot1: {kind: robot, wired: true, host: 127.0.0.1, listen: {control: E0, data: E1}}
  edge1: {kind: edge, host: 127.0.0.1, listen: {control: E2, data: E3}}
tasks:
  echo:
    candidates: [robot1, edge1]
    weights: {cpu: 1}
    scheduling: {bonus: 0.5}
    worker: {command: [python, /opt/probe.py], standby: cold}
    inputs: [{from: "{robot}/in", to: "{target}/echo/{robot}/in", class: reliable}]
    outputs: [{from: "{target}/echo/{epoch}/{robot}/out", to: "{robot}/out", class: reliable, handover: all}]
  slow:
    candidates: [robot1]
    weights: {cpu: 1}
    worker: {command: [python, /opt/stubborn.py], user: ros, ready: matching, stop_grace_s: 0.2}
  ghost:
    candidates: [robot1]
    weights: {cpu: 1}
    worker: {command: [sleep, "1000"], user: ghost, ready: matching}
"""
SECURED = """
fleet: users
timing: wired
nodes:
  edge1: {kind: edge, host: 127.0.0.1, listen: {control: TLS0, data: TLS1}}
  robot1:
    {kind: robot, wired: true, host: 127.0.0.1, listen: {control: TLS2, data: TLS3}, local: {mode: peer, listen: [E4]}}
tasks:
  echo:
    candidates: [edge1]
    weights: {cpu: 1}
    worker: {command: [python, /opt/probe.py], user: zsched-worker}
    inputs: [{from: "{robot}/in", to: "{target}/echo/{robot}/in", class: reliable}]
    outputs: [{from: "{target}/echo/{epoch}/{robot}/out", to: "{robot}/out", class: reliable, handover: all}]
security: {}
"""
PROBE = """
import json, os, runpy, socket, subprocess
def why(act):
    try:
        act()
    except OSError as error:
        return error.strerror
def ask(path):
    with socket.socket(socket.AF_UNIX) as link:
        link.connect(path)
told = {name: why(lambda: open(name)) for name in ("/etc/zsched/pki/key.pem", "/var/lib/zsched/state")}
told |= {name: why(lambda: os.listdir(name)) for name in ("/var/lib/zsched", "/run/credentials/zsched.service")}
told |= {name: why(lambda: ask(name)) for name in ("/run/zsched/NODE.sock", "/run/zsched-workers/zsched-worker.sock")}
told["home"] = why(lambda: open(os.path.expanduser("~/kept"), "w"))
print("PROBE", json.dumps(told), flush=True)
subprocess.Popen(["sleep", "1002"], start_new_session=True)
runpy.run_module("zsched.tasks.echo", run_name="__main__")
"""
STUBBORN = """
import signal, time
for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, signal.SIG_IGN)
while True:
    time.sleep(60)
"""
RUN = """#!/bin/sh
export PYTHONPATH=/opt/zsched/src:/opt/zsched/site PYTHONDONTWRITEBYTECODE=1
exec /usr/bin/python3 {start} "$@"
"""


def furnish(root: Path, fleet: str, node: str, joins: int) -> None:
    """Put the units as they are installed, the fleet file, the workers and the driver of the test into the machine.

    The service is ``node``; applications join at the endpoint with the number ``joins``.
    """
    endpoints = free_endpoints(5)
    for number, endpoint in enumerate(endpoints):
        fleet = fleet.replace(f"TLS{number}", endpoint.replace("tcp/", "tls/")).replace(f"E{number}", endpoint)
    with_user = [
        f"{name}{kind}" for name in ("zsched", "zsched-relay") for kind in (".service", ".service.d/10-user.conf")
    ]
    units = (*with_user, "zsched-worker@.service", "zsched-worker@.socket")
    files = {f"etc/systemd/system/{unit}": (REPO / "systemd" / unit).read_text() for unit in units}
    files |= {
        "etc/systemd/system/zsched.service.d/test.conf": f"[Service]\nEnvironment=ZSCHED_NODE={node}\n",
        "usr/lib/sysusers.d/zsched.conf": (REPO / "systemd/zsched.sysusers").read_text(),
        "etc/zsched/fleet.yaml": fleet,
        "etc/zsched/pki/key.pem": "-----BEGIN the node's\n",
        "opt/endpoint": endpoints[joins],
        "opt/app.py": (HERE / "deb_app.py").read_text(),
        "opt/booted/deb_drive.py": (HERE / "deb_drive.py").read_text(),
        "opt/probe.py": PROBE.replace("NODE", node),
        "opt/stubborn.py": STUBBORN,
    }
    starts = {"zsched": "-m zsched.cli", "python": ""}
    programs = {f"opt/zsched/bin/{name}": RUN.format(start=start) for name, start in starts.items()}
    machine.furnish(root, HERE / "worker_user_drive.py", files, programs)
    (root / "etc/zsched/pki/key.pem").chmod(0o600)
    (root / "usr/bin/zsched").symlink_to("/opt/zsched/bin/zsched")


def certify(root: Path) -> None:
    """Each node's certificate where it looks for it; the robot's daemon is no service, and has a file of its own."""
    authority = make_authority(root / "srv/authority", "users")
    install(authority, root / "etc/zsched/pki", "edge1")
    install(authority, root / "srv/robot1/pki", "robot1")
    (root / "srv/robot1/fleet.yaml").write_text((root / "etc/zsched/fleet.yaml").read_text())
    (root / "opt/secured").touch()


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What was seen inside."""
    return booted(tmp_path_factory.mktemp("users"), is_secured=False)


@pytest.fixture(scope="module")
def secured(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The same of a secured fleet."""
    return booted(tmp_path_factory.mktemp("secured"), is_secured=True)


def booted(folder: Path, *, is_secured: bool) -> dict[str, Any]:
    """What was seen inside a machine of a fleet."""
    try:
        debian = debian_root()
    except NoDebianError as error:
        pytest.skip(str(error))
    with machine.overlaid(debian, folder) as root:
        furnish(root, *((SECURED, "edge1", 4) if is_secured else (FLEET, "robot1", 1)))
        if is_secured:
            certify(root)
        ours = {"/opt/zsched/src/zsched": REPO / "zsched", "/opt/zsched/site": Path(sysconfig.get_paths()["purelib"])}
        found = machine.booted(folder, machine.options(root, folder, "users", ours), BOOT_TIMEOUT_S)
    assert "error" not in found, json.dumps(found, indent=1) + found["journal"]
    return found


def test_a_worker_has_its_own_user_is_measured_and_answers(report: dict[str, Any]) -> None:
    users = report["workers"]
    assert users == {"probe.py": ["zsched-worker"], "stubborn": ["ros"], "sleep 1002": ["zsched-worker"]}, users
    assert report["loads"]["echo"]["memory_mb"] > 1
    stream = report["stream"]
    assert stream["sent"] > 100
    assert (stream["missing"], stream["doubled"], stream["in_order"]) == ([], 0, True), report["journal"]


def test_it_may_not_read_the_nodes_key_nor_its_state_nor_give_orders(report: dict[str, Any]) -> None:
    line = next(line for line in report["logs"]["said"].splitlines() if "PROBE" in line)
    told = json.loads(line.partition("PROBE ")[2])
    assert told.pop("home") is None
    assert set(told.values()) == {"Permission denied"}, told
    assert len(told) == 6


def test_a_user_whom_nobody_starts_workers_for_is_told_with_the_command(report: dict[str, Any]) -> None:
    assert report["refused"], report["ghost"]
    assert "sudo systemctl enable --now zsched-worker@ghost.socket" in report["ghost"]["reason"]


def test_a_starter_that_cannot_start_is_tried_at_leisure(report: dict[str, Any]) -> None:
    assert 1 <= report["failed_starts"] <= 4


def test_it_is_stopped_when_its_task_moves_and_killed_where_it_will_not(report: dict[str, Any]) -> None:
    assert report["ended"], report["moved"]
    assert report["killed"], report["restarted"]


def test_it_ends_with_its_daemon_however_that_ends(report: dict[str, Any]) -> None:
    assert report["crashed"] is True, report["crashed"]
    assert report["again"], report["journal"]
    assert report["starters_killed"], report["journal"]
    assert report["stop"]["seconds"] < 6.0
    assert report["handed_over"]
    assert report["left"] is True, report["left"]


def test_where_a_drop_in_says_so_workers_are_the_daemons(report: dict[str, Any]) -> None:
    assert report["as_daemon"] == {"probe.py": [], "stubborn": ["ros"], "sleep 1002": []}, report["as_daemon"]
    assert report["run"] == [], report["run"]


def test_in_a_secured_fleet_it_works_without_the_nodes_key(secured: dict[str, Any]) -> None:
    assert secured["workers"]["probe.py"] == ["zsched-worker"]
    line = next(line for line in secured["logs"]["said"].splitlines() if "PROBE" in line)
    told = json.loads(line.partition("PROBE ")[2])
    assert told.pop("home") is None
    assert set(told.values()) == {"Permission denied"}, told
    stream = secured["stream"]
    assert secured["goes_on"], secured["journal"]
    assert stream["sent"] > 100
    assert (stream["missing"], stream["doubled"], stream["in_order"]) == ([], 0, True), secured["journal"]
    assert secured["left"], secured["journal"]
