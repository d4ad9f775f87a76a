"""`zsched site`: asks every fleet of the site how it is, each at its own gateways.

Knows: which fleets there are, by the fleet file; exit codes. Does not know: sessions (`zsched.commands.ask`).
"""

from __future__ import annotations

import os
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final

from zsched import paths as places
from zsched.commands.ask import Door, ask_door, door_here, door_of, fleet_here
from zsched.commands.common import CliError, Json, print_json
from zsched.commands.report import degradations
from zsched.core.values.fleet import Fleet
from zsched.errors import ConfigError
from zsched.exits import EXIT_DEGRADED, EXIT_OK, EXIT_UNREACHABLE
from zsched.screen import harmless

SCHEMA: Final = "zsched.site/1"
ALIVE: Final = "alive"
TITLES: Final = ("CELL", "NODES", "TASKS", "ASKED AT")


def show_site(runtime_dir: Path | None, node: str | None, *, is_json: bool) -> int:
    """Print a row for each cell, this machine's first; returns the exit code.

    Raises:
        ConfigError: no document is agreed, and the fleet file cannot be used.
    """
    here = door_here(runtime_dir, node)
    fleet = fleet_here(here, places.config_path(None, os.environ))
    doors = [] if here is None else [(fleet.name, here)]
    doors += [(cell.name, door_of(cell, fleet.name, here)) for cell in fleet.cells]
    with ThreadPoolExecutor(max(len(doors), 1)) as errands:
        cells = list(errands.map(lambda one: _told(*one), doors))
    if is_json:
        print_json({"schema": SCHEMA, "fleet": fleet.name, "cells": cells})
    else:
        _print(fleet, cells)
    return _code(cells)


def _told(name: str, door: Door) -> Json:
    """What a cell says of itself; ``error`` where nobody says anything."""
    body: Json = {"name": name, "node": None, "alive": None, "nodes": None, "tasks": [], "degraded": [], "error": None}
    try:
        status = ask_door(door, {"verb": "status"})
    except (CliError, ConfigError) as error:
        return {**body, "error": str(error)}
    nodes: list[Any] = status["nodes"]
    return {
        **body,
        "node": status["node"],
        "alive": sum(node["state"] == ALIVE for node in nodes),
        "nodes": len(nodes),
        "tasks": [{"name": task["name"], "owner": task["owner"]} for task in status["tasks"]],
        "degraded": list(degradations(status)),
    }


def _print(fleet: Fleet, cells: list[Json]) -> None:
    rows = [TITLES, *(_row(cell) for cell in cells if cell["error"] is None)]
    widths = [max(len(row[at]) for row in rows) for at in range(len(TITLES))]
    lines = ["  ".join(word.ljust(width) for word, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    if len(cells) > len(rows) - 1 or any(cell["degraded"] for cell in cells):
        lines.append("PROBLEMS")
    for cell in cells:
        told = cell["degraded"] if cell["error"] is None else [cell["error"]]
        lines += [f"  {cell['name']}: {text}" for text in told]
    if not fleet.cells:
        lines.append(f"fleet {fleet.name} names no other under `site:` (docs/guide/scale.md)")
    sys.stdout.write("\n".join(harmless(line) for line in lines) + "\n")


def _row(cell: Json) -> tuple[str, str, str, str]:
    tasks = ", ".join(f"{task['name']} on {task['owner'] or 'nobody'}" for task in cell["tasks"])
    return cell["name"], f"{cell['alive']} of {cell['nodes']}", tasks or "-", cell["node"]


def _code(cells: list[Json]) -> int:
    """As of `zsched status`: 0, 3 where no cell answers, 4 where one does not, or is degraded."""
    if cells and all(cell["error"] is not None for cell in cells):
        return EXIT_UNREACHABLE
    return EXIT_DEGRADED if any(cell["error"] is not None or cell["degraded"] for cell in cells) else EXIT_OK
