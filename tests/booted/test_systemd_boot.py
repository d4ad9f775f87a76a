"""The unit on a real, booted systemd: a small Debian in systemd-nspawn, driven from inside by `boot_drive.py`.

Needs root, debootstrap and systemd-nspawn, and once the network (`support.debian`). Skipped with the reason otherwise.
Each test has a machine of its own on an overlay over the cached one (about 25 s, most of it waiting).
"""

from __future__ import annotations

import importlib.util
import json
import sysconfig
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from support import machine
from support.debian import NoDebianError, debian_root
from zsched_lab.fleet.loopback import free_endpoints

HERE, REPO = Path(__file__).parent, Path(__file__).parents[2]
BOOT_TIMEOUT_S = 150.0
pytestmark = [pytest.mark.long, pytest.mark.root, pytest.mark.timeout(420)]

FLEET = """
fleet: boot
nodes:
  edge1: {kind: robot, wired: true, listen: {control: CONTROL, data: DATA}}
tasks:
  echo:
    candidates: [edge1]
    weights: {cpu: 0.5, memory: 0.5, network: 0.0}
    worker: {command: [python, -m, zsched.tasks.echo], standby: warm}
    inputs: [{from: "{robot}/ping", to: "{target}/echo/{robot}/ping"}]
    outputs: [{from: "{target}/echo/{epoch}/pong", to: "{robot}/pong"}]
"""
PROGRAM = """#!/bin/sh
export PYTHONPATH=/opt/zsched/src:/opt/zsched/site PYTHONDONTWRITEBYTECODE=1 ZSCHED_NODE=edge1
exec /usr/bin/python3 {start} "$@"
"""
PYTHON = """#!/bin/sh
export PYTHONPATH=/opt/zsched/src:/opt/zsched/site PYTHONDONTWRITEBYTECODE=1
exec /usr/bin/python3 "$@"
"""
STANDIN, REAL = "/opt/standin.py", "-m zsched.cli"
WEB_DROP_IN = "[Service]\nExecStart=\nExecStart=/opt/zsched/bin/zsched web --listen 127.0.0.1:{port}\n"
STANDIN_WORKS = "worker works"
REAL_WORKS = "echo@edge1 epoch 1"
"""What the status line says, after the watchdog's restart, too: the state was on the disk."""


@pytest.fixture(scope="module")
def debian() -> Path:
    """The cached root of a minimal Debian; made when there is none."""
    try:
        return debian_root()
    except NoDebianError as error:
        pytest.skip(str(error))


def fleet_file() -> str:
    """The fleet file with ports that are free: the machine shares this one's network."""
    control, data = free_endpoints(2)
    return FLEET.replace("CONTROL", control).replace("DATA", data)


def furnish(root: Path, start: str, expected: str) -> None:
    """Put the unit, its program, the fleet file and the driver into the machine."""
    unit = (REPO / "systemd" / "zsched.service").read_text()
    port = free_endpoints(1)[0].rpartition(":")[2]
    files = {
        "etc/systemd/system/zsched.service": unit,
        "etc/systemd/system/zsched.service.d/test.conf": "[Service]\nWatchdogSec=3\n",
        "etc/systemd/system/zsched-web.service": (REPO / "systemd" / "zsched-web.service").read_text(),
        "etc/systemd/system/zsched-web.service.d/test.conf": WEB_DROP_IN.format(port=port),
        "opt/web_port": port,
        "etc/zsched/fleet.yaml": fleet_file(),
        "opt/expected": expected,
        "opt/standin.py": (HERE / "service_standin.py").read_text(),
    }
    if start == REAL:  # the stand-in has no streams
        files["etc/systemd/system/zsched-relay.service"] = (REPO / "systemd" / "zsched-relay.service").read_text()
    programs = {"opt/zsched/bin/zsched": PROGRAM.format(start=start), "opt/zsched/bin/python": PYTHON}
    machine.furnish(root, HERE / "boot_drive.py", files, programs)


def boot(debian: Path, folder: Path, start: str, expected: str, *, init: bool) -> dict[str, Any]:
    """Boot a machine with the service, let the driver run, and return its report."""
    folder.mkdir(parents=True)
    with machine.overlaid(debian, folder) as root:
        furnish(root, start, expected)
        ours = {"/opt/zsched/src/zsched": REPO / "zsched", "/opt/zsched/site": Path(sysconfig.get_paths()["purelib"])}
        options = machine.options(root, folder, f"boot-{folder.name}", ours)
        if init:
            command = ["/opt/zsched/bin/zsched", "init", "--config", "/etc/zsched/fleet.yaml"]
            done = machine.nspawn(folder, [*options, *command], timeout_s=60.0)
            assert done == 0, (folder / "console.log").read_text(errors="replace")
        return machine.booted(folder, options, BOOT_TIMEOUT_S)


def check_life(report: dict[str, Any], expected: str) -> None:
    """What the operator may expect of the unit, whatever program is in it."""
    assert "error" not in report, report
    journal = report["journal"]
    assert report["start"]["ActiveState"] == "active", journal
    assert expected in report["running"]["StatusText"], journal
    assert f'Status: "{report["running"]["StatusText"]}"' in report["status"], report["status"]
    assert report["watchdog"]["NRestarts"] == "1", journal
    assert expected in report["watchdog"]["StatusText"], journal
    assert [line for line in report["survivors"] if "zsched.relay" not in line] == []
    assert report["stop"]["ActiveState"] == "inactive", journal
    assert report["stop"]["Result"] == "success", journal
    assert report["stop"]["seconds"] < 5.0
    assert report["left"] == []
    assert report["left_folders"] == {"/run/zsched": False, "/var/lib/zsched/": True}
    later = report["misconfigured"]["later"]
    assert (later["ActiveState"], later["ExecMainStatus"]) == ("failed", "78"), journal


@pytest.fixture(scope="module")
def reports(debian: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Future[dict[str, Any]]]]:
    """Both machines, one after the other: they may share control groups, and then systemd ends nothing."""
    folder = tmp_path_factory.mktemp("boot")
    with ThreadPoolExecutor(1) as pool:
        yield {
            "standin": pool.submit(boot, debian, folder / "standin", STANDIN, STANDIN_WORKS, init=False),
            "real": pool.submit(boot, debian, folder / "real", REAL, REAL_WORKS, init=True),
        }


def test_adapters_work_inside_the_units_sandbox(reports: dict[str, Future[dict[str, Any]]]) -> None:
    report = reports["standin"].result()
    check_life(report, STANDIN_WORKS)
    worker, daemon = (json.loads(report["runtime"][name]) for name in ("worker.txt", "daemon.txt"))
    libraries = {"numpy", "cv2", "zenoh", "msgpack"} & {
        name for name in worker if importlib.util.find_spec(name) is not None
    }
    assert {name: worker[name] for name in libraries} == dict.fromkeys(libraries, "ok")
    assert worker["oom_score_adj"] == "300"
    assert daemon["incarnation"] == 1
    assert daemon["sample"]["cpu_used_cores"] is not None
    assert daemon["sample"]["memory_used_mb"] > 0
    assert daemon["sample"]["workers"][0]["cpu_cores"] is not None
    assert any("sleep 1000" in line for line in report["processes"])
    assert "incarnation 1" in report["running"]["StatusText"]
    assert "incarnation 2" in report["watchdog"]["StatusText"]


def test_daemon_lives_by_its_unit_and_remembers_the_allocation(reports: dict[str, Future[dict[str, Any]]]) -> None:
    report = reports["real"].result()
    check_life(report, REAL_WORKS)
    assert any("zsched.relay" in line for line in report["processes"]), report["processes"]
    web = report["web"]  # it reads by the operator socket, as the daemon's own user, and leaves the relay alone
    assert web.get("status"), web["said"]
    assert (web["status"]["fleet"], web["why"]) == ("boot", ""), web
    for when in ("crashed", "restarted", "watchdog"):  # the relay is the same one through all of them
        assert report[when]["ActiveState"] == "active", report["journal"]
        assert report[when]["relay"] == report["relay"] != [], report["journal"]
    assert report["crashed"]["escaped"] == [], report["journal"]  # a process of a session of its own
    assert any("zsched.relay" in line for line in report["survivors"])
    departed = report["departed"]
    assert departed["code"] == 0, departed
    assert (departed["later"]["ActiveState"], departed["later"]["Result"]) == ("inactive", "success"), departed
    assert "left node=edge1: the service does not start it again" in report["journal"]
    assert departed["left"] == [], departed
    kept = departed["kept"]
    assert {"/etc/zsched/fleet.yaml.left", "/var/lib/zsched/state.left"} <= set(kept), departed
    assert not {"/etc/zsched/fleet.yaml", "/var/lib/zsched/state"} & set(kept), departed
    assert any("zsched.tasks.echo" in line for line in report["processes"]), report["processes"]
