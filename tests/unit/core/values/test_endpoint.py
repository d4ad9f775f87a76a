"""Endpoints in every form of zenoh's grammar: what others dial of a listener."""

from __future__ import annotations

import pytest

from zsched.core.values.endpoint import Endpoint, is_loopback


@pytest.mark.parametrize(
    ("endpoint", "host", "dialled"),
    [
        ("tcp/0.0.0.0:7457", "192.0.2.11", "tcp/192.0.2.11:7457"),
        ("tcp/[::]:7457", "2001:db8::1", "tcp/[2001:db8::1]:7457"),
        ("tcp/[::0]:7457", "2001:db8::1", "tcp/[2001:db8::1]:7457"),
        ("tcp/[::ffff:0.0.0.0]:7457", "192.0.2.11", "tcp/192.0.2.11:7457"),
        ("tcp/[::]:7457", "edge1.local", "tcp/edge1.local:7457"),
        ("tcp/127.0.0.1:27450", "192.0.2.11", "tcp/127.0.0.1:27450"),
        ("tcp/[fd00::1]:7457", "", "tcp/[fd00::1]:7457"),
        ("tls/edge1.local:7457", "192.0.2.11", "tls/edge1.local:7457"),
        ("tcp/0.0.0.0:7457#iface=wg0", "192.0.2.11", "tcp/192.0.2.11:7457"),
        ("tcp/192.0.2.11:7457#iface=wg0;so_sndbuf=65536", "", "tcp/192.0.2.11:7457"),
        ("tls/0.0.0.0:7457?prio=1-3;rel=1#so_sndbuf=65536", "e1.local", "tls/e1.local:7457?prio=1-3;rel=1"),
        ("unixsock-stream//run/z.sock", "h", "unixsock-stream//run/z.sock"),
        ("serial//dev/ttyUSB0#baudrate=9600", "h", "serial//dev/ttyUSB0#baudrate=9600"),
        ("tcp/0.0.0.0:7457", "", ""),
        ("tcp/0.0.0.0:7457#iface=wg0", "", ""),
        ("tcp/127.0.0.1:0", "192.0.2.11", ""),
        ("tcp/127.0.0.1:0#iface=lo", "192.0.2.11", ""),
        ("", "192.0.2.11", ""),
        ("nonsense", "192.0.2.11", ""),
        ("tcp/", "192.0.2.11", ""),
        ("tcp/:7457", "192.0.2.11", ""),
    ],
)
def test_who_dials_a_listener_leaves_its_sockets_options_out(endpoint: str, host: str, dialled: str) -> None:
    assert Endpoint.of(endpoint).dialled(host) == dialled


def test_a_listener_elsewhere_keeps_what_its_socket_is_told() -> None:
    end = Endpoint.of("tcp/0.0.0.0:0?prio=1-3#iface=wg0;so_sndbuf=65536")
    assert (end.host, end.port, end.option("iface"), end.option("bind")) == ("0.0.0.0", 0, "wg0", "")  # noqa: S104 - nothing listens
    assert str(end.at("fd00::1", 7458)) == "tcp/[fd00::1]:7458?prio=1-3#iface=wg0;so_sndbuf=65536"
    assert end.place == "tcp/0.0.0.0:0"


def test_an_address_that_is_none_has_no_host_and_no_port() -> None:
    for text in ("", "tcp", "unixpipe//tmp/a:1", f"tcp/a:{'9' * 5000}", "tcp/a:7 7"):
        assert Endpoint.of(text).port is None
    assert Endpoint.of("vsock/-1:1234").host == ""


def test_only_an_address_of_this_machine_alone_is_loopback() -> None:
    hosts = ("127.0.0.1", "127.8.9.1", "::1", "[::1]", "192.0.2.1", "127.example.org", "localhost", "")
    assert [is_loopback(host) for host in hosts] == [True, True, True, True, False, False, False, False]
