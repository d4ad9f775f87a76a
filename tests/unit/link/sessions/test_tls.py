"""Whether a fleet is encrypted, and what is wrong with it when it is so by half."""

from __future__ import annotations

from dataclasses import replace

import pytest

from support.fleets import fleet_of, node_of
from zsched.core.values.errors import ConfigError
from zsched.core.values.fleet import Fleet, LocalMode, LocalSide, Security
from zsched.core.values.snapshot import Exposure
from zsched.link.sessions.tls import exposure, plain_text_problem, protocol_of

FILE = "/etc/zsched/zenoh.json5"
WHOLE = """{transport: {link: {tls: {root_ca_certificate: "a", listen_certificate: "b", listen_private_key: "c"}}}}"""
PLAIN, TLS = "tcp/0.0.0.0:7457", "tls/0.0.0.0:7457"


def fleet(control: str = "") -> Fleet:
    return fleet_of(of=(node_of("robot1", listen_control=control),), tasks=(), zenoh_config=FILE)


@pytest.mark.parametrize(
    ("text", "control", "missing"),
    [
        ("", TLS, "listen_certificate and listen_private_key"),
        ('{transport: {link: {tls: {root_ca_certificate: "a"}}}}', "", "listen_certificate and listen_private_key"),
        (WHOLE.replace('listen_private_key: "c"', ""), TLS, "listen_private_key"),
    ],
)
def test_tls_that_could_not_listen_is_refused_with_what_is_missing(text: str, control: str, missing: str) -> None:
    with pytest.raises(ConfigError, match=f"TLS without {missing}, with which"):
        protocol_of(fleet(control), text)


@pytest.mark.parametrize(
    ("protocol", "listens", "found"),
    [
        ("tcp", ["tcp/0.0.0.0:1", "tcp/127.0.0.1:2"], Exposure.OPEN),
        ("tcp", ["tcp/127.1.2.3:1", "tcp/[::1]:2"], Exposure.LOCAL),
        ("tcp", ["tcp/[::]:1"], Exposure.OPEN),
        ("tls", ["tls/0.0.0.0:1", "quic/0.0.0.0:2"], Exposure.ENCRYPTED),
        ("tls", ["tls/0.0.0.0:1", "tcp/0.0.0.0:2"], Exposure.OPEN),
    ],
)
def test_who_is_let_in_is_told_by_where_it_listens(protocol: str, listens: list[str], found: Exposure) -> None:
    (node,) = fleet().nodes
    secured = replace(fleet(), security=Security(folder="pki"))
    assert exposure(fleet(), node, protocol, listens) is found
    assert exposure(secured, node, protocol, listens) is Exposure.SECURED
    at_home = replace(node, local=LocalSide(mode=LocalMode.PEER, listen=("tcp/127.0.0.1:7460", "tcp/localhost:7461")))
    assert exposure(fleet(), at_home, protocol, listens) is found
    assert exposure(secured, at_home, protocol, listens) is Exposure.SECURED
    abroad = replace(node, local=LocalSide(mode=LocalMode.PEER, listen=("tcp/127.0.0.1:7460", "tcp/0.0.0.0:7461")))
    assert exposure(fleet(), abroad, protocol, listens) is Exposure.OPEN
    assert exposure(secured, abroad, protocol, listens) is Exposure.OPEN


def test_plain_text_that_the_file_asks_for_is_a_problem_only_beside_tls() -> None:
    (node,) = fleet(PLAIN).nodes
    assert plain_text_problem(node, "tcp") is None
    assert f"lets robot1 listen on {PLAIN}: write tls/" in (plain_text_problem(node, "tls") or "")
    assert plain_text_problem(fleet(TLS).nodes[0], "tls") is None


def test_a_local_side_that_listens_for_other_machines_is_a_problem_beside_tls() -> None:
    (node,) = fleet(TLS).nodes
    at_home = replace(node, local=LocalSide(mode=LocalMode.PEER, listen=("tcp/127.0.0.1:7460",)))
    assert plain_text_problem(at_home, "tls") is None
    abroad = replace(node, local=LocalSide(mode=LocalMode.PEER, listen=("tcp/127.0.0.1:7460", "tcp/0.0.0.0:7461")))
    assert plain_text_problem(abroad, "tcp") is None
    assert "listens for other machines on tcp/0.0.0.0:7461: " in (plain_text_problem(abroad, "tls") or "")
