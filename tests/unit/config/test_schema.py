"""What the texts of a fleet file may say: addresses."""

from __future__ import annotations

from zsched.config.schema import is_loopback


def test_only_an_address_of_this_machine_alone_is_loopback() -> None:
    hosts = ("127.0.0.1", "127.8.9.1", "::1", "[::1]", "192.0.2.1", "127.example.org", "localhost", "")
    assert [is_loopback(host) for host in hosts] == [True, True, True, True, False, False, False, False]
