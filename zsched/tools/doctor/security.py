"""Checks of a fleet's certificates and of sessions that are open to others, as far as this machine can see them.

Knows: the files of the `security:` section and of the operator's zenoh file, this machine's addresses. Does not know:
what other machines have.
"""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final

from zsched.core.membership.refused import SHOWN_S
from zsched.core.values.certificates import Role, parse_common_name
from zsched.core.values.endpoint import Endpoint
from zsched.core.values.errors import ConfigError
from zsched.core.values.fleet import Security
from zsched.host.clock import wall_ns
from zsched.host.files import read_regular
from zsched.link.bus.sealing import seals_of
from zsched.link.sessions.certificate import common_names, validities
from zsched.link.sessions.config import tls_settings
from zsched.link.sessions.own_addresses import Address, addresses_at
from zsched.link.sessions.secured import CERTIFICATE, files_by, require_own
from zsched.link.sessions.tls import ENCRYPTED, protocol_of
from zsched.link.sessions.zenoh_file import operator_json5
from zsched.tools.doctor.model import Result, Scene, Verdict, failed, joined, passed, skipped, warned
from zsched.tools.doctor.state import is_hidden

SOON: Final = timedelta(days=30)
"""Of certificates that somebody else issues."""
OWN_SOON: Final = timedelta(days=7)
"""Of the fleet's own, which live for 30 days and are due after 20."""
MAX_BYTES: Final = 1 << 20
MEND: Final = "mend the file that the fleet file names under `zenoh: {config: ...}`"

REFUSED: Final = {
    "dropped_link_stranger": "links of a certificate that is not let in",
    "dropped_link_too_many": "links of a certificate with too many sessions",
    "dropped_link_shut_out": "links of a node that had shown too many tokens",
    "dropped_data_link_stranger": "links to the relay of a certificate that is not let in",
    "dropped_data_link_slow": "links to the relay of a guest or operator who reads too slowly",
    "dropped_data_link_shut_out": "links to the relay of one who had read too slowly",
    "dropped_data_link_too_many": "links to the relay of a certificate with too many sessions",
    "dropped_alive_too_many": "tokens of a node that shows too many",
}
UNPROVEN: Final = {
    "_link": "answers in another name than their link's certificate",
    "_signer": "frames that their signer may not say",
    "_signature": "frames with a wrong signature",
}
"""{end of a counter's name: what it counts}."""


# --- certificates ----------------------------------------------------------------------------------------------------


def certificates_last(scene: Scene, now: datetime | None = None) -> Result:
    """Whether the certificates of this machine are valid, also for some time to come, and its own."""
    now = now or datetime.fromtimestamp(wall_ns() / 1e9, UTC)
    security = scene.fleet.security
    try:
        files = _named_files(scene)
    except (ConfigError, ValueError) as error:
        return failed(str(error), fix=MEND)
    if not files:
        return skipped("the fleet has no certificates: no `security:` section, none in the operator's zenoh file")
    soon = SOON if security is None else OWN_SOON
    found = [
        _certificate(name, Path(path), now, soon, _renewal(scene, name, path)) for name, path in sorted(files.items())
    ]
    if security is not None:
        found += _own(scene, security)
        if (hidden := _hidden_one(scene, security, now)) is not None:
            rest = [one for one in found if one.fix and hidden not in one.evidence]
            later = f"a later one may be in {scene.state_folder}: run the doctor as root"
            return joined(rest, skipped(f"{hidden}; {later}"))
    return joined(found, passed())


def _hidden_one(scene: Scene, security: Security, now: datetime) -> str | None:
    """What is told of a certificate that ends, where this user may not see whether another took its place."""
    path = files_by(security, scene.state_folder).certificate
    if not is_hidden(scene.state_folder):
        return None
    result = _certificate("certificate", path, now, OWN_SOON, "")
    return result.evidence[0] if result.verdict in (Verdict.WARN, Verdict.FAIL) else None


def _named_files(scene: Scene) -> dict[str, str]:
    """{what it is: path} of every certificate and key of this machine."""
    security = scene.fleet.security
    if security is None:
        named = tls_settings(operator_json5(scene.fleet))
        return {name: path for name, path in named.items() if path and name.endswith(("certificate", "private_key"))}
    files = files_by(security, scene.state_folder)
    return {"certificate": str(files.certificate), "key": str(files.key), "authority": str(files.trusted)}


def _own(scene: Scene, security: Security) -> list[Result]:
    """A fault when the certificate is another holder's, or for a revoked key."""
    try:
        require_own(scene.fleet, security, scene.node)
    except ConfigError as error:
        return [failed(str(error), fix=f"zsched pki issue {scene.node}")]
    try:
        seals_of(scene.fleet)
    except ConfigError as error:
        return [failed(str(error), fix="mend what it names; `signatures: off` needs neither")]
    return []


def _renewal(scene: Scene, name: str, path: str) -> str:
    if scene.fleet.security is None or name != "certificate":
        return f"renew {path} ({name}), then restart the daemon"
    label = _label(scene, Path(path))
    return (
        f"`zsched pki renew {label}` where the fleet's authority is, and bring {label}/{CERTIFICATE} to "
        f"{scene.fleet.security.folder} here; the daemon looks every 30 s"
    )


def _label(scene: Scene, path: Path) -> str:
    """What `zsched pki` calls the key of this certificate; the node's name where that cannot be read."""
    with contextlib.suppress(OSError, ValueError):
        holder = parse_common_name(common_names(read_regular(path, MAX_BYTES))[0], scene.fleet.name)
        if holder is not None and (holder.name, holder.role) == (scene.node, Role.NODE):
            return holder.label
    return scene.node


def _certificate(name: str, path: Path, now: datetime, soon: timedelta, fix: str) -> Result:
    try:
        content = read_regular(path, MAX_BYTES)
        if "key" in name:
            return passed(f"{path} can be read")
        begins, ends = (
            pick(times) for pick, times in zip((max, min), zip(*validities(content), strict=True), strict=True)
        )
    except PermissionError:
        return skipped(f"{path} may not be read by user {os.geteuid()}: run the doctor as root")
    except (OSError, ValueError) as error:
        return failed(f"{path}: {getattr(error, 'strerror', None) or error}", fix=fix)
    told = f"{path} is valid from {begins:%Y-%m-%d} to {ends:%Y-%m-%d}"
    if not begins <= now <= ends:
        what = "has ended" if now > ends else "has not begun"
        clock = f"is this machine's clock right (timedatectl), by which it is {now:%Y-%m-%d}? If so, {fix}"
        return failed(f"{told}: it {what}", fix=clock)
    return warned(f"{told}: {(ends - now).days} days are left", fix=fix) if ends - now < soon else passed(told)


def keys_are_private(scene: Scene) -> Result:
    """Whether nobody but its owner reads this machine's key."""
    try:
        keys = sorted({path for name, path in _named_files(scene).items() if "key" in name})
    except (ConfigError, ValueError) as error:
        return failed(str(error), fix=MEND)
    if not keys:
        return skipped("this machine has no key")
    return joined((_key(Path(path)) for path in keys), passed())


def _key(path: Path) -> Result:
    try:
        found = path.stat()
    except OSError as error:
        return skipped(f"{path}: {error.strerror}")  # `tls.certificates` says more
    mode = stat.S_IMODE(found.st_mode)
    told = f"{path} belongs to user {found.st_uid}, mode {mode:04o}"
    if not mode & (stat.S_IRWXG | stat.S_IRWXO):
        return passed(told)
    fix = f"sudo chmod 600 {path}; the unit gets it by LoadCredential= (docs/guide/secure.md)"
    if mode & stat.S_IRWXO:
        return failed(f"{told}: every user of this machine reads the key", fix=f"{fix}; who read it has it: revoke it")
    return warned(f"{told}: its group reads the key", fix=fix)


# --- open sessions ---------------------------------------------------------------------------------------------------


def is_not_open_to_everybody(scene: Scene) -> Result:
    """Whether no session without certificates listens at a public address."""
    try:
        protocol = protocol_of(scene.fleet, operator_json5(scene.fleet))
    except ConfigError as error:
        return failed(str(error), fix=MEND)
    listens = (scene.me.listen_control, scene.me.listen_data)
    plain = [end for end in (given or f"{protocol}/0.0.0.0:0" for given in listens) if not end.startswith(ENCRYPTED)]
    if not plain:
        return passed("whoever connects needs a certificate")
    found = [(end, address) for end in plain for address in _addresses(scene, end)]
    named = [end for end in plain if end not in dict(found) and not Endpoint.of(end).is_own_host]
    public = [f"{end} at {address}" for end, address in found if address.is_global]
    fix = "secure the fleet (docs/guide/secure.md)"
    if public:
        told = f"anybody in the internet may read and change everything: {', '.join(public)}"
        return failed(told, fix=f"{fix}, or let it listen at a private address only")
    if named:
        told = f"without certificates, and at an address that only its name server knows: {', '.join(named)}"
        return warned(told, fix=f"{fix}, or give the address in `listen:`")
    if all(address.is_loopback for _, address in found):
        return passed("without certificates, and only for this machine")
    return warned("without certificates: whoever is in its private network may read and change everything", fix=fix)


def _addresses(scene: Scene, endpoint: str) -> Iterator[Address]:
    """The addresses of this machine at which an endpoint takes connections; none of a host name."""
    yield from addresses_at(scene.root, Endpoint.of(endpoint).host)


def nobody_is_refused(scene: Scene) -> Result:
    """Whether everybody who has linked or spoken in the last minute had the certificate and key for it.

    A new machine dials before the others let it in, so what was refused before says little.
    """
    counters, ages = scene.status["counters"], scene.status.get("dropped_ages", {})
    names = [name for name in REFUSED if counters.get(name)]
    ends = tuple(UNPROVEN)
    names += [name for name in sorted(counters) if name not in REFUSED and name.endswith(ends) and counters[name]]
    names = [name for name in names if name.startswith("dropped_")]
    found = [f"{_refused(name)}: {counters[name]} (`{name}`)" for name in names if ages.get(name, 0.0) < SHOWN_S]
    found += scene.status.get("refused", ())
    if found:
        return warned(
            *found, fix="the daemon's log names certificate and address; a node that is new or revoked dials, too"
        )
    if names:
        before = ", ".join(f"{counters[name]} `{name}`" for name in names)
        return passed(f"nobody was refused in the last minute (before, since it started: {before})")
    return passed("nobody was refused since it started")


def _refused(name: str) -> str:
    """What a counter counts."""
    return REFUSED.get(name) or next(told for end, told in UNPROVEN.items() if name.endswith(end))
