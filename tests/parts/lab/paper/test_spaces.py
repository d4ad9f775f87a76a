from __future__ import annotations

import sys
from functools import partial
from pathlib import Path

import pytest

from support.waiting import until
from zsched.config.load import load_fleet
from zsched.core.values.fleet import SharedMemory
from zsched_lab.fleet.netns import why_not
from zsched_lab.fleet.runner import write_fleet
from zsched_lab.paper.places import scenario_path
from zsched_lab.paper.scenario import load_scenario
from zsched_lab.paper.spaces import NodeChildren, narrow_links, spaced

NO_SPACES = why_not()
needs_spaces = pytest.mark.skipif(NO_SPACES is not None, reason=f"no network namespaces: {NO_SPACES}")
NODES = ("edge1", "robot1")
SIZE = 250_000
"""Bytes that are sent: a second at 2 Mbit/s."""
SERVE = """
import socket
with socket.create_server(("0.0.0.0", 9000)) as server:
    while True:
        peer, _ = server.accept()
        with peer:
            peer.sendall(bytes(int(peer.recv(16))))
"""
TAKE = """
import socket, sys, time
end = time.monotonic() + 20
while True:
    try:
        peer = socket.create_connection((sys.argv[1], 9000), 5)
        break
    except OSError:
        if time.monotonic() > end:
            raise
        time.sleep(0.05)
started, got = time.monotonic(), 0
peer.sendall(sys.argv[2].encode())
while block := peer.recv(65536):
    got += len(block)
print(got, time.monotonic() - started, flush=True)
"""


def is_told(path: Path) -> bool:
    return path.read_text().endswith("\n")


@needs_spaces
@pytest.mark.root
def test_a_nodes_processes_are_in_its_namespace_behind_its_link(tmp_path: Path) -> None:
    taken: dict[float, float] = {}
    for round_, rate in enumerate((2.0, 1000.0, 1000.0, 1000.0)):  # a wide one may be held up by a busy machine
        told = tmp_path / f"told-{round_}"
        with narrow_links(NODES, rate) as network, NodeChildren(tmp_path / f"{round_}", network, NODES) as children:
            assert network is not None
            children.start("serve-edge1", [sys.executable, "-c", SERVE])
            command = [sys.executable, "-c", TAKE, network.address("edge1"), str(SIZE)]
            children.start("take-robot1", command, output=told)
            until(partial(is_told, told), "all bytes came")
        assert children.left_behind == []
        size, seconds = told.read_text().split()
        assert int(size) == SIZE
        taken[rate] = min(float(seconds), taken.get(rate, float("inf")))

    assert taken[2.0] > 0.8  # 1 s less what the bucket holds
    assert taken[1000.0] < taken[2.0]


@needs_spaces
@pytest.mark.root
def test_a_fleet_file_inside_namespaces(tmp_path: Path) -> None:
    plain = write_fleet(load_scenario(scenario_path()).fleet, tmp_path / "fleet.yaml", {})
    with narrow_links(sorted(plain.kinds), 9.8) as network:
        assert network is not None
        inside = spaced(plain, network)
        hosts = {node: network.address(node) for node in plain.kinds}
    fleet = load_fleet(inside.path)

    assert {node.name: node.host for node in fleet.nodes} == hosts
    assert set(inside.data_endpoints.values()) == {"tcp/127.0.0.1:7458"}
    assert fleet.shared_memory is SharedMemory.OFF
    assert inside.robots == plain.robots


def test_without_a_limit_nothing_is_set_up(tmp_path: Path) -> None:
    with narrow_links(NODES, None) as network, NodeChildren(tmp_path, network, NODES) as children:
        assert network is None
        child = children.start("take-robot1", [sys.executable, "-c", "pass"])
        until(lambda: not child.is_running, "it ended")
        assert child.process.args[-3:] == [sys.executable, "-c", "pass"]  # type: ignore[index]  # a list is given
    assert children.left_behind == []
