"""`zsched status --site` and `zsched history --site`: ask every fleet of the site, each at its own gateways.

Knows: which fleets there are, by the fleet file; exit codes. Does not know: sessions (`zsched.commands.base.ask`).
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Final

from zsched.commands.base.ask import Door, ask_door, door_here, door_of, fleet_here
from zsched.commands.base.common import CliError, Json, print_json
from zsched.commands.base.options import Answers, Asks
from zsched.commands.base.page import lined
from zsched.commands.base.report import degradations
from zsched.core.values.errors import ConfigError
from zsched.core.values.exits import EXIT_DEGRADED, EXIT_OK, EXIT_UNREACHABLE, EXIT_USAGE
from zsched.core.values.fleet import Fleet
from zsched.host import paths as places

SCHEMA: Final = "zsched.site/1"
ALIVE: Final = "alive"
TITLES: Final = ("CELL", "NODES", "TASKS", "ASKED AT")
BLANK: Final[Json] = {"node": None, "alive": None, "nodes": None, "tasks": [], "degraded": []}


def show_site(asked: Answers) -> int:
    """Print a row for each cell, this machine's first; returns the exit code.

    Raises:
        ConfigError: no document is agreed, and the fleet file cannot be used.
    """
    fleet, cells = ask_site(asked, _told, BLANK)
    if asked.json_:
        print_json({"schema": SCHEMA, "fleet": fleet.name, "cells": cells})
    else:
        _print(fleet, cells)
    return _code(cells)


def ask_site(asked: Asks, ask: Callable[[Door], Json], blank: Json) -> tuple[Fleet, list[Json]]:
    """(this machine's fleet, what ``ask`` makes of each cell), this machine's first; all are asked at once.

    ``error`` of a cell says why it tells nothing; then the rest is as in ``blank``.

    Raises:
        CliError: another machine is meant (2), or no daemon runs here, and no other cell is known.
    """
    if asked.connect is not None or "/" in (asked.node or ""):
        raise CliError(EXIT_USAGE, "--site asks every cell; leave out --connect and CELL/NODE")
    here = door_here(asked.runtime_dir, asked.node)
    fleet = fleet_here(here, places.config_path(None, os.environ))
    doors = [] if here is None else [(fleet.name, here)]
    doors += [(cell.name, door_of(cell, fleet.name, here)) for cell in fleet.cells]
    if not doors:
        told = f"no daemon answers on this machine, and what it has of fleet {fleet.name} names no other under `site:`"
        raise CliError(EXIT_UNREACHABLE, f"{told}; start it with `zsched up`, or ask where a daemon runs")

    def told_by(one: tuple[str, Door]) -> Json:
        body = {"name": one[0], **blank, "error": None}
        try:
            return {**body, **ask(one[1])}
        except (CliError, ConfigError) as error:
            return {**body, "error": str(error)}

    with ThreadPoolExecutor(len(doors)) as errands:
        return fleet, list(errands.map(told_by, doors))


def alone(fleet: Fleet) -> tuple[str, ...]:
    """Why no other cell is asked, where none is named."""
    return () if fleet.cells else (f"fleet {fleet.name} names no other under `site:` (docs/guide/scale.md)",)


def _told(door: Door) -> Json:
    """What a cell says of itself."""
    status = ask_door(door, {"verb": "status"})
    nodes: list[Any] = status["nodes"]
    return {
        "node": status["node"],
        "alive": sum(node["state"] == ALIVE for node in nodes),
        "nodes": len(nodes),
        "tasks": [{"name": task["name"], "owner": task["owner"]} for task in status["tasks"]],
        "degraded": list(degradations(status)),
    }


def _print(fleet: Fleet, cells: list[Json]) -> None:
    rows = [_row(cell) for cell in cells if cell["error"] is None]
    lines = lined(TITLES, rows) or [" ".join(TITLES)]
    if len(cells) > len(rows) or any(cell["degraded"] for cell in cells):
        lines.append("PROBLEMS")
    for cell in cells:
        told = cell["degraded"] if cell["error"] is None else [cell["error"]]
        lines += [f"  {cell['name']}: {text}" for text in told]
    lines += alone(fleet)
    sys.stdout.write("\n".join(lines) + "\n")


def _row(cell: Json) -> tuple[str, str, str, str]:
    tasks = ", ".join(f"{task['name']} on {task['owner'] or 'nobody'}" for task in cell["tasks"])
    return cell["name"], f"{cell['alive']} of {cell['nodes']}", tasks or "-", cell["node"]


def _code(cells: list[Json]) -> int:
    """As of `zsched status`: 0, 3 where no cell answers, 4 where one does not, or is degraded."""
    if cells and all(cell["error"] is not None for cell in cells):
        return EXIT_UNREACHABLE
    return EXIT_DEGRADED if any(cell["error"] is not None or cell["degraded"] for cell in cells) else EXIT_OK
