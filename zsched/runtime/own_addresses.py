"""Tells at which addresses of this machine an endpoint takes connections, and whether others can reach one.

Knows: the kernel's tables of its own addresses. Does not know: what listens, who may reach it.
"""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final

FIB: Final = Path("proc/net/fib_trie")
"""The kernel's routes: after a line with an address one that calls it ``host LOCAL`` if it is this machine's."""
IF_INET6: Final = Path("proc/net/if_inet6")

Address = ipaddress.IPv4Address | ipaddress.IPv6Address


def addresses_at(root: Path, host: str) -> Iterator[Address]:
    """The addresses of this machine that ``host`` stands for; of a name none. ``root`` is "/" but in tests."""
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return
    if not address.is_unspecified:
        yield address
        return
    yield from _ipv4(root)
    if address.version == 6:
        yield from _ipv6(root)


def _ipv4(root: Path) -> Iterator[Address]:
    seen: set[Address] = set()
    last = ""
    for line in _lines(root / FIB):
        if match := re.search(r"\|-- (\S+)", line):
            last = match[1]
        elif "host LOCAL" in line and last:
            address = ipaddress.ip_address(last)
            if address not in seen:
                seen.add(address)
                yield address


def _ipv6(root: Path) -> Iterator[Address]:
    for line in _lines(root / IF_INET6):
        yield ipaddress.IPv6Address(int(line.split()[0], 16))


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="ascii", errors="replace").splitlines()
    except OSError:
        return []
