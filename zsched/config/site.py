"""Decides what the `site:` section of a fleet file says: the other fleets of the site, and at which addresses.

Knows: which addresses can be dialled. Does not know: what is asked there (`zsched.commands.look.cells`), certificates.
"""

from __future__ import annotations

from pathlib import Path

from zsched.config.blocks import Located, Section
from zsched.config.nodes import warn_missing
from zsched.config.reader import Collector
from zsched.config.security import TLS
from zsched.core.values.endpoint import Endpoint
from zsched.core.values.fleet import Cell


def read_site(section: Section, folder: Path, out: Collector) -> tuple[Cell, ...]:
    """The other cells, sorted by name, with what is wrong with them reported."""
    given: dict[str, Located[Section | None]] = section.get("site", {})
    cells, seen = [], dict[str, str]()
    for name, one in given.items():
        if name == section.get("fleet"):
            out.error(one.place, f"{name!r} is this fleet itself", "name the other fleets of the site")
        if one.value is None:
            continue
        gateways: tuple[Located[str], ...] = one.value.get("gateways", ())
        for gateway in gateways:
            _check_gateway(name, gateway, seen, out)
        if len(gateways) == 1:
            message = f"{name!r} has one gateway: while that machine is away the cell cannot be asked"
            out.warn(gateways[0].place, message, "name two nodes of it")
        file = one.value.get("file", "")
        if file:
            warn_missing(folder / file, one.value.where("file"), out)
        elif any(Endpoint.of(gateway.value).protocol == TLS for gateway in gateways):
            message = f"{name!r} is a secured fleet, and nothing says with which certificate it is asked"
            hint = "file: its fleet file, whose `security: {folder:}` holds a certificate of its authority"
            out.error(gateways[0].place, message, hint)
        endpoints = tuple(gateway.value for gateway in gateways)
        cells.append(Cell(name=name, gateways=endpoints, file=str(folder / file) if file else ""))
    return tuple(sorted(cells, key=lambda cell: cell.name))


def _check_gateway(cell: str, gateway: Located[str], seen: dict[str, str], out: Collector) -> None:
    endpoint = gateway.value
    if not Endpoint.of(endpoint).dialled(""):
        out.error(gateway.place, f"{endpoint} cannot be dialled", 'name an address, for example "tcp/192.0.2.31:7457"')
    elif endpoint in seen:
        out.error(gateway.place, f"{endpoint} is a gateway of {seen[endpoint]!r} already", "name another node of it")
    seen[endpoint] = cell
