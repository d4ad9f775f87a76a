"""Tests of zsched.config.site: the other fleets of a site, and what is refused of them."""

from __future__ import annotations

from pathlib import Path

from zsched.config.load import CheckResult, check_bytes
from zsched.core.values.fleet import Cell, fleet_hash

TEXT = """\
fleet: hall-a
nodes:
  robot1: {kind: robot, host: 192.0.2.21, listen: {control: "tcp/0.0.0.0:7457", data: "tcp/0.0.0.0:7458"}}
"""


def checked(site: str, folder: Path = Path("/etc/zsched")) -> CheckResult:
    return check_bytes(f"{TEXT}{site}".encode(), str(folder / "fleet.yaml"))


def faults(site: str) -> list[tuple[str, str]]:
    return [(fault.message, fault.hint) for fault in checked(site).faults]


def test_cells_come_sorted_with_their_gateways_in_the_order_given() -> None:
    fleet = checked(
        "site:\n  hall-c: {gateways: [tcp/192.0.2.42:7457, tcp/192.0.2.41:7457]}\n"
        "  hall-b: {gateways: [tcp/192.0.2.31:7457, tcp/192.0.2.32:7457]}\n"
    ).fleet
    assert fleet is not None
    assert fleet.cells == (
        Cell(name="hall-b", gateways=("tcp/192.0.2.31:7457", "tcp/192.0.2.32:7457")),
        Cell(name="hall-c", gateways=("tcp/192.0.2.42:7457", "tcp/192.0.2.41:7457")),
    )


def test_the_folder_of_a_cells_file_is_each_machines_own(tmp_path: Path) -> None:
    site = "site: {hall-b: {gateways: [tls/192.0.2.31:7457, tls/192.0.2.32:7457], file: hall-b.yaml}}\n"
    (tmp_path / "hall-b.yaml").write_text("fleet: hall-b")
    here, there = checked(site, tmp_path), checked(site, tmp_path / "other")
    assert here.fleet is not None
    assert there.fleet is not None
    assert here.fleet.cells[0].file == str(tmp_path / "hall-b.yaml")
    assert fleet_hash(here.fleet) == fleet_hash(there.fleet)
    absent = f"{tmp_path / 'other' / 'hall-b.yaml'} is not on this machine"
    assert absent not in [one.message for one in here.warnings]
    assert absent in [one.message for one in there.warnings]


def test_what_is_refused_of_a_cell() -> None:
    assert faults("site: {hall-a: {gateways: [tcp/192.0.2.31:7457, tcp/192.0.2.32:7457]}}\n") == [
        ("'hall-a' is this fleet itself", "name the other fleets of the site")
    ]
    assert faults("site: {hall-b: {gateways: [tcp/0.0.0.0:7457, tcp/192.0.2.32:7457]}}\n") == [
        ("tcp/0.0.0.0:7457 cannot be dialled", 'name an address, for example "tcp/192.0.2.31:7457"')
    ]
    twice = (
        "site:\n  hall-b: {gateways: [tcp/192.0.2.31:7457]}\n"
        "  hall-c: {gateways: [tcp/192.0.2.31:7457, tcp/192.0.2.33:7457]}\n"
    )
    assert faults(twice) == [("tcp/192.0.2.31:7457 is a gateway of 'hall-b' already", "name another node of it")]
    assert faults("site: {hall-b: {gateways: [tls/192.0.2.31:7457, tls/192.0.2.32:7457]}}\n") == [
        (
            "'hall-b' is a secured fleet, and nothing says with which certificate it is asked",
            "file: its fleet file, whose `security: {folder:}` holds a certificate of its authority",
        )
    ]
    assert faults("site: {hall-b: {gateways: []}}\n")
    assert faults("site: {hall-b: {}}\n")
