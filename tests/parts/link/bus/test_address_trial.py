"""A trial of addresses: each outcome in words, in a thread of its own, told once."""

from __future__ import annotations

import queue
import socket

import pytest

from zsched.core.values import events as ev
from zsched.link.bus.address_trial import AddressTrial, outcome_of


def closed_port() -> int:
    """A port on which nobody listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def test_a_listener_takes_connections_and_a_closed_port_refuses() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        assert outcome_of(f"tcp/127.0.0.1:{server.getsockname()[1]}#iface=lo") == "takes connections"
    assert outcome_of(f"tcp/127.0.0.1:{closed_port()}") == "refused"


@pytest.mark.parametrize("endpoint", ["tcp/nowhere.invalid:7447", "udp/nowhere.invalid:7447"])
def test_a_host_without_an_address_is_told_as_such(endpoint: str) -> None:
    assert outcome_of(endpoint) == "name unknown"


@pytest.mark.parametrize("endpoint", ["udp/127.0.0.1:7447", "unixsock-stream//tmp/x", ""])
def test_nothing_is_said_of_what_cannot_be_tried(endpoint: str) -> None:
    assert outcome_of(endpoint) == ""


def test_a_trial_tells_every_address_in_order() -> None:
    came: queue.SimpleQueue[ev.Event] = queue.SimpleQueue()
    refused = f"tcp/127.0.0.1:{closed_port()}"
    AddressTrial(came.put).begin((refused, "tcp/nowhere.invalid:1"))
    told = came.get(timeout=20.0)
    assert told == ev.AddressesTried(found=((refused, "refused"), ("tcp/nowhere.invalid:1", "name unknown")))
