"""Notices that this machine has another address in its fleet's network: another access point, another DHCP lease.

zenoh 1.10 reads the machine's addresses once in the life of a process, and tells by gossip where it listens. Workers on
other machines dial a robot without an address in the fleet file there, so after a change they dial where nobody is.
A daemon and a relay that begin again tell the new address.

Knows: the address from which this machine goes to others, since when. Does not know: who others are, how a daemon
begins again (`zsched.daemon`).
"""

from __future__ import annotations

import contextlib
import ipaddress
import socket
from collections.abc import Iterable, Sequence
from typing import Final

from zsched.core.values.endpoint import is_loopback
from zsched.core.values.struct import Struct

STAY_S: Final = 2.0
"""A new address must have been there for this long: a radio that roams may have none, or two, for a moment."""
MOST_HOSTS: Final = 4
"""Machines of one fleet are mostly in one network."""
ANY_HOST: Final = "192.0.2.1"
"""RFC 5737's example: whoever is reached by the default route. No packet is sent there."""
DISCARD: Final = 9


def places_of(hosts: Iterable[str]) -> tuple[str, ...]:
    """The addresses to look towards: ``hosts``; for names, which would have to be looked up, the default route.

    >>> places_of(["198.18.0.3", "edge2.local", "127.0.0.1"])
    ('198.18.0.3', '192.0.2.1')
    """
    found: list[str] = []
    for host in hosts:
        place = numeric(host) or ("" if host in ("", "localhost") or is_loopback(host) else ANY_HOST)
        if place and place not in found:
            found.append(place)
    return tuple(found[:MOST_HOSTS])


def numeric(host: str) -> str:
    """``host`` if it is an address of a network, else empty: names are not looked up again and again.

    >>> numeric("198.18.0.3"), numeric("edge2.local"), numeric("127.0.0.1")
    ('198.18.0.3', '', '')
    """
    try:
        ipaddress.ip_address(host.strip("[]"))
    except ValueError:
        return ""
    return "" if is_loopback(host) else host


def gone_from(home: str) -> str:
    """The problem of a machine that is not any more where the fleet file says."""
    return (
        f"the others dial this machine at {home}, which is none of its addresses any more: give it that address again, "
        f"or change its `host:` for all (`zsched edit`)"
    )


def addresses_towards(places: Iterable[str]) -> tuple[str, ...]:
    """This machine's own addresses, sorted, from which it would send to ``places``; a place without a way has none."""
    found = set()
    for place in places:
        with contextlib.suppress(OSError):
            family, kind, _, _, target = socket.getaddrinfo(
                place.strip("[]"), DISCARD, type=socket.SOCK_DGRAM, flags=socket.AI_NUMERICHOST
            )[0]
            with socket.socket(family, kind) as probe:
                probe.connect(target)  # of a datagram socket: only the way is looked up
                found.add(str(probe.getsockname()[0]))
    return tuple(sorted(found))


class Roaming(Struct):
    """Of one process: where it was when its sessions were opened, and whether it is elsewhere now."""

    began_at: tuple[str, ...]
    """This machine's addresses (`addresses_towards`) when the sessions were opened; none: there was no network."""
    _now_at: tuple[str, ...] = ()
    _since: float = 0.0

    def is_elsewhere(self, now_at: Sequence[str], now: float) -> bool:
        """Whether another address than at the beginning has been there for `STAY_S`; ask about every second.

        Args:
            now_at: `addresses_towards` now; none: there is no network, and nothing to begin again for.
            now: monotonic seconds.
        """
        here = tuple(now_at)
        if here != self._now_at:
            self._now_at, self._since = here, now
        return bool(here) and here != self.began_at and now >= self._since + STAY_S
