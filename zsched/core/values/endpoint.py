"""zenoh's endpoints, ``PROTOCOL/ADDRESS[?metadata][#options]``: taken apart, and what others dial of a listener.

Metadata is of the link, both ends'. Options are of one socket: the card (``iface=``), the buffers. So who dials a
listener leaves its options out, as zenoh does with the addresses that it gossips.

Knows: zenoh's grammar. Does not know: names, this machine's addresses.
"""

from __future__ import annotations

import ipaddress
import re
from typing import Final

from zsched.core.values.struct import Struct, replace

HOST_PORT: Final = ("tcp", "udp", "tls", "quic", "ws")
WITH_PATH: Final = ("unixsock-stream", "unixpipe", "serial", "vsock")
OVER_TCP: Final = ("tcp", "tls", "ws")
_PARTS: Final = re.compile(r"([^/]*)/?([^?#]*)(?:\?([^#]*))?(?:#(.*))?", re.DOTALL)


class Endpoint(Struct, frozen=True, kw_only=True):
    """One endpoint; of a text that is none some parts are empty."""

    protocol: str
    address: str
    metadata: str = ""
    options: str = ""

    @classmethod
    def of(cls, text: str) -> Endpoint:
        """The parts of a text."""
        found = _PARTS.fullmatch(text)
        protocol, address, metadata, options = found.groups("") if found is not None else ("", "", "", "")
        return cls(protocol=protocol, address=address, metadata=metadata, options=options)

    @property
    def host(self) -> str:
        """The host, an IPv6 address without brackets; empty where the address is a path."""
        return self.address.rpartition(":")[0].strip("[]") if self.protocol in HOST_PORT else ""

    @property
    def port(self) -> int | None:
        """The port; ``None``: the address has none."""
        port = self.address.rpartition(":")[2]
        is_port = self.protocol in HOST_PORT and port.isascii() and port.isdigit() and len(port) <= len("65535")
        return int(port) if is_port else None

    @property
    def place(self) -> str:
        """Protocol and address, as zenoh names a link's end."""
        return f"{self.protocol}/{self.address}"

    @property
    def is_everywhere(self) -> bool:
        """Whether it is all addresses of its machine, or of its card."""
        try:
            address = ipaddress.ip_address(self.host)
        except ValueError:
            return False
        return address.is_unspecified or getattr(address, "ipv4_mapped", None) == ipaddress.IPv4Address(0)

    @property
    def is_own_host(self) -> bool:
        """Whether only programs of its machine reach a listener there; a name but ``localhost`` is no proof.

        >>> [Endpoint.of(f"{end}:1").is_own_host for end in ("tcp/127.1.2.3", "tcp/[::1]", "ws/localhost", "tcp/box")]
        [True, True, True, False]
        """
        return self.protocol in ("unixsock-stream", "unixpipe") or self.host == "localhost" or is_loopback(self.host)

    def option(self, name: str) -> str:
        """The value of an option; empty: it is not set."""
        pairs = (one.partition("=") for one in self.options.split(";"))
        return next((value for key, _, value in pairs if key == name), "")

    def at(self, host: str, port: int | None = None) -> Endpoint:
        """The same at another host, or port."""
        literal = f"[{host}]" if ":" in host else host
        return replace(self, address=f"{literal}:{self.port if port is None else port}")

    def dialled(self, host: str) -> str:
        """Under which endpoint a listener there, on the machine ``host``, is reached; empty: it cannot be.

        A listener on every address is dialled at ``host``; port 0 (any) cannot be dialled.

        >>> Endpoint.of("tcp/0.0.0.0:7457?prio=1-3#iface=wg0").dialled("192.0.2.11")
        'tcp/192.0.2.11:7457?prio=1-3'
        """
        if self.protocol in WITH_PATH:
            return str(self)
        host = host if self.is_everywhere else self.host
        return str(replace(self.at(host), options="")) if host and self.port else ""

    def __str__(self) -> str:
        """As zenoh reads it."""
        more = "".join(f"{mark}{part}" for mark, part in (("?", self.metadata), ("#", self.options)) if part)
        return f"{self.place}{more}"


def is_loopback(host: str) -> bool:
    """Whether a host is an address that only this machine reaches; a name is none.

    >>> [is_loopback(host) for host in ("127.0.0.1", "[::1]", "192.0.2.1", "localhost", "")]
    [True, True, False, False, False]
    """
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False
