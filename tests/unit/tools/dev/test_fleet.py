"""A fleet file made fit for one machine: what stays, what goes, and that it is said."""

from __future__ import annotations

from pathlib import Path

import pytest

from zsched.config.load import check_bytes, load_fleet
from zsched.core.values.fleet import Fleet, SharedMemory
from zsched.core.values.profile import LinkSource
from zsched.tools.dev.fleet import Addresses, LoopbackFile, on_loopback

ROOT = Path(__file__).parents[4]
FILES = sorted((*(ROOT / "configs").glob("*.yaml"), *(ROOT / "zsched" / "examples").glob("*/fleet.yaml")))


def addresses(fleet: Fleet) -> dict[str, Addresses]:
    return {
        node.name: Addresses(
            control=f"tcp/127.0.0.1:{20000 + number}",
            data=f"tcp/127.0.0.1:{30000 + number}",
            local="" if node.local is None else f"tcp/127.0.0.1:{40000 + number}",
        )
        for number, node in enumerate(fleet.nodes)
    }


def brought_here(file: Path, **commands: tuple[str, ...]) -> tuple[LoopbackFile, Fleet]:
    found = on_loopback(file, addresses(load_fleet(file)), commands)
    result = check_bytes(found.text.encode())
    assert result.fleet is not None, result.report()
    return found, result.fleet


@pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(ROOT)))
def test_tasks_electors_and_clocks_stay_and_every_address_is_loopback(file: Path) -> None:
    before = load_fleet(file)
    _, after = brought_here(file)
    assert (after.name, after.tasks, after.electors, after.timing) == (
        before.name,
        before.tasks,
        before.electors,
        before.timing,
    )
    for node, one in addresses(before).items():
        spec = after.node(node)
        assert (spec.listen_control, spec.listen_data, spec.host) == (one.control, one.data, "127.0.0.1")
        assert (spec.kind, spec.labels) == (before.node(node).kind, before.node(node).labels)
        assert (spec.local is None) == (before.node(node).local is None)
        if spec.local is not None:
            assert (spec.local.connect, spec.local.listen) == ((), (one.local,))
            assert one.joins == one.local
        assert [link.source for link in spec.links] == [LinkSource.WIRED]


def test_what_does_not_hold_here_is_said() -> None:
    found, _ = brought_here(ROOT / "configs" / "ros2-node.yaml")
    assert found.left_out == (
        "radio links count as perfect (robot1, robot2, robot3)",
        "local sides listen themselves, with no router beside them (robot1, robot2, robot3)",
    )


FILE = """
fleet: small
zenoh: {config: zenoh.json5}
shared_memory: auto
nodes:
  robot1: {kind: robot, fixed: -57, labels: {gpu: "yes", word: 'it''s "so"'}}
  edge1: {kind: edge, host: 192.0.2.11, listen: {control: tcp/0.0.0.0:7457, data: tcp/0.0.0.0:7458}}
tasks:
  shout:
    candidates: {kind: edge}
    weights: {cpu: .5, memory: 5e-1, network: 0}
    inputs: [{from: "{robot}/q", to: "{target}/shout/{robot}/q"}]
"""


def written(folder: Path, text: str = FILE) -> Path:
    (folder / "zenoh.json5").write_text("{}")
    file = folder / "fleet.yaml"
    file.write_text(text)
    return file


def test_quotes_numbers_and_a_fixed_signal_stay_as_they_are_meant(tmp_path: Path) -> None:
    file = written(tmp_path)
    found, fleet = brought_here(file)
    before = load_fleet(file)
    assert fleet.node("robot1").labels == before.node("robot1").labels
    assert fleet.node("robot1").links == before.node("robot1").links
    assert fleet.tasks == before.tasks
    assert found.left_out == ("no settings of zenoh's own (`zenoh:`), so no certificates",)
    assert not fleet.zenoh_config
    assert (before.shared_memory, fleet.shared_memory) == (SharedMemory.AUTO, SharedMemory.OFF)


def test_a_secured_fleet_runs_here_without_certificates(tmp_path: Path) -> None:
    file = written(tmp_path, f"{FILE.rstrip()}\nsecurity: {{operators: [ana]}}\n".replace("tcp/", "tls/"))
    found, fleet = brought_here(file)
    assert "no certificates (`security:`): whoever is on this machine is let in" in found.left_out
    assert fleet.security is None
    assert load_fleet(file).security is not None


def test_a_worker_may_be_another_one_also_where_the_file_gives_none(tmp_path: Path) -> None:
    _, fleet = brought_here(written(tmp_path), shout=("python", "/home/me/my worker.py"))
    assert fleet.tasks[0].worker.command == ("python", "/home/me/my worker.py")
