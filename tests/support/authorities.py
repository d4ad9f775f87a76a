"""An authority for one test, and folders as machines of a secured fleet have them."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from zsched.core.values.certificates import Role
from zsched.pki.authority import Authority, create
from zsched.pki.files import PRIVATE, PUBLIC, make_folder, write_whole
from zsched.runtime.secured import CERTIFICATE, KEY, TRUSTED


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


def secured(tree: Any, folder: Path, *, operators: tuple[str, ...] = ()) -> Any:
    """The fleet file ``tree`` with certificates for its nodes, in ``folder``; those of operators lie beside them."""
    for node in tree["nodes"].values():
        node["listen"] = {kind: end.replace("tcp/", "tls/") for kind, end in node["listen"].items()}
    tree["security"] = {"operators": list(operators)} if operators else {}
    authority = make_authority(folder / "authority", tree["fleet"])
    for name, role in (*((node, Role.NODE) for node in tree["nodes"]), *((one, Role.OPERATOR) for one in operators)):
        install(authority, folder / "pki" / name, name, role)
    return tree
