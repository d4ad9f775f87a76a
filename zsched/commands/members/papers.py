"""The certificates of machines that found a fleet or join one, and what is refused where there are none.

Knows: how they are made, which addresses are open to strangers. Does not know: which files a machine keeps
(`zsched.commands.members.belongings`), how certificates are made (`zsched.commands.members.pki`).
"""

from __future__ import annotations

import ipaddress
import os
import socket
from collections.abc import Collection, Iterable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

from zsched.commands.act.apply import DANGERS, OPEN_NETWORK
from zsched.commands.base.common import CliError, check_dangers, check_name, warn
from zsched.commands.base.places import Places
from zsched.commands.base.renewing import holds_authority, renew_advice
from zsched.commands.members.belongings import Written, request_here
from zsched.commands.members.pki import held_here, hosts_of, new_secret, now_here, passphrase_of, read_request
from zsched.commands.members.unfinished import mark_of
from zsched.core.values.certificates import Role
from zsched.core.values.errors import AdapterError
from zsched.core.values.exits import EXIT_FAILED, EXIT_USAGE
from zsched.core.values.fleet import Fleet
from zsched.core.values.model import NodeId
from zsched.host import paths as places
from zsched.link.invitation import Papers
from zsched.link.sessions.own_addresses import addresses_at

if TYPE_CHECKING:
    from zsched.pki.authority import Authority, Issued  # imports cryptography

FIRST_KEY: Final = "ca-1.key"
"""Of a new authority."""
EVERYWHERE: Final = ("0.0.0.0", "::")  # noqa: S104 - compared with


class FirstPapers:
    """Makes the authority of a new fleet and its first certificate, once nothing else is in the way."""

    def __init__(self, fleet: str, node: NodeId, authority: Path | None, *, asks_passphrase: bool) -> None:
        """``authority``: its folder; ``None``: where `zsched pki` looks."""
        self._node, self._authority, self._asks = node, authority, asks_passphrase
        self._made: Authority | None = None
        self._is_locked = False
        self._fleet, self._folder = fleet, places.authority_folder(authority, os.environ, fleet)

    def check(self, creation: str = "") -> None:
        """Refuse to begin where there is an authority, but for one that this creation has left.

        Raises:
            CliError: there is one.
        """
        if not self._is_left_of(creation) and holds_authority(self._fleet, self._authority) is not None:
            advice = "if no fleet needs it any more, move it away; another folder: --authority DIR"
            raise CliError(EXIT_FAILED, f"{self._folder} holds an authority, and is left as it is; {advice}")

    def _is_left_of(self, creation: str, *, is_destroyed: bool = False) -> bool:
        """Whether the authority here was made by this creation, and nobody but its first node has got anything.

        ``is_destroyed``: it is deleted then.
        """
        with suppress(AdapterError, OSError), held_here(self._fleet, self._authority) as authority:
            if authority is None or not creation:
                return False
            record = authority.record
            is_left = record.creation == creation and all(one.holder.name == self._node for one in record.entries)
            if is_left and is_destroyed:
                authority.destroy()
            return is_left
        return False

    def certify(self, fleet: Fleet, creation: str) -> Papers:
        """The certificate and key of the first node; what an earlier try of this creation has left is deleted.

        Raises:
            CliError: there is an authority already.
            AdapterError: its folder cannot be written.
        """
        self._is_left_of(creation, is_destroyed=True)
        self.check()
        from zsched.pki.authority import create  # noqa: PLC0415 - imports cryptography

        secret = new_secret(is_wanted=self._asks)
        self._is_locked = bool(secret)
        self._made = create(self._folder, fleet.name, secret, now_here(), creation)
        hosts = hosts_of(fleet, self._node, Role.NODE)
        return _papers(self._made.issue(self._node, Role.NODE, hosts, b"", secret, now_here()))

    def destroy(self, config: Path) -> None:
        """The fleet was not founded: nobody has a certificate of its authority, so it goes, and then the mark."""
        if self._made is not None:
            with suppress(OSError):
                self._made.destroy()
                mark_of(config).unlink(missing_ok=True)

    @property
    def files(self) -> tuple[Written, ...]:
        """What is written of the authority."""
        what = "the key of the fleet's authority: who has it lets machines in"
        return (Written(path=self._folder / FIRST_KEY, what=what),)

    @property
    def advice(self) -> tuple[str, ...]:
        """How the key goes offline, and how certificates are renewed."""
        lock = "" if self._is_locked else ", not locked (--passphrase does that)"
        said = f"the authority's key lies on this machine{lock}; no daemon needs it"
        how = (
            f"move the folder {self._folder} to a stick, and name it to `zsched invite` and `zsched pki` by --authority"
        )
        return f"{said}. To take it offline, {how}", renew_advice(self._folder, self._fleet, is_locked=self._is_locked)


def key_to_papers(fleet: Fleet, authority: Path | None) -> bytes:
    """What opens the authority's key, asked for before anything is changed; empty: nothing is needed.

    Raises:
        CliError: nobody types it.
        AdapterError: it is wrong, or the authority cannot be used.
    """
    if fleet.security is None:
        return b""
    with held_here(fleet.name, authority) as held:
        secret = b"" if held is None else passphrase_of(held)
        if held is not None:
            held.check(secret)
        return secret


def keys_to_revoke(fleet: Fleet, node: NodeId, authority: Path | None, request: Path | None) -> tuple[str, ...]:
    """The labels of keys that a machine has had, with which it is not let in any more once it is invited again.

    An invitation may be lost, and a machine that has left keeps its key. Empty without certificates, and where the
    authority is not on this machine.

    Raises:
        AdapterError: a file cannot be used.
    """
    if fleet.security is None:
        return ()
    asked = read_request(request)
    with held_here(fleet.name, authority) as held:
        entries = () if held is None else held.record.entries
        own = [one for one in entries if (one.holder.name, one.holder.role) == (node, Role.NODE)]
        return tuple(one.label for one in own if held is None or not held.asks_for(one, asked))


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
    former = keys_to_revoke(fleet, node, authority, request)
    with held_here(fleet.name, authority) as held:
        if held is not None:
            for label in former:
                held.revoke(label, now_here())
            hosts = hosts_of(fleet, node, Role.NODE)
            return _papers(held.issue(node, Role.NODE, hosts, read_request(request), secret, now_here()))
    advice = f"where it is: zsched pki issue {node}; bring its files to the machine before it starts"
    warn(f"the invitation has no certificate: the fleet's authority is not on this machine; {advice}")
    return None


def _papers(issued: Issued) -> Papers:
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
