"""What the texts of a fleet file may say: hosts and endpoints."""

from __future__ import annotations

import pytest

from zsched.config.schema import endpoint_fault, host_fault


@pytest.mark.parametrize(
    "text",
    ["tcp/0.0.0.0:7447#iface=wg0;so_sndbuf=65536", "udp/[::]:1?prio=1-3#iface=wg0", "vsock/-1:1", "unixpipe//run/z"],
)
def test_an_endpoint_in_zenoh_s_grammar_is_taken(text: str) -> None:
    assert endpoint_fault(text) is None


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("tcp/0.0.0.0:7447#", "behind the address"),
        ("tcp/0.0.0.0:7447?#iface=wg0", "behind the address"),
        ("tcp/0.0.0.0:7447#iface=wg0?prio=1-3", "behind the address"),
        ("tcp/[fe80::1]:7447", "of one card"),
        ("tcp/[fe80::1%eth0]:7447", "of one card"),
        ("tcp/[2001:db8::1%2]:7447", "of one card"),
        ("tcp/0.0.0.0:70000", "PORT"),
        ("tcp/::1:7447", "brackets"),
        ("TCP/0.0.0.0:7447", "must begin with"),
    ],
)
def test_what_zenoh_would_refuse_or_nobody_else_could_dial_is_a_fault(text: str, words: str) -> None:
    assert words in (endpoint_fault(text) or "")


def test_a_host_with_a_zone_is_of_one_machine() -> None:
    assert "of one card" in (host_fault("fe80::1%eth0") or "")
    assert host_fault("169.254.7.1") is None, "an IPv4 one has no zone"
