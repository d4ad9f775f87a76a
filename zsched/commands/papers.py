"""The certificates of machines that found a fleet or join one, and what is refused where there are none.

Knows: how they are made, which addresses are open to strangers. Does not know: which files a machine keeps
(`zsched.runtime.membership`), how certificates are made (`zsched.commands.pki`).
"""

from __future__ import annotations

import ipaddress
import os
import socket
from collections.abc import Collection, Iterable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

from zsched import paths as places
from zsched.commands.apply import DANGERS, OPEN_NETWORK
from zsched.commands.common import CliError, check_dangers, check_name, warn
from zsched.commands.pki import (
    begin_for,
    former_keys,
    is_left_of,
    issue_for,
    passphrase_for,
    supersede,
)
from zsched.commands.renewing import holds_authority, renew_advice
from zsched.core.values.fleet import Fleet
from zsched.core.values.model import NodeId
from zsched.errors import AdapterError
from zsched.exits import EXIT_FAILED, EXIT_USAGE
from zsched.files import read_regular
from zsched.runtime.membership import Places, Written, request_here
from zsched.runtime.own_addresses import addresses_at
from zsched.runtime.unfinished import mark_of
from zsched.wire.invitation import Papers

if TYPE_CHECKING:
    from zsched.commands.pki import Begun  # holds what imports cryptography

MAX_REQUEST: Final = 1 << 20
FIRST_KEY: Final = "ca-1.key"
"""Of a new authority."""
EVERYWHERE: Final = ("0.0.0.0", "::")  # noqa: S104 - compared with


class FirstPapers:
    """Makes the authority of a new fleet and its first certificate, once nothing else is in the way."""

    def __init__(self, fleet: str, node: NodeId, authority: Path | None, *, asks_passphrase: bool) -> None:
        """``authority``: its folder; ``None``: where `zsched pki` looks."""
        self._node, self._authority, self._asks = node, authority, asks_passphrase
        self._begun: Begun | None = None
        self._fleet, self._folder = fleet, places.authority_folder(authority, os.environ, fleet)

    def check(self, creation: str = "") -> None:
        """Refuse to begin where there is an authority, but for one that this creation has left.

        Raises:
            CliError: there is one.
        """
        is_left = is_left_of(creation, self._fleet, self._node, self._authority)
        if not is_left and holds_authority(self._fleet, self._authority) is not None:
            advice = "if no fleet needs it any more, move it away; another folder: --authority DIR"
            raise CliError(EXIT_FAILED, f"{self._folder} holds an authority, and is left as it is; {advice}")

    def certify(self, fleet: Fleet, creation: str) -> Papers:
        """The certificate and key of the first node; what an earlier try of this creation has left is deleted.

        Raises:
            CliError: there is an authority already.
            AdapterError: its folder cannot be written.
        """
        is_left_of(creation, self._fleet, self._node, self._authority, is_destroyed=True)
        self.check()
        begun = self._begun = begin_for(
            fleet, self._node, self._authority, asks_passphrase=self._asks, creation=creation
        )
        issued = begun.issued
        certificate, key, trusted = (pem.decode("ascii") for pem in (issued.certificate, issued.key, issued.trusted))
        return Papers(certificate=certificate, key=key, trusted=trusted)

    def destroy(self, config: Path) -> None:
        """The fleet was not founded: nobody has a certificate of its authority, so it goes, and then the mark."""
        if self._begun is not None:
            with suppress(OSError):
                self._begun.authority.destroy()
                mark_of(config).unlink(missing_ok=True)

    @property
    def files(self) -> tuple[Written, ...]:
        """What is written of the authority."""
        what = "the key of the fleet's authority: who has it lets machines in"
        return (Written(path=self._folder / FIRST_KEY, what=what),)

    @property
    def advice(self) -> tuple[str, ...]:
        """How the key goes offline, and how certificates are renewed."""
        is_locked = self._begun is not None and self._begun.is_locked
        lock = "" if is_locked else ", not locked (--passphrase does that)"
        said = f"the authority's key lies on this machine{lock}; no daemon needs it"
        how = (
            f"move the folder {self._folder} to a stick, and name it to `zsched invite` and `zsched pki` by --authority"
        )
        return f"{said}. To take it offline, {how}", renew_advice(self._folder, self._fleet, is_locked=is_locked)


def key_to_papers(fleet: Fleet, authority: Path | None) -> bytes:
    """What opens the authority's key, asked for before anything is changed; empty: nothing is needed.

    Raises:
        CliError: nobody types it.
        AdapterError: it is wrong, or the authority cannot be used.
    """
    return b"" if fleet.security is None else passphrase_for(fleet, authority) or b""


def keys_to_revoke(fleet: Fleet, node: NodeId, authority: Path | None, request: Path | None) -> tuple[str, ...]:
    """The labels of keys that a machine has had, with which it is not let in any more once it is invited again.

    An invitation may be lost, and a machine that has left keeps its key. Empty without certificates, and where the
    authority is not on this machine.

    Raises:
        AdapterError: a file cannot be used.
    """
    if fleet.security is None:
        return ()
    return former_keys(fleet, node, authority, b"" if request is None else read_request(request))


def papers_for(
    fleet: Fleet, node: NodeId, authority: Path | None, request: Path | None, secret: bytes
) -> Papers | None:
    """The certificate of an invited node; ``None``: the fleet has none, or the authority is not on this machine.

    ``secret``: of `key_to_papers`.

    Raises:
        AdapterError: the node has a certificate already, or a file cannot be used.
    """
    if fleet.security is None:
        return None
    supersede(fleet, keys_to_revoke(fleet, node, authority, request), authority)
    issued = issue_for(fleet, node, authority, secret, b"" if request is None else read_request(request))
    if issued is None:
        advice = f"where it is: zsched pki issue {node}; bring its files to the machine before it starts"
        warn(f"the invitation has no certificate: the fleet's authority is not on this machine; {advice}")
        return None
    certificate, key, trusted = (pem.decode("ascii") for pem in (issued.certificate, issued.key, issued.trusted))
    return Papers(certificate=certificate, key=key, trusted=trusted)


def check_request(fleet: Fleet, request: Path | None, authority: Path | None) -> None:
    """Refuse a request that nobody here can answer, before anything is changed.

    Raises:
        CliError: the fleet has no certificates, or its authority is not on this machine.
        AdapterError: the file is no request.
    """
    if request is None:
        return
    if fleet.security is None:
        raise CliError(EXIT_USAGE, f"--csr: fleet {fleet.name} has no certificates; invite the machine without it")
    if holds_authority(fleet.name, authority) is None:
        advice = "invite where it is, or name its folder with --authority DIR"
        raise CliError(EXIT_FAILED, f"--csr: the authority of fleet {fleet.name} is not on this machine; {advice}")
    from zsched.pki.certificates import requested_key  # noqa: PLC0415 - imports cryptography

    try:
        requested_key(read_request(request))
    except ValueError as error:
        raise AdapterError(f"{request}: {error}; make it anew: zsched join --request NAME") from error


def read_request(path: Path) -> bytes:
    """A certificate request in a file.

    Raises:
        AdapterError: it cannot be read.
    """
    try:
        return read_regular(path, MAX_REQUEST) or b"-"
    except OSError as error:
        raise AdapterError(f"{path}: cannot be read: {error.strerror}") from error


def ask_for_certificate(name: str, where: Places, out: Path | None) -> tuple[Written, ...]:
    """Make this machine's key, and a request with which it is invited; what was written.

    Raises:
        CliError: it is no name.
        AdapterError: this machine has a certificate already, or a file cannot be written.
    """
    check_name(name)
    return request_here(name, where, out or Path(f"{name}.csr"))


# --- without certificates --------------------------------------------------------------------------------------------


def refuse_open_network(hosts: Iterable[str], accepted: Collection[str]) -> None:
    """Refuse to let a node without certificates listen where strangers may reach it.

    Args:
        hosts: addresses and names at which nodes are dialled; 0.0.0.0 and ``::`` are all addresses of this machine.
        accepted: dangers that the operator has accepted.

    Raises:
        CliError: an address is outside loopback and private ranges, or a name leads to none that can be looked at.
    """
    check_dangers(accepted, DANGERS)
    if OPEN_NETWORK in accepted:
        return
    for host in hosts:
        public = [str(one) for one in _addresses(host) if one.is_global]
        advice = f"let the fleet have certificates (the default), or say --accept {OPEN_NETWORK}"
        if public:
            said = host if public == [host] else f"{public[0]} ({'this machine' if host in EVERYWHERE else host})"
            raise CliError(
                EXIT_FAILED,
                f"without certificates anybody who reaches {said} reads and changes everything, "
                f"and it is no loopback or private address; {advice}",
            )


def _addresses(host: str) -> list[ipaddress.IPv4Address | ipaddress.IPv6Address]:
    if host in EVERYWHERE:
        return list(addresses_at(Path("/"), host))
    try:
        return [ipaddress.ip_address(host)]
    except ValueError:
        pass
    try:
        found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
    except OSError as error:
        advice = f"give an address, let the fleet have certificates (the default), or say --accept {OPEN_NETWORK}"
        message = f"without certificates: nobody knows whether {host} is a private address ({error.strerror}); {advice}"
        raise CliError(EXIT_FAILED, message) from error
    return [ipaddress.ip_address(str(one[4][0]).partition("%")[0]) for one in found]
