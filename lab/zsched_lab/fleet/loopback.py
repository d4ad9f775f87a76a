"""Gives each process of lab and tests a loopback address of its own, and ports there.

Knows: that Linux has all of 127/8, process ids, what the kernel gives back by itself. Does not know: listeners.

Two runs on one machine never ask for the same endpoint: an address is leased by the name of an abstract socket, which
lives in the same network namespace as the address and ends with the process, however it ends.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import socket
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

FIRST_ADDRESS, ADDRESSES = 0x7F40_0000, 1 << 22
"""From 127.64.0.0 on, one for each process id that Linux may give."""
STRIDE: Final = 40_503
"""From one address that is taken to the next; odd, so that all of them are tried."""
PORTS: Final = range(12_000, 32_000)
"""Below those that the kernel gives to outgoing connections."""


@dataclass(slots=True)
class _Lease:
    """One process's address."""

    pid: int
    address: str
    descriptor: int
    """Of the socket with the address's name: open for the process's life."""
    ports: Iterator[int] = field(default_factory=lambda: itertools.cycle(PORTS))


_held: list[_Lease] = []
"""The newest is ours; what a forked child inherits stays its parent's."""


def own_address() -> str:
    """The loopback address that this process, and no other of this machine's labs, uses until it ends."""
    return _lease().address


def free_endpoints(count: int) -> list[str]:
    """This many different zenoh endpoints on `own_address` where nobody listens; none is given a second time."""
    lease = _lease()
    return [f"tcp/{lease.address}:{_free_port(lease)}" for _ in range(count)]


def free_endpoint() -> str:
    """One of them."""
    return free_endpoints(1)[0]


def _lease() -> _Lease:
    if not _held or _held[-1].pid != os.getpid():
        _held.append(_take(os.getpid()))
    return _held[-1]


def _take(pid: int) -> _Lease:
    for attempt in itertools.count():
        number = FIRST_ADDRESS + (pid + attempt * STRIDE) % ADDRESSES
        address = socket.inet_ntoa(number.to_bytes(4, "big"))
        name = socket.socket(socket.AF_UNIX)
        try:
            name.bind(f"\0zsched.lab/{address}")
        except OSError:
            name.close()
            if attempt == ADDRESSES:
                raise
            continue
        return _Lease(pid=pid, address=address, descriptor=name.detach())
    raise AssertionError  # not reached: the loop returns or raises


def _free_port(lease: _Lease) -> int:
    """The next port; somebody who listens on 0.0.0.0, or an orphan of an earlier process, may have one."""
    for port in itertools.islice(lease.ports, len(PORTS)):
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.bind((lease.address, port))
            return port
    raise OSError(f"no port of {PORTS} is free on {lease.address}")
