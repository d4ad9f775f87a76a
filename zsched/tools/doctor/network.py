"""Checks of addresses and ports, as far as this machine can see them.

Knows: names and addresses of the fleet file, who listens here, connections. Does not know: what nodes say of each other
(`zsched.tools.doctor.fleet`).
"""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures import TimeoutError as LateError
from typing import Final

from zsched.core.membership.solitude import TAKEN
from zsched.core.values.endpoint import OVER_TCP, Endpoint, is_loopback
from zsched.core.values.fleet import NodeSpec
from zsched.core.values.struct import Struct
from zsched.link.bus.address_trial import outcome_of
from zsched.link.sessions.own_addresses import dialled_here
from zsched.tools.doctor.model import Result, Scene, counted, failed, joined, passed, skipped, warned

RESOLVE_S: Final = 5.0


class Address(Struct, frozen=True, kw_only=True):
    """One endpoint of a node, as others dial it."""

    node: str
    session: str
    endpoint: str

    @property
    def host(self) -> str:
        """Empty: it is a path."""
        return Endpoint.of(self.endpoint).host

    def __str__(self) -> str:
        return f"{self.node}'s {self.session} session at {self.endpoint}"


def addresses(specs: Iterable[NodeSpec]) -> list[Address]:
    """Where these nodes can be dialled, by the fleet file."""
    return [
        Address(node=spec.name, session=session, endpoint=endpoint)
        for spec in specs
        for session, endpoint in (("control", spec.control_at), ("data", spec.data_at))
        if endpoint
    ]


# --- names -----------------------------------------------------------------------------------------------------------


def names_resolve(scene: Scene) -> Result:
    """Whether every host of the fleet file has an address here."""
    hosts = {host: address.node for address in addresses(scene.fleet.nodes) if (host := address.host)}
    if not hosts:
        return skipped("no node of the fleet file has an address")
    pool = ThreadPoolExecutor(max_workers=8)
    try:
        asked = {host: pool.submit(socket.getaddrinfo, host, 0, type=socket.SOCK_STREAM) for host in sorted(hosts)}
        found = []
        for host, answer in asked.items():
            fix = f"write {hosts[host]}'s address in the fleet file in place of its name, or mend DNS or /etc/hosts"
            try:
                answer.result(RESOLVE_S)
            except (OSError, UnicodeError) as error:
                found.append(failed(f"{host} ({hosts[host]}) has no address here: {error}", fix=fix))
            except LateError:
                found.append(failed(f"{host} ({hosts[host]}): no answer within {RESOLVE_S:g} s", fix=fix))
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
    return joined(found, passed(f"{counted(len(hosts), 'hosts')}: {', '.join(sorted(hosts))}"))


def is_not_alone_on_loopback(scene: Scene) -> Result:
    """Whether the others can use the addresses that the fleet file gives this machine."""
    mine = addresses([scene.me])
    others = addresses(spec for spec in scene.fleet.nodes if spec.name != scene.node)
    if not mine:
        return skipped(f"{scene.node} has no address: it dials the others")
    if others and all(_leads_here(address.host) for address in others):
        return skipped("all nodes of this fleet are on one machine")
    local = [address for address in mine if _leads_here(address.host)]
    if not local or len(scene.fleet.nodes) == 1:
        return passed(f"others dial {', '.join(address.endpoint for address in mine)}")
    fix = f"give {scene.node} a `host:` that the others reach; see the line of its name in /etc/hosts"
    return failed(*(f"{address}: only this machine reaches that" for address in local), fix=fix)


def _leads_here(host: str) -> bool:
    with contextlib.suppress(OSError, UnicodeError, ValueError):
        found = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)
        return all(is_loopback(str(one[4][0]).partition("%")[0]) for one in found)
    return False


# --- ports -----------------------------------------------------------------------------------------------------------


def ports_are_ours(scene: Scene) -> Result:
    """Whether somebody listens where this node's sessions do while its daemon runs, and else nobody."""
    listens = {"control": scene.me.listen_control, "data": scene.me.listen_data}
    if scene.own is None and scene.relay_version:
        del listens["data"]  # a relay outlives its daemon
    here = {session: end for session, listen in listens.items() if (end := Endpoint.of(dialled_here(listen))).port}
    fixed = {session: end for session, end in here.items() if end.protocol in OVER_TCP}
    if not fixed:
        return skipped(f"{scene.node} has no fixed port")
    return joined((_port(scene, session, end) for session, end in fixed.items()), passed())


def _port(scene: Scene, session: str, end: Endpoint) -> Result:
    is_taken, is_up = outcome_of(str(end)) == TAKEN, scene.own is not None
    if is_taken and not is_up:
        fix = f"`ss -ltnp 'sport = :{end.port}'` names it: end it, or give {scene.node} another port in the fleet file"
        return warned(f"a program listens at {end.place} ({session}), and no daemon of {scene.node} answers", fix=fix)
    if not is_taken and is_up:
        fix = "journalctl -u zsched says why it could not listen; the port in the fleet file may have changed"
        return failed(f"the daemon runs, and nobody listens at {end.place} ({session})", fix=fix)
    return passed(f"{end.place} ({session}) is {'held by its daemon or relay' if is_up else 'free'}")


# --- connections -----------------------------------------------------------------------------------------------------


def connected(found: list[Address]) -> Iterator[Result]:
    """A result for each address that takes no connection."""
    with ThreadPoolExecutor(max_workers=16) as pool:
        for address, what in zip(found, pool.map(outcome_of, (one.endpoint for one in found)), strict=True):
            if what not in ("", TAKEN):
                fix = f"on {address.node}: does its daemon run, does a firewall let the port in, is `host:` its address"
                yield failed(f"{address} cannot be reached from here: {what}", fix=fix)
