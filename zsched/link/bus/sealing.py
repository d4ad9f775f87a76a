"""Makes the seals of a session from this machine's certificate, where the fleet file asks for signatures.

Knows: the three files, which names are let in. Does not know: what is sealed (`zsched.link.bus.seals`).

This is the one place by which a daemon, or a tool, loads the package ``cryptography``: where nothing is signed it is
not needed.
"""

from __future__ import annotations

from zsched.core.values.certificates import Holder, Role, accepted
from zsched.core.values.errors import ConfigError
from zsched.core.values.fleet import Fleet, Security, Signatures
from zsched.link.bus.seals import Keys, Seals
from zsched.link.sessions.secured import bytes_of, files_of


def seals_of(fleet: Fleet, life: int = 0) -> Seals | None:
    """The seals of a session of this machine; ``None``: nothing is signed.

    Args:
        fleet: the fleet file.
        life: this node's incarnation; 0: it is no node.

    Raises:
        ConfigError: a file cannot be used.
    """
    security = fleet.security
    if security is None or security.signatures is Signatures.OFF:
        return None
    return Seals(
        fleet=fleet.name,
        keys=_keys(security),
        holders=holders_of(fleet, security),
        life=life,
        takes_unsigned=security.signatures is Signatures.OFFERED,
    )


def holders_of(fleet: Fleet, security: Security) -> frozenset[Holder]:
    """The keys whose signatures count: those of the nodes and operators that are not revoked."""
    names = [(node.name, Role.NODE) for node in fleet.nodes] + [(name, Role.OPERATOR) for name in security.operators]
    return frozenset(one for name, role in names for one in accepted(name, role, security.revoked))


def orderers_of(fleet: Fleet, security: Security) -> frozenset[Holder]:
    """Those of them whose orders are taken: operators, and the nodes that the file names, or all."""
    holders, named = holders_of(fleet, security), security.orders
    return frozenset(one for one in holders if named is None or one.role is Role.OPERATOR or one.name in named)


def _keys(security: Security) -> Keys:
    from zsched.link import signatures  # noqa: PLC0415 - it takes 8 MiB: only where something is signed

    files = files_of(security)
    try:
        return Keys(
            sign=signatures.signing_with(bytes_of(files.key)),
            certificate=signatures.own_certificate(bytes_of(files.certificate)),
            certified=signatures.Trust(bytes_of(files.trusted)).certified,
            checking_by=signatures.checking_by,
        )
    except ValueError as error:
        raise ConfigError(f"{files.certificate.parent}: {error}; `zsched pki issue` makes one") from error
