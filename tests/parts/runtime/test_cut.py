"""A cut of links on a real kernel: nothing passes the network while it lasts, and it ends without anybody's help."""

from __future__ import annotations

import subprocess
import time
from dataclasses import replace

import pytest

from support.fleets import fleet_of
from zsched.runtime.strikes import cut_rules
from zsched_lab.fleet import netns

WHY_NOT = netns.why_not()
PORT = 7457
CUT_S = 2.5
SERVE = f"""
import socket
listener = socket.create_server(("0.0.0.0", {PORT}))
while True:
    listener.accept()[0].sendall(b"x")
"""
DIAL = """
import socket, sys
with socket.create_connection((sys.argv[1], int(sys.argv[2])), 0.3) as link:
    sys.exit(link.recv(1) != b"x")
"""


@pytest.mark.skipif(WHY_NOT is not None, reason=f"no namespaces: {WHY_NOT}")
def test_a_cut_holds_what_goes_out_and_what_comes_in_and_ends_by_itself() -> None:
    fleet = fleet_of(of=("edge1", "robot1"), electors=("robot1",))
    listening = tuple(replace(node, listen_control=f"tcp/0.0.0.0:{PORT}", listen_data="") for node in fleet.nodes)
    rules = cut_rules(replace(fleet, nodes=listening), CUT_S)
    with netns.Network(("edge1", "robot1")) as network:
        servers = [
            subprocess.Popen(network.wrap(name, ["python3", "-c", SERVE]), stderr=subprocess.DEVNULL)
            for name in ("edge1", "robot1")
        ]
        try:
            _until(lambda: reaches(network, "edge1", "robot1") and reaches(network, "robot1", "edge1"))
            subprocess.run(network.wrap("edge1", ["nft", "-f", "-"]), input=rules, text=True, check=True)
            began = time.monotonic()
            assert not reaches(network, "edge1", "robot1"), "what goes out"
            assert not reaches(network, "robot1", "edge1"), "what comes in"
            assert time.monotonic() - began < CUT_S, "looked too late to tell"
            assert reaches(network, "edge1", "127.0.0.1"), "the loopback interface is left alone"
            _until(lambda: reaches(network, "edge1", "robot1") and reaches(network, "robot1", "edge1"))
            assert time.monotonic() - began >= CUT_S * 0.9
        finally:
            for server in servers:
                server.kill()
                server.wait()


def reaches(network: netns.Network, name: str, other: str) -> bool:
    address = other if other[0].isdigit() else network.address(other)
    command = network.wrap(name, ["python3", "-c", DIAL, address, str(PORT)])
    return subprocess.run(command, stderr=subprocess.DEVNULL, check=False).returncode == 0


def _until(condition: object) -> None:
    assert callable(condition)
    end = time.monotonic() + 10.0
    while not condition():
        assert time.monotonic() < end
