"""Decides what a secured fleet's sessions are opened with, and whether this machine's certificate is the right one.

Knows: the three files of the `security:` section, and what must stand in the certificate. Does not know: how they are
made (`zsched.pki`, which is never imported here), which keys a holder may use (`zsched.link.sessions.access_rules`).
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Final

from zsched.core.values.certificates import Holder, Role, accepted, parse_common_name
from zsched.core.values.errors import ConfigError
from zsched.core.values.fleet import Fleet, Security
from zsched.core.values.model import NodeId
from zsched.core.values.struct import Struct
from zsched.host import paths as places
from zsched.host.files import owner_of, read_regular
from zsched.link.sessions import config as zenoh_config
from zsched.link.sessions.access_rules import Side, access_control
from zsched.link.sessions.certificate import common_names, ders_of, own_key_id, parts_of, signing_key_id, validities

CERTIFICATE, KEY, TRUSTED = "certificate.pem", "key.pem", "ca.pem"
MAX_BYTES: Final = 1 << 20
BEGIN: Final = b"-----BEGIN "
"""Of all PEM."""
CREDENTIALS: Final = "CREDENTIALS_DIRECTORY"
"""Where systemd puts what `LoadCredential=` names: the key, which nobody but root reads where it lies."""


class Identity(Struct, frozen=True, kw_only=True):
    """What this machine's certificate says."""

    holder: Holder
    begins: datetime
    ends: datetime


class Files(Struct, frozen=True, kw_only=True):
    """Where this machine's three files are."""

    certificate: Path
    key: Path
    trusted: Path


def files_of(security: Security, env: Mapping[str, str] = os.environ) -> Files:
    """The files of a `security:` section; of each the one that systemd handed over, where there is one.

    A certificate for the same key that was renewed since, and lies in the state folder, takes the place of the first:
    one of a newer authority, or of the same one and with a later end.
    """
    handed = Path(env[CREDENTIALS]) if env.get(CREDENTIALS) else None

    def place(name: str) -> Path:
        if handed is not None and _is_handed(handed / name):
            return handed / name
        return Path(security.folder) / name

    first = place(CERTIFICATE)
    renewed = renewed_in(places.state_folder(None, env))
    trusted = place(TRUSTED)
    certificate = renewed if _is_newer(renewed, first, trusted) else first
    return Files(certificate=certificate, key=place(KEY), trusted=trusted)


def files_by(security: Security, state: Path) -> Files:
    """As `files_of`, of a machine whose state folder is that, whatever names it: an option may have."""
    return files_of(security, {**os.environ, "ZSCHED_STATE_DIR": str(state)})


def renewed_in(state: Path) -> Path:
    """Where a daemon keeps the certificate that was sent to it: what `zsched join` has written is not its to change."""
    return state / "pki" / CERTIFICATE


def authority_rank(der: bytes, trusted: bytes) -> int:
    """Where the authority of a certificate stands among those that are trusted, newest first; their count: nowhere.

    A certificate's end does not tell: the clock of the authority's machine may have been set back before it rotated.

    Args:
        der: the certificate; what it says of its authority is believed.
        trusted: the authorities' own certificates, PEM, in the order of `ca.pem`.

    Raises:
        ValueError: a certificate is malformed.
    """
    keys = [own_key_id(one) for one in ders_of(trusted)]
    signer = signing_key_id(der)
    return keys.index(signer) if signer and signer in keys else len(keys)


def _is_newer(renewed: Path, first: Path, trusted: Path) -> bool:
    """Whether a certificate is for the same name and key as another one, and of a newer authority or a later end."""
    try:
        ders = [ders_of(read_regular(path, MAX_BYTES))[0] for path in (renewed, first)]
        after, before = map(parts_of, ders)
        authorities = read_regular(trusted, MAX_BYTES)
        rank, rank_before = (authority_rank(der, authorities) for der in ders)
    except (OSError, ValueError):
        return False
    if (after.common_name, after.key) != (before.common_name, before.key):
        return False
    return after.ends > before.ends if rank == rank_before else rank < rank_before


def _is_handed(path: Path) -> bool:
    """Whether there is what it should be: the unit hands over one word where this machine has no key."""
    try:
        return BEGIN in read_regular(path, MAX_BYTES)
    except FileNotFoundError:
        return False
    except OSError:
        return True  # its reader says what is wrong with it


def secured_text(
    fleet: Fleet,
    security: Security,
    side: Side,
    operator_json5: str,
    env: Mapping[str, str] = os.environ,
    home: NodeId = "",
) -> str:
    """The zenoh configuration on which a session of a secured fleet is built; over the operator's own.

    ``env``: as in `files_of`; ``home``: as in `access_control`.

    Raises:
        ConfigError: a file is missing or cannot be read.
    """
    files = files_of(security, env)
    for path in (files.certificate, files.key, files.trusted):
        bytes_of(path)
    rules = access_control(fleet, security, side, home)
    return zenoh_config.secured(
        certificate=str(files.certificate),
        key=str(files.key),
        trusted=str(files.trusted),
        rules=rules,
        operator_json5=operator_json5,
        protocols=("tls", zenoh_config.WORKERS_BY) if home else ("tls",),
    )


def identity_of(fleet: Fleet, security: Security) -> Identity:
    """The holder that this machine's certificate names.

    Raises:
        ConfigError: it cannot be read, or is no certificate of this fleet.
    """
    path = files_of(security).certificate
    pem = bytes_of(path)
    try:
        (name, *_), ((begins, ends), *_) = common_names(pem), validities(pem)
    except ValueError as error:
        raise ConfigError(f"{path}: {error}; `zsched pki issue` makes one") from error
    holder = parse_common_name(name, fleet.name)
    if holder is None:
        raise ConfigError(
            f"{path} names {name!r}, which is no name in fleet {fleet.name}; `zsched pki issue` makes one"
        )
    return Identity(holder=holder, begins=begins, ends=ends)


def require_own(fleet: Fleet, security: Security, node: str) -> None:
    """Refuse to run as ``node`` with a certificate that the others would not take for it.

    Raises:
        ConfigError: it names somebody else, or a revoked key.
    """
    path, holder = files_of(security).certificate, identity_of(fleet, security).holder
    if (holder.name, holder.role) != (node, Role.NODE):
        raise ConfigError(
            f"{path} is {holder.label}'s, and this node is {node}: each node has a certificate of its own"
        )
    if holder not in accepted(node, Role.NODE, security.revoked):
        raise ConfigError(
            f"{path} is for the key {holder.label}, which `security: revoked` does not let in; "
            f"`zsched pki issue {node}` makes a new one"
        )


def digest_of(security: Security) -> str:
    """16 hex digits over this machine's certificate and what it trusts: a listener reads both only when it begins."""
    files = files_of(security)
    state = hashlib.blake2s(digest_size=8)
    for path in (files.certificate, files.trusted):
        state.update(bytes_of(path))
    return state.hexdigest()


def bytes_of(path: Path) -> bytes:
    """The content of one of the three files.

    Raises:
        ConfigError: it cannot be read.
    """
    try:
        return read_regular(path, MAX_BYTES)
    except PermissionError as error:
        hint = f"{owner_of(path)}; run as root, or hand it over by LoadCredential= (docs/guide/secure.md)"
        raise ConfigError(f"{path}: cannot be read: {error.strerror}; {hint}") from error
    except OSError as error:
        raise ConfigError(
            f"{path}: cannot be read: {error.strerror}; the fleet file has a `security:` section, so this machine "
            "needs its certificate: `zsched pki issue` makes it (docs/guide/secure.md)"
        ) from error
