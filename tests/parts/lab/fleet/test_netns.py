"""Long links and other addresses of network namespaces, by a program that answers across them."""

from __future__ import annotations

import subprocess
import sys

import pytest

from zsched_lab.fleet import netns
from zsched_lab.fleet.netns import Network

NO_SPACES = netns.why_not()
pytestmark = [pytest.mark.root, pytest.mark.skipif(NO_SPACES is not None, reason=f"no namespaces: {NO_SPACES}")]
ONE_WAY_S = 0.1
ANSWER = """
import socket
with socket.create_server(("0.0.0.0", 9000)) as server:
    print("ready", flush=True)
    peer, _ = server.accept()
    with peer:
        while content := peer.recv(65536):
            peer.sendall(content)
"""
ASK = """
import socket, sys, time
with socket.create_connection((sys.argv[1], 9000), 10) as peer:
    peer.settimeout(10)
    begun = time.monotonic()
    peer.sendall(b"x")
    peer.recv(1)
    print(time.monotonic() - begun)
"""


def trip_s(network: Network) -> float:
    """How long a byte takes from one namespace to the other and back."""
    command = network.wrap("two", [sys.executable, "-c", ANSWER])
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            assert server.stdout.readline() == "ready\n"
            ask = network.wrap("one", [sys.executable, "-c", ASK, network.address("two")])
            done = subprocess.run(ask, capture_output=True, text=True, timeout=30, check=True)
        finally:
            server.kill()
    return float(done.stdout)


def test_what_crosses_a_lengthened_link_takes_longer_both_ways() -> None:
    with Network(("one", "two")) as network:
        network.lengthen("two", ONE_WAY_S)
        assert trip_s(network) >= 2 * ONE_WAY_S


def test_a_namespace_that_gets_another_address_is_reached_there() -> None:
    with Network(("one", "two")) as network:
        before = network.address("two")
        after = network.renumber("two")
        assert after == network.address("two") != before
        assert trip_s(network) < 10
        network.add("three")
        assert network.address("three") not in (before, after)
