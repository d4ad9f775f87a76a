"""`zsched status --site` and `zsched history --site`: ask every fleet of the site, each at its own gateways.

Knows: which fleets there are, by the fleet file; exit codes. Does not know: sessions (`zsched.commands.ask`).
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final, TypeVar

from zsched import paths as places
from zsched.commands.ask import Door, ask_door, door_here, door_of, fleet_here
from zsched.commands.common import CliError, Json, print_json, say
from zsched.commands.history import SCHEMA as HISTORY
from zsched.commands.history import TOLD, Past, lines_of, print_lines
from zsched.commands.options import Asks
from zsched.commands.report import degradations
from zsched.core.values.fleet import Fleet
from zsched.errors import ConfigError
from zsched.exits import EXIT_DEGRADED, EXIT_OK, EXIT_UNREACHABLE, EXIT_USAGE

SCHEMA: Final = "zsched.site/1"
ALIVE: Final = "alive"
TITLES: Final = ("CELL", "NODES", "TASKS", "ASKED AT")
T = TypeVar("T")


def show_site(runtime_dir: Path | None, node: str | None, *, is_json: bool) -> int:
    """Print a row for each cell, this machine's first; returns the exit code.

    Raises:
        ConfigError: no document is agreed, and the fleet file cannot be used.
    """
    fleet, cells = _ask_all(runtime_dir, node, _told)
    if is_json:
        print_json({"schema": SCHEMA, "fleet": fleet.name, "cells": cells})
    else:
        _print(fleet, cells)
    return _code(cells)


def show_histories(runtime_dir: Path | None, node: str | None, past: Past, *, is_json: bool) -> int:
    """Print the moves of all cells by their age, the newest last, and who is silent; returns the exit code.

    Each cell's moves are told by one of its nodes, with ages by that node's clock: no two clocks are compared.

    Raises:
        ConfigError: no document is agreed, and the fleet file cannot be used.
    """
    fleet, cells = _ask_all(runtime_dir, node, lambda name, door: _past(name, door, past))
    silent = [cell for cell in cells if cell["error"] is not None]
    if is_json:
        merged = {key: _merged(cells, key) for key in TOLD}
        asked = [{key: cell[key] for key in ("name", "node", "error")} for cell in cells]
        first = next((cell["node"] for cell in cells if cell["error"] is None), "")
        print_json({"schema": HISTORY, "node": first, **merged, "cells": asked})
    else:
        width = max((len(cell["name"]) for cell in cells), default=0)
        lines = [line for cell in cells for line in lines_of(cell, f"{cell['name']:<{width}}  ")]
        print_lines(lines)
        heard = [cell["name"] for cell in cells if cell["error"] is None]
        if not lines and heard:
            say(f"no move and no order{past.words} in {', '.join(heard)}")
        said = [f"  {cell['name']}: {cell['error']}" for cell in silent]
        for line in (*(("PROBLEMS", *said) if said else ()), *_alone(fleet)):
            say(line, indent=4)
    return EXIT_UNREACHABLE if cells and len(silent) == len(cells) else EXIT_OK


def _ask_all(runtime_dir: Path | None, node: str | None, ask: Callable[[str, Door], T]) -> tuple[Fleet, list[T]]:
    """(this machine's fleet, what ``ask`` makes of each cell), this machine's first; all are asked at once.

    Raises:
        CliError: no daemon runs here, and no other cell is known.
    """
    here = door_here(runtime_dir, node)
    fleet = fleet_here(here, places.config_path(None, os.environ))
    doors = [] if here is None else [(fleet.name, here)]
    doors += [(cell.name, door_of(cell, fleet.name, here)) for cell in fleet.cells]
    if not doors:
        told = f"no daemon answers on this machine, and what it has of fleet {fleet.name} names no other under `site:`"
        raise CliError(EXIT_UNREACHABLE, f"{told}; start it with `zsched up`, or ask where a daemon runs")
    with ThreadPoolExecutor(max(len(doors), 1)) as errands:
        return fleet, list(errands.map(lambda one: ask(*one), doors))


def _past(name: str, door: Door, past: Past) -> Json:
    """What a cell's node has in its log; ``error`` where none tells."""
    body: Json = {"name": name, "node": None, **{key: [] for key in TOLD}, "error": None}
    try:
        return {**body, **past.read(door)}
    except (CliError, ConfigError) as error:
        return {**body, "error": str(error)}


def _merged(cells: list[Json], key: str) -> list[Json]:
    """What all cells tell, each with its cell, the newest last."""
    found = [{**one, "cell": cell["name"]} for cell in cells for one in cell[key]]
    return sorted(found, key=lambda one: -one["age_s"])


def _alone(fleet: Fleet) -> tuple[str, ...]:
    """Why no other cell is asked, where none is named."""
    return () if fleet.cells else (f"fleet {fleet.name} names no other under `site:` (docs/guide/scale.md)",)


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
    lines += _alone(fleet)
    sys.stdout.write("\n".join(lines) + "\n")


def _row(cell: Json) -> tuple[str, str, str, str]:
    tasks = ", ".join(f"{task['name']} on {task['owner'] or 'nobody'}" for task in cell["tasks"])
    return cell["name"], f"{cell['alive']} of {cell['nodes']}", tasks or "-", cell["node"]


def _code(cells: list[Json]) -> int:
    """As of `zsched status`: 0, 3 where no cell answers, 4 where one does not, or is degraded."""
    if cells and all(cell["error"] is not None for cell in cells):
        return EXIT_UNREACHABLE
    return EXIT_DEGRADED if any(cell["error"] is not None or cell["degraded"] for cell in cells) else EXIT_OK


def of_site(asked: Asks) -> tuple[Path | None, str | None]:
    """(folder of sockets, node) of the daemon here, which knows the cells. Raises `CliError`: another one is meant."""
    if asked.connect is not None or "/" in (asked.node or ""):
        raise CliError(EXIT_USAGE, "--site asks every cell; leave out --connect and CELL/NODE")
    return asked.runtime_dir, asked.node
