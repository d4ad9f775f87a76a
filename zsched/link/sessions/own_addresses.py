"""Tells at which addresses of this machine an endpoint takes connections, and whether others can reach one.

Knows: the kernel's tables of its own addresses. Does not know: what listens, who may reach it.
"""

from __future__ import annotations

import contextlib
import fcntl
import ipaddress
import re
import socket
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from zsched.core.values.endpoint import Endpoint

FIB: Final = Path("proc/net/fib_trie")
"""The kernel's routes: after a line with an address one that calls it ``host LOCAL`` if it is this machine's."""
IF_INET6: Final = Path("proc/net/if_inet6")
_SIOCGIFADDR: Final = 0x8915
"""The address of a card (netdevice(7)), in a record that begins with its name."""
_NAME_BYTES: Final = 15

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


def dialled_here(listen: str) -> str:
    """Where programs of this machine dial a listener of it; empty: they cannot.

    A card of its own (``iface=``) is told nothing that comes by loopback: there it is the card's address.
    """
    end = Endpoint.of(listen)
    card = end.option("iface")
    return end.dialled((_of_card(card) if card else "") or "127.0.0.1")


def _of_card(name: str) -> str:
    """The first IPv4 address of a network card, else the first of IPv6 that needs no zone; empty: it has none."""
    with contextlib.suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        found = fcntl.ioctl(probe, _SIOCGIFADDR, struct.pack("256s", name.encode()[:_NAME_BYTES]))
        return socket.inet_ntoa(found[20:24])
    words = [line.split() for line in _lines(Path("/") / IF_INET6)]
    return next((str(ipaddress.IPv6Address(int(one[0], 16))) for one in words if (one[5], one[3]) == (name, "00")), "")
