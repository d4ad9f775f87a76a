"""`zsched check`: shows what is wrong with a fleet file, or what it says.

Knows: how faults and settings are shown. Does not know: what a fault is (`zsched.config`).
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from zsched import paths as places
from zsched.commands.common import Json, counted, print_json, say, warn
from zsched.commands.options import ConfigOption, JsonOption
from zsched.commands.rules import told_once
from zsched.config.load import check_file
from zsched.core.values.fleet import fleet_hash
from zsched.exits import EXIT_CONFIG, EXIT_OK
from zsched.runtime.zenoh_file import judged


def check(
    file: Annotated[Path | None, typer.Argument(metavar="[FILE]", help="Fleet file; as --config.")] = None,
    config: ConfigOption = None,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Say in words when each task moves.")] = False,
    json_: JsonOption = False,
) -> int:
    """Check a fleet file: all faults that can be judged at once, each with file:line:col; exits with 78 on any.

    A file without fault is one line. With -v it says when each task moves, setting by setting, once for tasks alike.
    """
    result = judged(check_file(places.config_path(file or config, os.environ)))
    fleet = result.fleet
    counts: Json | None = None
    digest = None if fleet is None else fleet_hash(fleet)
    if fleet is not None:
        counts = {"nodes": len(fleet.nodes), "tasks": len(fleet.tasks), "electors": len(fleet.electors)}
    if json_:
        lists = {"faults": result.faults, "warnings": result.warnings}
        keys = ("line", "col", "message", "hint", "source_line")
        found = {name: [{key: getattr(fault, key) for key in keys} for fault in items] for name, items in lists.items()}
        named = None if fleet is None else {"name": fleet.name, **(counts or {})}
        body = {"schema": "zsched.check/1", "file": result.file, "ok": fleet is not None, "hash": digest}
        print_json({**body, "fleet": named, **found})
    elif report := result.report():
        warn(report)
    if counts is None:
        return EXIT_CONFIG
    if json_ or fleet is None:
        return EXIT_OK
    foreign = [task.name for task in fleet.tasks if not task.worker.command]
    yours = f"; you start the workers of {', '.join(foreign)} yourself (no `command`)" if foreign else ""
    said = ", ".join(counted(number, noun) for noun, number in counts.items())
    say(f"ok: {said}; hash {digest}{yours}")
    for first, *more in told_once(fleet.tasks, fleet.timing) if verbose else ():
        say(first)
        for line in more:
            say(f"  {line}", indent=4)
    return EXIT_OK


# --- on the command line ----------------------------------------------------------------------------------------------
