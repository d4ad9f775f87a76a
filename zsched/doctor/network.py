"""Checks of addresses and ports, as far as this machine can see them.

Knows: names and addresses of the fleet file, who listens here, connections. Does not know: what nodes say of each other
(`zsched.doctor.fleet`).
"""

from __future__ import annotations

import contextlib
import ipaddress
import os
import socket
import sys
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures import TimeoutError as LateError
from pathlib import Path
from typing import Final

from zsched.core.values.endpoint import OVER_TCP, Endpoint, is_loopback
from zsched.core.values.fleet import NodeSpec
from zsched.core.values.struct import Struct
from zsched.doctor.model import Result, Scene, counted, failed, joined, passed, skipped, warned
from zsched.procfs import names, read_file

RESOLVE_S: Final = 5.0
CONNECT_S: Final = 2.0
LISTENS: Final = "0A"
"""The state of a listening socket in /proc/net/tcp."""
WILDCARDS: Final = frozenset({"0.0.0.0", "::"})  # noqa: S104 - what others listen at
OURS: Final = ("zsched.daemon", "zsched.relay")


class Address(Struct, frozen=True, kw_only=True):
    """One endpoint of a node, as others dial it."""

    node: str
    session: str
    endpoint: str

    @property
    def is_stream(self) -> bool:
        """Whether a TCP connection says something of it."""
        return Endpoint.of(self.endpoint).protocol in OVER_TCP

    @property
    def place(self) -> tuple[str, int]:
        """(host, port); of a path none."""
        end = Endpoint.of(self.endpoint)
        return end.host, end.port or 0

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
    hosts = {host: address.node for address in addresses(scene.fleet.nodes) if (host := address.place[0])}
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
    if others and all(_leads_here(address.place[0]) for address in others):
        return skipped("all nodes of this fleet are on one machine")
    local = [address for address in mine if _leads_here(address.place[0])]
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
    """Whether nobody but this node's daemon and relay listens on its ports."""
    ports: list[tuple[str, int, str]] = []
    for session, listen in (("control", scene.me.listen_control), ("data", scene.me.listen_data)):
        end = Endpoint.of(listen)
        if end.port and end.protocol in OVER_TCP:
            ports.append((end.host, end.port, session))
    if not ports:
        return skipped(f"{scene.node} has no fixed port")
    listening = _listeners()
    found = ((port, session, _at(host, listening.get(port, []))) for host, port, session in ports)
    return joined((_port(scene, port, session, inodes) for port, session, inodes in found), passed())


def _at(host: str, listeners: list[tuple[str, str]]) -> set[str]:
    """The sockets among these that listen at ``host``; a wildcard address meets every other one.

    Two daemons may have one port at different addresses of a machine.
    """
    wanted: set[str] = set()
    with contextlib.suppress(OSError, UnicodeError):
        wanted = {_plain(str(one[4][0])) for one in socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)}
    if not wanted or wanted & WILDCARDS:
        return {inode for _, inode in listeners}
    return {inode for address, inode in listeners if address in wanted or address in WILDCARDS}


def _plain(address: str) -> str:
    """An address without its zone; one of IPv4 that is written in IPv6 as itself."""
    found = ipaddress.ip_address(address.partition("%")[0])
    mapped = found.ipv4_mapped if isinstance(found, ipaddress.IPv6Address) else None
    return str(mapped or found)


def _port(scene: Scene, port: int, session: str, inodes: set[str]) -> Result:
    is_up = scene.own is not None
    if not inodes:
        if not is_up:
            return passed(f"port {port} ({session}) is free")
        fix = "journalctl -u zsched says why it could not listen; the port in the fleet file may have changed"
        return failed(f"the daemon runs, and nobody listens on port {port} ({session})", fix=fix)
    holders = _holders(inodes)
    if not holders:
        told = f"port {port} ({session}) is held by a process that user {os.geteuid()} may not look at"
        return passed(told) if is_up else warned(told, fix="run the doctor as root to see which it is")
    strangers = [(pid, words) for pid, words in holders if not _is_ours(words, scene.node)]
    if strangers:
        pid, words = strangers[0]
        told = f"port {port} ({session}) is held by process {pid}: {' '.join(words)[:120]}"
        return failed(told, fix=f"stop process {pid}, or give {scene.node} another port in the fleet file")
    return passed(f"port {port} ({session}) is held by process {holders[0][0]} of {scene.node}")


def _is_ours(words: list[str], node: str) -> bool:
    return any(module in words for module in OURS) and not {node, f"--node={node}"}.isdisjoint(words)


def _listeners() -> dict[int, list[tuple[str, str]]]:
    """{TCP port: (address, inode) of every socket that listens on it} of this network namespace."""
    found: dict[int, list[tuple[str, str]]] = {}
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        with contextlib.suppress(OSError):
            for line in Path(table).read_text(encoding="ascii").splitlines()[1:]:
                fields = line.split()
                if fields[3] == LISTENS:
                    address, _, port = fields[1].partition(":")
                    found.setdefault(int(port, 16), []).append((_address(address), fields[9]))
    return found


def _address(digits: str) -> str:
    """An address as /proc/net writes it, 32 bits at a time in the machine's own order."""
    words = (int(digits[at : at + 8], 16) for at in range(0, len(digits), 8))
    packed = b"".join(word.to_bytes(4, sys.byteorder) for word in words)
    return _plain(str(ipaddress.ip_address(packed)))


def _holders(inodes: set[str]) -> list[tuple[int, list[str]]]:
    """(process, its command) of every process that has one of these sockets open, as far as this user may look."""
    wanted = {f"socket:[{inode}]" for inode in inodes}
    found = []
    for pid in (name for name in names("/proc") if name.isdecimal()):
        for descriptor in names(f"/proc/{pid}/fd"):
            with contextlib.suppress(OSError):
                if str(Path(f"/proc/{pid}/fd/{descriptor}").readlink()) in wanted:
                    words = read_file(f"/proc/{pid}/cmdline").decode(errors="replace").split("\0")
                    found.append((int(pid), [word for word in words if word]))
                    break
    return found


# --- connections -----------------------------------------------------------------------------------------------------


def connected(found: list[Address]) -> Iterator[Result]:
    """A result for each address that takes no connection."""
    streams = [address for address in found if address.is_stream]
    with ThreadPoolExecutor(max_workers=16) as pool:
        for address, why in zip(streams, pool.map(_why_not, streams), strict=True):
            if why:
                fix = f"on {address.node}: does its daemon run, does a firewall let the port in, is `host:` its address"
                yield failed(f"{address} cannot be reached from here: {why}", fix=fix)


def _why_not(address: Address) -> str:
    try:
        socket.create_connection(address.place, CONNECT_S).close()
    except TimeoutError:
        return f"no answer within {CONNECT_S:g} s"
    except (OSError, UnicodeError) as error:
        return str(getattr(error, "strerror", None) or error)
    return ""
