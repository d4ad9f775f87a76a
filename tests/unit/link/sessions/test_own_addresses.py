"""At which addresses of a machine something listens, by the kernel's tables."""

from __future__ import annotations

from pathlib import Path

from zsched.link.sessions.own_addresses import FIB, IF_INET6, addresses_at

TABLE = """\
Main:
  +-- 0.0.0.0/0 3 0 5
     |-- 10.0.0.7
        /32 host LOCAL
     |-- 10.0.0.255
        /32 link BROADCAST
Local:
     |-- 10.0.0.7
        /32 host LOCAL
     |-- 127.0.0.1
        /32 host LOCAL
"""
ALL = "0.0.0.0"  # noqa: S104 - looked up
SIX = "20014860000000000000000000000001 02 40 00 00 eth0\n"


def told(root: Path, host: str) -> list[str]:
    return [str(one) for one in addresses_at(root, host)]


def test_one_address_is_itself_and_all_are_those_of_the_kernel(tmp_path: Path) -> None:
    (tmp_path / FIB).parent.mkdir(parents=True)
    (tmp_path / FIB).write_text(TABLE)
    (tmp_path / IF_INET6).write_text(SIX)
    assert told(tmp_path, "192.0.2.1") == ["192.0.2.1"]
    assert told(tmp_path, ALL) == ["10.0.0.7", "127.0.0.1"]
    assert told(tmp_path, "::") == ["10.0.0.7", "127.0.0.1", "2001:4860::1"]
    assert told(tmp_path, "robot4.local") == []
