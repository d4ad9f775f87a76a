"""Takes a newer certificate for this node's key, which the holder of the fleet's authority has sent.

Knows: what must stand in it, where it is kept. Does not know: its sender; the authority's signature counts, and
nothing else; how it comes (`zsched.link.bus.control_bus`), when sessions go by it (`zsched.daemon`).
"""

from __future__ import annotations

import logging
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final

from zsched.core.values.errors import ConfigError
from zsched.core.values.fleet import Fleet
from zsched.core.values.messages import CommandOutcome, CommandResult
from zsched.host.clock import wall_ns
from zsched.host.key_files import PUBLIC, make_folder, write_whole
from zsched.link.sessions.certificate import ders_of, parts_of, pem_of
from zsched.link.sessions.secured import CERTIFICATE, authority_rank, bytes_of, files_of, identity_of, renewed_in

SOON: Final = timedelta(days=7)
"""This long before its certificate ends a node says so: it is due since 3 days then, and nobody has renewed it."""

_log = logging.getLogger("zsched.daemon")


def now_utc() -> datetime:
    """The time on this machine's clock."""
    return datetime.fromtimestamp(wall_ns() / 1e9, UTC)


def take(fleet: Fleet, state: Path, pem: str) -> CommandResult:
    """Keep a newer certificate of this node; the answer to its sender.

    Args:
        fleet: by which the node goes.
        state: its state folder.
        pem: the certificate.
    """
    if fleet.security is None:
        return _refused("this node's fleet has no certificates")
    from zsched.link.signatures import Trust  # noqa: PLC0415 - it takes 8 MiB: only where there are certificates

    files = files_of(fleet.security)
    try:
        der = ders_of(pem.encode())[0]
        trusted, own_der = bytes_of(files.trusted), ders_of(bytes_of(files.certificate))[0]
        offered, own = Trust(trusted).certified(der, now_utc()), parts_of(own_der)
        rank, own_rank = authority_rank(der, trusted), authority_rank(own_der, trusted)
    except (ValueError, ConfigError) as error:
        return _refused(str(error))
    if offered is None:
        return _refused("it is of no authority that this node trusts, or not valid by its clock")
    if (offered.key, offered.common_name) != (own.key, own.common_name):
        return _refused(f"it is {offered.common_name}'s, or for another key; this node is {own.common_name}")
    until = f"until {offered.ends:%Y-%m-%d}"
    if rank > own_rank:
        return _refused(f"its authority stands behind that of this node's certificate in {files.trusted}")
    if rank == own_rank and offered.ends <= own.ends:  # of a newer authority it may end earlier
        lasts = f"its certificate lasts until {own.ends:%Y-%m-%d}"
        return CommandResult(outcome=CommandOutcome.UNCHANGED, detail=lasts)
    path = renewed_in(state)
    try:
        make_folder(path.parent)
        write_whole(path, pem_of(der), PUBLIC)  # what else the text holds, nobody has vouched for
    except OSError as error:
        return _refused(f"{path}: cannot be written: {error.strerror}")
    _log.info("certificate renewed until=%s", f"{offered.ends:%Y-%m-%d}")
    return CommandResult(outcome=CommandOutcome.OK, detail=f"its certificate is renewed {until}")


def problem(fleet: Fleet, now: datetime) -> str | None:
    """What is to be done about a certificate that ends soon, has ended or has not begun; ``None``: nothing.

    Raises:
        ConfigError: it cannot be read.
    """
    if fleet.security is None:
        return None
    own = identity_of(fleet, fleet.security)
    day = f"{own.ends:%Y-%m-%d %H:%M} UTC"
    if now < own.begins:
        return (
            f"this node's certificate begins on {own.begins:%Y-%m-%d %H:%M} UTC, so nobody lets it in: set this "
            f"machine's clock (`timedatectl`), it says {now:%Y-%m-%d %H:%M} UTC"
        )
    if now < own.ends - SOON:
        return None
    if now <= own.ends:
        return (
            f"this node's certificate ends on {day}, and its links with it: `zsched pki renew --deliver` where the "
            "fleet's authority is, or is this machine's clock wrong?"
        )
    label = own.holder.label  # of the key: a name may have had several
    return (
        f"this node's certificate has ended on {day}, and its links with it, so nothing can be sent here: "
        f"`zsched pki renew {label}` where the fleet's authority is, and bring {label}/{CERTIFICATE} to "
        f"{fleet.security.folder} here; or is this machine's clock wrong?"
    )


def _refused(why: str) -> CommandResult:
    return CommandResult(outcome=CommandOutcome.INVALID, detail=why)
