"""Nodes that listen on one network card: their workers and applications find them there, and so do the others."""

from __future__ import annotations

from pathlib import Path

import pytest

from zsched.host.operator_client import ask
from zsched.host.paths import socket_path
from zsched_lab.fleet import netns
from zsched_lab.fleet.netbed import Netbed
from zsched_lab.fleet.testbed import echo_fleet

pytestmark = [pytest.mark.long, pytest.mark.root, pytest.mark.timeout(180)]


def test_workers_and_applications_dial_the_card_that_their_relay_listens_on(tmp_path: Path) -> None:
    """By loopback nothing reaches it; and the options are the listener's, so others do not bind to a card by them."""
    reason = netns.why_not()
    if reason is not None:
        pytest.skip(f"no network namespaces here: {reason}")
    tree = echo_fleet(robots=1, edges=1)
    with Netbed(tmp_path, tree, options="#iface=eth0;so_sndbuf=131072") as bed:
        bed.init()
        bed.start()
        bed.wait_settled()
        here = f"tcp/{bed.network.address('robot1')}:7458"
        assert ask(socket_path(tmp_path, "robot1"), {"verb": "access"}, 3.0)["endpoints"] == [here]
        assert bed.status("robot1")["joins_at"] == [here]
        probe = bed.probe("robot1", put="robot1/in", watch=["robot1/out"])
        bed.wait(probe.is_flowing, 30, "answers of a worker that found its relay")
