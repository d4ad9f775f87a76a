"""Workers that are units: started, moved, failed over, stopped and left behind on a real, booted systemd.

Needs what `test_systemd_boot.py` needs; about 15 s, most of it waiting.
"""

from __future__ import annotations

import json
import sysconfig
from pathlib import Path
from typing import Any

import pytest

from support import machine
from support.debian import NoDebianError, debian_root
from zsched_lab.fleet.loopback import free_endpoints

HERE, REPO = Path(__file__).parent, Path(__file__).parents[2]
BOOT_TIMEOUT_S = 240.0
pytestmark = [pytest.mark.long, pytest.mark.root, pytest.mark.timeout(420)]

FLEET = """
fleet: units
timing: wired
nodes:
  robot1: {kind: robot, wired: true, host: 127.0.0.1, listen: {control: E0, data: E1}}
  edge1: {kind: edge, host: 127.0.0.1, listen: {control: E2, data: E3}}
  edge2: {kind: edge, host: 127.0.0.1, listen: {control: E4, data: E5}}
tasks:
  echo:
    candidates: {kind: edge}
    weights: {cpu: 1}
    scheduling: {bonus: 0.5}
    worker: {driver: systemd, unit: echoer@.service, max_failures: 2, env: {GREETING: 'a "b" $HOME'}}
    inputs: [{from: "{robot}/in", to: "{target}/echo/{robot}/in"}]
    outputs: [{from: "{target}/echo/{epoch}/{robot}/out", to: "{robot}/out"}]
    services: [{from: "{robot}/ask", to: "{target}/echo/{robot}/ask"}]
"""
WORKER_UNIT = """
[Service]
EnvironmentFile=/run/fleet/%i.env
ExecStartPre=/bin/sh -c 'echo "greeted with $GREETING"'
ExecStart=/opt/zsched/bin/python -m zsched.tasks.echo
"""
RUN = """#!/bin/sh
export PYTHONPATH=/opt/zsched/src:/opt/zsched/site PYTHONDONTWRITEBYTECODE=1
exec /usr/bin/python3 {start} "$@"
"""


def furnish(root: Path) -> None:
    """Put the fleet file, the units and the driver of the test into the machine."""
    fleet = FLEET
    for number, endpoint in enumerate(free_endpoints(6)):
        fleet = fleet.replace(f"E{number}", endpoint)
    files = {"etc/systemd/system/echoer@.service": WORKER_UNIT, "etc/zsched/fleet.yaml": fleet}
    starts = {"zsched": "-m zsched.cli", "python": ""}
    programs = {f"opt/zsched/bin/{name}": RUN.format(start=start) for name, start in starts.items()}
    machine.furnish(root, HERE / "drivers_drive.py", files, programs)


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What was seen inside."""
    try:
        debian = debian_root()
    except NoDebianError as error:
        pytest.skip(str(error))
    folder = tmp_path_factory.mktemp("units")
    with machine.overlaid(debian, folder) as root:
        furnish(root)
        ours = {"/opt/zsched/src/zsched": REPO / "zsched", "/opt/zsched/site": Path(sysconfig.get_paths()["purelib"])}
        found = machine.booted(folder, machine.options(root, folder, "units", ours), BOOT_TIMEOUT_S)
    assert "error" not in found, found["error"] + found["journal"]
    return found


def check(report: dict[str, Any], *steps: str) -> None:
    """Each of these came to be."""
    for step in steps:
        assert report[step]["holds"], f"{step}: {json.dumps(report[step], indent=1)}\n{report['journal']}"


def test_units_are_started_with_the_workers_environment_and_measured(report: dict[str, Any]) -> None:
    check(report, "began", "measured")
    assert {one["ActiveState"] for one in report["began"]["units"].values()} == {"active"}
    assert 'GREETING="a \\"b\\" \\$HOME"\n' in report["environment"]
    assert report["mode"] == "0o600"
    assert report["noted"] == {edge: report["measured"]["units"][edge]["MainPID"] for edge in report["noted"]}


def test_a_task_moves_from_unit_to_unit_and_its_log_is_there(report: dict[str, Any]) -> None:
    assert report["moved"]["holds"], report["move"]
    assert 'greeted with a "b" $HOME' in report["logs"]


def test_a_unit_that_is_killed_starts_again_and_the_next_failure_moves_the_task(report: dict[str, Any]) -> None:
    check(report, "killed", "again", "stopped")
    assert "has ended or was stopped by somebody else" in report["why"]
    assert report["retried"]["holds"], report["restart"]


def test_units_end_with_their_daemon_however_that_ends(report: dict[str, Any]) -> None:
    check(report, "daemon_killed", "daemon_stopped")
    assert report["left"] == []
