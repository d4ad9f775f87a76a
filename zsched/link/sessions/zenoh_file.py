"""Judges the operator's zenoh file against the fleet, before any session is opened with it.

`zsched check`, `apply` and every start ask here. Knows: which settings zsched makes itself, which keys a fleet needs.
Does not know: what zenoh makes of all else, other machines' copies of the file.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from zsched.config.load import CheckResult
from zsched.config.reader import Fault, render_all
from zsched.core.values.errors import ConfigError
from zsched.core.values.fleet import Fleet
from zsched.core.values.struct import replace
from zsched.host.files import read_regular
from zsched.link.sessions.access_rules import first_denied
from zsched.link.sessions.config import setting, tls_settings

MAX_BYTES: Final = 1 << 20
REFUSED: Final = {
    "id": "sessions of one id take each other's links",
    "namespace": "daemons, relays and workers would speak under other keys than the others listen to",
    "transport/unicast/lowlatency": "zenoh 1.10 panics where the links of such a session are watched",
}
"""{setting: why no fleet works with it}."""
OURS: Final = {
    "mode": "daemons, relays and workers are peers",
    "listen/endpoints": "nodes listen where `listen:` of the fleet file says",
    "connect/endpoints": "nodes dial each other by `host:` and `seeds:` of the fleet file",
    "scouting/multicast/enabled": "nodes find each other by `seeds:` of the fleet file",
    "transport/link/tx/lease": "`timing:` of the fleet file says it",
}
"""{setting that ours replaces: where it is said}."""
_PLACE: Final = re.compile(r"--> (\d+):(\d+)")


def operator_json5(fleet: Fleet) -> str:
    """The text of the operator's zenoh file; empty when the fleet file names none.

    Raises:
        ConfigError: it cannot be read, or no fleet can work with it.
    """
    text = _read(fleet.zenoh_config) if fleet.zenoh_config else ""
    if faults := faults_of(fleet, text):
        raise ConfigError(render_all(fleet.zenoh_config, faults))
    return text


def judged(result: CheckResult) -> CheckResult:
    """What became of a fleet file, with what is wrong in this machine's zenoh file, if it has one."""
    fleet = result.fleet
    if fleet is None or not fleet.zenoh_config or not Path(fleet.zenoh_config).is_file():
        return result  # `check_file` has said that it is not here
    text = _read(fleet.zenoh_config)
    is_sure, denied = (False, ()) if (faults := faults_of(fleet, text)) else denied_by(fleet, text)
    if faults or is_sure:
        return replace(result, fleet=None, faults=(*result.faults, *faults, *denied))
    said = {path: setting(text, path) for path in OURS}
    usual = {path: setting("{}", path) for path in OURS} | {"mode": "peer"}
    unused = [
        Fault(line=0, col=0, message=f"`{path}` is not used: {where}", file=fleet.zenoh_config)
        for path, where in OURS.items()
        if said[path] not in (None, False, [], usual[path])
    ]
    return replace(result, warnings=(*result.warnings, *denied, *unused))


def _read(file: str) -> str:
    try:
        return read_regular(Path(file), MAX_BYTES).decode("utf-8")
    except (OSError, ValueError) as error:
        reason = (error.strerror if isinstance(error, OSError) else None) or str(error)
        raise ConfigError(
            f"{file}: cannot be read: {reason}; the fleet file names it under `zenoh: {{config: ...}}`"
        ) from error


def faults_of(fleet: Fleet, text: str) -> tuple[Fault, ...]:
    """Why no session is opened with a zenoh file that says ``text``."""
    file = fleet.zenoh_config
    try:
        return tuple(Fault(line=0, col=0, message=what, hint=hint, file=file) for what, hint in _misfits(fleet, text))
    except ValueError as error:
        place = _PLACE.search(str(error))
        if place is None:
            return (Fault(line=0, col=0, message=str(error), file=file),)
        line, message = int(place[1]), f"zenoh cannot read this: {str(error).rpartition('= ')[2]}"
        there = "".join(text.splitlines()[line - 1 : line])
        return (Fault(line=line, col=int(place[2]), message=message, source_line=there, file=file),)


def _misfits(fleet: Fleet, text: str) -> Iterator[tuple[str, str]]:
    """(what is wrong, what to do)."""
    for path, why in REFUSED.items():
        if setting(text, path):
            yield f"`{path}`: {why}", "delete it"
    rules = setting(text, "access_control") or {}
    if fleet.security is not None and (rules.get("enabled") or tls_settings(text)):
        message = "it sets TLS or access control, and the fleet file has a `security:` section, which makes both"
        yield message, "keep one of them"


def denied_by(fleet: Fleet, text: str) -> tuple[bool, tuple[Fault, ...]]:
    """(whether for sure, what the ``access_control`` of a zenoh file without faults denies this fleet)."""
    rules = setting(text, "access_control") or {}
    found = first_denied(fleet, rules) if rules.get("enabled") else None
    if found is None:
        return False, ()
    is_sure, message, flow, key = found
    verb = "denies" if is_sure else "may deny"
    what = f"`access_control` {verb} {message} ({flow}) of {key!r}, which this fleet needs"
    hint = f"allow it, for example by the key expression {key!r} (`**` holds no chunk that begins with @)"
    return is_sure, (Fault(line=0, col=0, message=what, hint=hint, file=fleet.zenoh_config),)
