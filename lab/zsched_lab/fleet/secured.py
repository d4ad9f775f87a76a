"""A fleet of a test or benchmark with certificates, and sessions of members that go by no rules.

Knows: the authority, the folders of certificates, access rules. Does not know: what is attacked, what is measured.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

from zsched.core.values.certificates import Role
from zsched.host.key_files import PRIVATE, PUBLIC, make_folder, write_whole
from zsched.link.sessions.access_rules import Side
from zsched.link.sessions.config import control_config, data_config
from zsched.link.sessions.secured import CERTIFICATE, KEY, TRUSTED
from zsched.link.sessions.tls import session_text
from zsched.pki.authority import Authority, create
from zsched_lab.fleet.testbed import Json, Testbed


def make_authority(folder: Path, fleet: str) -> Authority:
    """A new authority, valid now."""
    return create(folder, fleet, b"", datetime.now(UTC))


def install(
    authority: Authority, folder: Path, name: str, role: Role = Role.NODE, *, ago: timedelta | None = None
) -> None:
    """Issue a certificate (``ago``: as it was issued then) and put the three files into ``folder``."""
    issued = authority.issue(name, role, [], b"", b"", datetime.now(UTC) - (ago or timedelta()))
    make_folder(folder)
    write_whole(folder / CERTIFICATE, issued.certificate, PUBLIC)
    write_whole(folder / KEY, issued.key, PRIVATE)
    write_whole(folder / TRUSTED, issued.trusted, PUBLIC)


def secured(tree: Json, folder: Path, *, security: Json | None = None, strangers: Iterable[str] = ()) -> Json:
    """The fleet file ``tree`` with certificates for its nodes in ``folder/pki``, by an authority in ``folder``.

    ``strangers`` are certified as nodes, too, and stand in no file.
    """
    for node in tree["nodes"].values():
        node["listen"] = {kind: end.replace("tcp/", "tls/") for kind, end in node["listen"].items()}
    tree["security"] = security or {}
    authority = make_authority(folder / "authority", tree["fleet"])
    for name in (*tree["nodes"], *strangers):
        install(authority, folder / "pki" / name, name)
    return tree


def without_rules(
    bed: Testbed, holder: str, side: Side, *, to: Iterable[str] | None = None, listen: tuple[str, ...] = ()
) -> str:
    """The session of a holder of a certificate that goes by no rules of its own: to some daemons or relays (all)."""
    assert bed.fleet.security is not None
    security = replace(bed.fleet.security, folder=str(bed.folder / "pki" / holder))
    rules = session_text(replace(bed.fleet, security=security), side)
    nodes = [bed.fleet.node(node) for node in (bed.running() if to is None else to)]
    if side is Side.CONTROL:
        ends = tuple(node.listen_control for node in nodes)
        text = control_config(listen=listen, connect=ends, operator_json5=rules)
    else:
        ends = tuple(node.listen_data for node in nodes)
        text = data_config(listen=listen, connect=ends, shared_memory=False, operator_json5=rules)
    config = json.loads(text)
    for rule in ("access_control", "downsampling"):
        config.pop(rule, None)
    return json.dumps(config)
