"""The command line of both ends: ``python -m zsched.tasks.crossing give|take``.

Knows: words, addresses, the other cell's fleet file. Does not know: what crosses.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from zsched.config.load import load_fleet
from zsched.core.values.fleet import dial_endpoint
from zsched.core.values.words import A_NAME, NAME
from zsched.errors import ConfigError
from zsched.exits import EXIT_CONFIG, EXIT_OK, EXIT_UNREACHABLE
from zsched.runtime.access_rules import Side
from zsched.runtime.tls import ENCRYPTED, session_text
from zsched.sessions.config import client_config
from zsched.tasks.crossing.gateway import Gateway
from zsched.tasks.crossing.give import Giver
from zsched.tasks.crossing.take import Taker
from zsched.tasks.crossing.ways import Ways
from zsched.worker import Worker

PATIENCE_S: Final = 10.0
CONNECT_S: Final = 1.0
GUIDE: Final = "docs/guide/scale.md"


def main(arguments: list[str] | None = None) -> int:
    """Run one end until it is told to stop; the exit code."""
    options = _options(arguments)
    own = os.environ.get("ZSCHED_FLEET", "")
    try:
        return _take(options, own) if options.end == "take" else _give(options, own)
    except ConfigError as error:
        print(f"crossing: {error}", file=sys.stderr)
        return EXIT_CONFIG


def _take(options: argparse.Namespace, own: str) -> int:
    for cell in options.cells:
        check_cell(cell, own)
    with Worker.from_env(drains_itself=True) as worker:
        Taker(worker, is_latest=options.latest).run(options.cells)
    return EXIT_OK


def _give(options: argparse.Namespace, own: str) -> int:
    check_cell(options.cell, own)
    if not options.patience > 0:
        raise ConfigError(f"--patience: {options.patience:g} is no time; write seconds above 0")
    text = settings_for(options.cell, options.gateways, options.file)
    gateways = [
        Gateway(end, own, client_config(connect=(end,), operator_json5=text, connect_s=CONNECT_S))
        for end in options.gateways
    ]
    try:
        with Worker.from_env() as worker:
            why = Giver(worker, options.cell, Ways(gateways), options.patience).run()
    finally:
        for gateway in gateways:
            gateway.end()
    if why:
        print(f"crossing: {why}", file=sys.stderr)
    return EXIT_UNREACHABLE if why else EXIT_OK


def check_cell(cell: str, own: str) -> None:
    """Refuse what is no other cell.

    Raises:
        ConfigError: it is no name, or this fleet's own.
    """
    if not NAME.fullmatch(cell):
        raise ConfigError(f"{cell!r} is no cell's name ({A_NAME}); name the fleet at the other end ({GUIDE})")
    if cell == own:
        raise ConfigError(f"{cell!r} is this fleet itself; name the fleet at the other end ({GUIDE})")


def settings_for(cell: str, gateways: Sequence[str], file: Path | None) -> str:
    """The zenoh settings on which sessions to another cell are built: secured, as its fleet file says.

    The key and the certificate are those beside that file: what systemd hands to this process is of its own cell.

    Raises:
        ConfigError: an address cannot be dialled, or the fleet file or its certificate cannot be used.
    """
    for endpoint in gateways:
        if "/" not in endpoint or ":" not in endpoint or not dial_endpoint(endpoint, ""):
            raise ConfigError(
                f"{cell}: {endpoint!r} cannot be dialled; write where the relay of a node of {cell} listens for data, "
                f"for example tcp/192.0.2.31:7458 ({GUIDE})"
            )
    is_secured = any(endpoint.partition("/")[0] in ENCRYPTED for endpoint in gateways)
    if file is None:
        if is_secured:
            raise ConfigError(
                f"{cell} is a secured fleet, and nothing says with which certificate it is joined; add --file: a copy "
                f"of its fleet file, whose `security: {{folder:}}` holds a guest's certificate of it ({GUIDE})"
            )
        return ""
    if not file.exists():
        raise ConfigError(f"{file}: there is no such file; put a copy of {cell}'s fleet file there ({GUIDE})")
    fleet = load_fleet(file)
    if fleet.name != cell:
        raise ConfigError(
            f"{file} is the file of fleet {fleet.name}, and not of {cell}; put a copy of {cell}'s there ({GUIDE})"
        )
    return session_text(fleet, Side.VISIT, {})


def _options(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m zsched.tasks.crossing", description="streams that cross cells")
    ends = parser.add_subparsers(dest="end", required=True)
    give = ends.add_parser("give", help="give this cell's streams to another one")
    give.add_argument("cell", help="the other cell")
    give.add_argument("gateways", nargs="+", help="where relays of its nodes listen: tcp/192.0.2.31:7458")
    give.add_argument("--file", type=Path, help="the other cell's fleet file; it must be there for a secured one")
    give.add_argument("--patience", type=float, default=PATIENCE_S, help="seconds for which a sample is offered")
    take = ends.add_parser("take", help="take other cells' streams")
    take.add_argument("cells", nargs="+", help="the cells that may give")
    take.add_argument("--latest", action="store_true", help="outputs of class latest (default: reliable)")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
