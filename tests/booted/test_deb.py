"""The Debian package in a booted Debian: installed, asked by a group's member, upgraded, rolled back, removed, purged.

Needs what `test_systemd_boot.py` needs, and once the index for the locked wheels (`support.packages`). Skipped with the
reason otherwise. ``package/prove.py`` runs it with packages as they are shipped, in other systems, from a real older
version: `PROVE`.
"""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import pytest

from support import machine
from support.debian import SUITE, NoDebianError, debian_root
from support.packages import another, built
from zsched_lab.fleet.loopback import free_endpoints

HERE = Path(__file__).parent
BOOT_TIMEOUT_S = 400.0
PROVE = "ZSCHED_PROVE"
"""What `package/prove.py` gives, as JSON: ``suite``, ``new`` and ``old`` (packages; folders with a wheel beside the
libraries' are for pip), ``same_relay``, ``report``."""
pytestmark = [pytest.mark.long, pytest.mark.root, pytest.mark.timeout(900)]

FLEET = """
fleet: deb
timing: wired
nodes:
  robot1: {kind: robot, wired: true, host: 127.0.0.1, listen: {control: E0, data: E1}}
  edge1: {kind: edge, host: 127.0.0.1, listen: {control: E2, data: E3}}
tasks:
  echo:
    candidates: [robot1, edge1]
    weights: {cpu: 1}
    scheduling: {bonus: 0.5}
    worker: {command: [python, -m, zsched.tasks.echo]}
    inputs: [{from: "{robot}/in", to: "{target}/echo/{robot}/in", class: reliable}]
    outputs: [{from: "{target}/echo/{epoch}/{robot}/out", to: "{robot}/out", class: reliable, handover: all}]
"""
OLD = "0.0.1"


def furnish(root: Path) -> None:
    """Put the fleet file, the application and the driver of the test into the machine."""
    fleet, endpoints = FLEET, free_endpoints(4)
    for number, endpoint in enumerate(endpoints):
        fleet = fleet.replace(f"E{number}", endpoint)
    files = {
        "etc/systemd/system/zsched.service.d/test.conf": "[Service]\nEnvironment=ZSCHED_NODE=robot1\n",
        "opt/fleet.yaml": fleet,
        "opt/endpoint": endpoints[1],
        "opt/app.py": (HERE / "deb_app.py").read_text(),
    }
    machine.furnish(root, HERE / "deb_drive.py", files)


def other_relay(home: Path) -> None:
    """The older version's relay has other code, and knows a word that the newer version's daemon does not say."""
    with (home / "lib/site-packages/zsched/relay/process.py").open("a") as file:
        file.write("# Of the older version.\n")
    path, newest = home / "lib/site-packages/zsched/core/values/plan.py", "    predecessors: tuple[Slot, ...] = ()\n"
    text = path.read_text()
    assert newest in text
    path.write_text(text.replace(newest, f"{newest}    urgency: int = 0\n", 1))


@pytest.fixture(scope="module")
def given() -> dict[str, Any]:
    """What is to be tried instead of a small package of this tree, if anything."""
    found: dict[str, Any] = json.loads(os.environ.get(PROVE, "{}"))
    return found


def by_pip(given: dict[str, Any]) -> bool:
    """Whether wheels are tried."""
    return bool(given) and Path(given["new"]).is_dir()


@pytest.fixture(scope="module")
def report(given: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What was seen inside."""
    try:
        debian = debian_root(given.get("suite", SUITE))
    except NoDebianError as error:
        pytest.skip(str(error))
    folder = tmp_path_factory.mktemp("deb")
    packages = folder / "debs"
    packages.mkdir()
    if by_pip(given):
        packages = Path(given["new"]).parent
    elif given:
        for name in ("new", "old"):
            shutil.copy(given[name], packages / f"{name}.deb")
    else:
        new = built(folder / "built")
        another(new, OLD, folder, other_relay).rename(packages / "old.deb")
        new.rename(packages / "new.deb")
    with machine.overlaid(debian, folder) as root:
        furnish(root)
        if by_pip(given):
            (root / "opt/way").write_text("pip")
        found = machine.booted(folder, machine.options(root, folder, "deb", {"/debs": packages}), BOOT_TIMEOUT_S)
    if given:
        Path(given["report"]).write_text(json.dumps(found, indent=1))
    assert "error" not in found, json.dumps(found, indent=1)
    return found


def test_it_is_installed_and_starts_nothing_without_a_fleet_file(report: dict[str, Any]) -> None:
    assert report["install"]["code"] == 0, report["install"]
    assert "zsched fleet create NAME" in report["install"]["said"]
    assert set(report["idle"]) == {"ActiveState=inactive", "UnitFileState=disabled"}
    assert report["cached"], "compiled once, for the service may not write there"
    assert "_zsched" in report["completion"]


def test_it_does_not_mix_with_an_installation_by_pip(report: dict[str, Any], given: dict[str, Any]) -> None:
    if by_pip(given):
        pytest.skip("this is one")
    assert report["refused"]["code"] != 0
    assert "holds an installation by pip" in report["refused"]["said"]


def test_workers_of_the_service_are_not_its_user(report: dict[str, Any]) -> None:
    """The daemon beside it is root's."""
    assert report["users"] == ["root", "zsched-worker"]


def test_members_of_the_group_may_ask_and_others_may_not(report: dict[str, Any]) -> None:
    assert report["socket"] == ["zsched", "0o660"]
    assert report["member"]["code"] == 0, report["member"]
    assert json.loads(report["member"]["said"])["node"] == "robot1"
    assert report["stranger"]["code"] == 3, report["stranger"]
    assert "member of the group zsched" in report["stranger"]["said"]


@pytest.mark.parametrize("step", ["upgrade", "downgrade"])
def test_another_version_comes_under_a_reliable_stream_that_loses_nothing(
    report: dict[str, Any], given: dict[str, Any], step: str
) -> None:
    found = report[step]
    assert found["dpkg"]["code"] == 0, found
    stream = found["stream"]
    assert stream["sent"] > 100, found
    assert (stream["doubled"], stream["in_order"]) == (0, True), json.dumps(report, indent=1)
    stays = given.get("same_relay", True)
    assert found["same_relay"] == stays, "a relay that understands the other version carries the stream on"
    if stays:
        assert stream["missing"] == [], json.dumps(report, indent=1)
    else:
        assert stream["longest_pause_s"] < 10.0, "the stream goes on through another relay"
    assert found["running"] == found["version"].removeprefix("zsched "), found
    assert (found["running"] == report["first"]) == (step == "downgrade"), found


@pytest.fixture(scope="module")
def back(report: dict[str, Any], given: dict[str, Any]) -> dict[str, Any]:
    """What was seen when it came back after a removal."""
    if by_pip(given):
        pytest.skip("there is no package, whose scripts would do it")
    found: dict[str, Any] = report["back"]
    return found


def test_installed_again_it_runs_again_and_an_upgrade_starts_none_that_was_stopped(back: dict[str, Any]) -> None:
    assert back["again"]["code"] == 0, back
    assert back["back"] == ["active", "active"], back
    assert back["upgrade"]["code"] == 0, back
    assert back["stopped"] == ["inactive", "inactive"], back


def test_a_purge_spares_an_installation_by_pip_that_has_come_since(back: dict[str, Any]) -> None:
    """It deleted that, and the node's key and state with it, under a running daemon."""
    assert back["spared"]["code"] == 0, back
    assert "holds an installation by pip now" in back["spared"]["said"]
    assert back["kept"] == ["/etc/zsched/fleet.yaml", "/var/lib/zsched/", "/opt/zsched"]
    assert back["last"]["code"] == 0, back


def test_removed_it_hands_over_and_purged_nothing_is_left(report: dict[str, Any], given: dict[str, Any]) -> None:
    removed = report["remove"]
    assert removed["dpkg"]["code"] == 0, removed
    assert removed["owner"] == ["edge1"], removed
    assert removed["active"] != "active"
    assert removed["kept"] == ["/etc/zsched/fleet.yaml", "/var/lib/zsched/"]
    gone = ["/usr/local/bin/zsched"] if by_pip(given) else ["/opt/zsched", "/usr/bin/zsched"]
    assert removed["gone"] == gone, removed
    assert report["purge"]["code"] == 0, report["purge"]
    assert (report["left"], report["lost"]) == ([], [])
