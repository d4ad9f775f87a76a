"""What a daemon can do to itself on its machine: who would start it again, and the rules of a cut."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import pytest

from support.fleets import fleet_of, node_of
from zsched.core.values.fleet import Fleet
from zsched.runtime.strikes import RESTARTED_BY, cut_rules, ports_of, why_no_cut, why_no_restart

UNIT = "0::/system.slice/zsched.service\n"
IN_SYSTEMD = {"INVOCATION_ID": "0a"}


def cgroup(folder: Path, text: str = UNIT) -> Path:
    path = folder / "cgroup"
    path.write_text(text)
    return path


@pytest.fixture
def systemctl(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A program of that name, which prints a file: there is no systemd where this runs."""
    (tmp_path / "systemctl").write_text(f'#!/bin/sh\ncat "{tmp_path}/said"\n')
    (tmp_path / "systemctl").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    return tmp_path / "said"


def test_a_daemon_that_nobody_starts_again_is_not_killed(tmp_path: Path) -> None:
    said = why_no_restart({}, 7, cgroup(tmp_path))
    assert said.startswith("nothing would start this daemon again: it is no service of systemd")
    assert why_no_restart(IN_SYSTEMD, 7, cgroup(tmp_path, "0::/user.slice/a.scope\n")).startswith("nothing would")
    assert why_no_restart(IN_SYSTEMD, 7, tmp_path / "none").startswith("nothing would")
    assert why_no_restart({RESTARTED_BY: "runit"}, 7, cgroup(tmp_path)) == ""


@pytest.mark.parametrize(
    ("restart", "said"),
    [
        ("always", ""),
        ("on-failure", ""),
        ("no", "zsched.service has Restart=no: systemd would not start this daemon again"),
        ("on-success", "zsched.service has Restart=on-success: systemd would not start this daemon again"),
    ],
)
def test_what_systemd_would_do_is_asked(tmp_path: Path, systemctl: Path, restart: str, said: str) -> None:
    systemctl.write_text(f"Restart={restart}\nMainPID=7\n")
    assert why_no_restart(IN_SYSTEMD, 7, cgroup(tmp_path)) == said


def test_a_child_of_a_service_is_not_the_service(tmp_path: Path, systemctl: Path) -> None:
    systemctl.write_text("Restart=always\nMainPID=8\n")
    said = "zsched.service is not this daemon (its main process is 8): nothing would start it again"
    assert why_no_restart(IN_SYSTEMD, 7, cgroup(tmp_path)) == said


def apart() -> Fleet:
    """Two machines, by addresses that are set aside for documents."""
    listen = "tcp/0.0.0.0:7457"
    return fleet_of(
        of=[
            node_of(name, host=f"192.0.2.{number}", listen_control=listen, listen_data=f"tls/[::]:{7458 + number}#a")
            for number, name in enumerate(("edge1", "robot1"))
        ]
    )


def test_a_cut_drops_what_comes_from_or_goes_to_a_port_of_the_fleet_for_a_while() -> None:
    assert ports_of(apart()) == (7457, 7458, 7459)
    rules = cut_rules(apart(), 2.5)
    assert "{ 7457 timeout 2500ms, 7458 timeout 2500ms, 7459 timeout 2500ms }" in rules
    assert rules.count('!= "lo" meta l4proto { tcp, udp } th') == rules.count("drop;") == 4


def test_nodes_on_one_machine_cannot_be_cut_apart() -> None:
    assert why_no_cut(apart(), "edge1") == ""
    fleet = apart()
    here = replace(fleet, nodes=(fleet.nodes[0], replace(fleet.nodes[1], host="127.0.0.1")))
    assert why_no_cut(here, "edge1") == "robot1 on this machine, too: between them there is no network to cut"
    bare = replace(fleet, nodes=tuple(replace(node, listen_control="", listen_data="") for node in fleet.nodes))
    assert why_no_cut(bare, "edge1") == "the fleet file names no ports"
