"""Decides where a node's sessions listen and which nodes they dial.

Knows: the fleet file's addresses, the seeds, which node dials which. Does not know: zenoh, what the links carry.
"""

from __future__ import annotations

import contextlib
import errno
import secrets
import socket
from collections.abc import Callable
from operator import attrgetter
from pathlib import Path
from typing import Final

from zsched.core.values.endpoint import Endpoint
from zsched.core.values.fleet import Fleet, NodeSpec
from zsched.core.values.model import NodeId, NodeKind
from zsched.core.values.struct import Struct
from zsched.link.sessions.own_addresses import dialled_here

PORT_RANGE: Final = Path("/proc/sys/net/ipv4/ip_local_port_range")
MIN_PORT: Final = 20_000
"""Below it there are more registered services."""
MAX_PORT: Final = 65_535
PORT_TRIES: Final = 64
DATA_PORT: Final = 7458
"""Where the relay of a node without `listen: {data: ...}` listens: its host's applications need no fleet file."""


class Endpoints(Struct, frozen=True, kw_only=True):
    """Where this node's sessions listen and which nodes they dial."""

    control_listen: tuple[str, ...]
    control_connect: tuple[str, ...]
    data_listen: tuple[str, ...]
    data_connect: tuple[str, ...]
    worker_connect: tuple[str, ...]
    control_by_gossip: bool
    """Whether the control session dials nodes that it hears of by gossip; the same for the relay's and the workers'."""
    data_by_gossip: bool
    worker_by_gossip: bool


def endpoints_for(
    fleet: Fleet,
    me: NodeSpec,
    free_port: Callable[[], int],
    is_here: Callable[[str], bool] = lambda _host: True,
    protocol: str = "tcp",
) -> Endpoints:
    """The endpoints of one node: its own to listen on, the others' to dial.

    What the fleet file does not say listens with ``protocol`` (`zsched.link.sessions.tls`).

    A link is dialled by one side only: of two that redial each other one may take the other's new link for a part of
    its old session, and tells it nothing again (eclipse-zenoh/zenoh#2806). A node without an address dials every node
    that has one; two without one meet by gossip, and zenoh's ids decide which one dials. Workers dial their own
    relay first, then the robots', and listen nowhere, so nobody dials them.
    Our own address on another machine (``is_here``) is dialled too: there a twin of ours may be, and must be heard.
    """
    robots = [node for node in fleet.nodes if node.kind is NodeKind.ROBOT and node.name != me.name]
    data_listen = me.listen_data or f"{protocol}/0.0.0.0:0"
    data = Endpoint.of(data_listen)
    if data.port == 0:  # any port will do, but workers must know which
        data_listen = str(data.at(data.host, free_port()))
    return Endpoints(
        control_listen=(me.listen_control or f"{protocol}/0.0.0.0:0",),
        control_connect=_dialled(_targets(fleet, me, _control, is_here), _control),
        data_listen=(data_listen,),
        data_connect=_dialled(_targets(fleet, me, _data), _data),
        worker_connect=(
            dialled_here(data_listen),
            *_dialled(robots, _data),
        ),
        control_by_gossip=not _dialled([me], _control) and len(_hidden(list(fleet.nodes), _control)) > 1,
        data_by_gossip=not _dialled([me], _data),
        worker_by_gossip=bool(_hidden(robots, _data)),
    )


_control: Callable[[NodeSpec], str] = attrgetter("control_at")
_data: Callable[[NodeSpec], str] = attrgetter("data_at")


def _targets(
    fleet: Fleet, me: NodeSpec, endpoint: Callable[[NodeSpec], str], is_here: Callable[[str], bool] = lambda _host: True
) -> list[NodeSpec]:
    """The nodes that this one dials: the seeds, and those of the others that come before it by name, if it can."""

    def rank(node: NodeSpec) -> tuple[int, NodeId]:
        return (fleet.seeds.index(node.name) if node.name in fleet.seeds else len(fleet.seeds), node.name)

    has_mine = bool(_dialled([me], endpoint))
    mine = [me] if has_mine and not is_here(me.host) else []
    others = [node for node in fleet.nodes if node.name != me.name and _dialled([node], endpoint)]
    return mine + [node for node in others if rank(node) < rank(me) or not has_mine]


def _hidden(nodes: list[NodeSpec], endpoint: Callable[[NodeSpec], str]) -> list[NodeSpec]:
    """Who cannot be dialled by the fleet file alone."""
    return [node for node in nodes if not _dialled([node], endpoint)]


def _dialled(nodes: list[NodeSpec], endpoint: Callable[[NodeSpec], str]) -> tuple[str, ...]:
    return tuple(endpoint(node) for node in nodes if endpoint(node))


def is_here(host: str) -> bool:
    """Whether ``host`` is an address of this machine (of its network namespace); unknown names are taken for ours."""
    try:
        family, *_, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family) as probe:
            probe.bind(address)
    except OSError as error:
        return error.errno != errno.EADDRNOTAVAIL
    return True


def free_port(outgoing: range | None = None) -> int:
    """A TCP port that is free now (a node without a fixed data endpoint: its workers must know it).

    It is none of those that the kernel gives to ``outgoing`` connections, unless those are all: such a connection may
    last for hours, and would keep the relay out, before it listens or when it starts again.
    """
    outgoing = _outgoing_ports() if outgoing is None else outgoing
    for ports in (range(outgoing.stop, MAX_PORT + 1), range(MIN_PORT, outgoing.start)):
        for port in secrets.SystemRandom().sample(ports, min(len(ports), PORT_TRIES)):
            with contextlib.suppress(OSError):
                return _bound_port(port)
    return _bound_port(0)


class PortClaim(Struct):
    """A port that this process, and no other zsched of this machine, may listen on until it closes the claim."""

    port: int
    _name: socket.socket

    def close(self) -> None:
        """Give it back."""
        self._name.close()


def claim_port(port: int) -> PortClaim | None:
    """Claim a TCP port; ``None`` when another zsched of this network namespace holds it, or somebody listens there.

    Of two daemons that start at once both would find the port free; an abstract socket has one name, lives in the same
    namespace as the port, and ends with its process, however that ends.
    """
    name = socket.socket(socket.AF_UNIX)
    try:
        name.bind(f"\0zsched/port/{port}")
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # connections that are over do not count
            probe.bind(("0.0.0.0", port))  # noqa: S104 - only asks the kernel, never listens
    except OSError:
        name.close()
        return None
    return PortClaim(port=port, _name=name)


def _outgoing_ports() -> range:
    try:
        low, high = (int(word) for word in PORT_RANGE.read_text().split())
    except (OSError, ValueError):
        low, high = 32768, 60999  # Linux's default
    return range(low, high + 1)


def _bound_port(port: int) -> int:
    with socket.socket() as probe:
        probe.bind(("0.0.0.0", port))  # noqa: S104 - only asks the kernel, never listens
        bound: int = probe.getsockname()[1]
        return bound
