"""`zsched rehearse` on the command line: arguments in, exit code out.

Knows: options. Does not know: how anything is done (`zsched.commands.rehearse`, imported when the verb runs).
"""

from __future__ import annotations

import os
from typing import Annotated

import typer

from zsched.commands.common import CliError
from zsched.commands.options import Orders
from zsched.exits import EXIT_USAGE


def rehearse(
    said: Orders,
    task: Annotated[str | None, typer.Argument(metavar="[TASK]", help="A task of the fleet file.")] = None,
    steps: Annotated[
        str, typer.Option(metavar="STEPS", help="What is done, in this order: move, drain, worker, daemon, link.")
    ] = "move,drain,worker,daemon,link",
    rounds: Annotated[int, typer.Option(min=1, max=100, metavar="N", help="How often all of it.")] = 1,
    pause: Annotated[float, typer.Option(metavar="S", help="Seconds of calm before each step; at least 11.")] = 12.0,
    limit: Annotated[
        float, typer.Option(min=5.0, max=3600.0, metavar="S", help="Seconds that recovering may take.")
    ] = 60.0,
    cut: Annotated[
        float | None, typer.Option(metavar="S", help="Seconds of a cut. [until the task has moved, and 2 more]")
    ] = None,
    kept: Annotated[bool, typer.Option("--list", help="List the rehearsals that the node has kept.")] = False,
    show: Annotated[str | None, typer.Option(metavar="ID", help="Show one of them.")] = None,
) -> None:
    """Play faults on the running fleet, one at a time, and tell what it makes of them beside what is promised.

    It asks first, needs a second fit candidate, waits for calm before each step, and stops at the first broken promise.
    Exits with 1 when one was broken, with 5 when it could not go on.
    """
    from zsched import paths as places  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands import rehearse as verb  # noqa: PLC0415 - as above

    if kept or show is not None:
        if task is not None:
            raise CliError(EXIT_USAGE, "--list and --show go without a task")
        raise typer.Exit(verb.show_kept(said.door(), show, is_json=said.json_))
    if task is None:
        raise CliError(EXIT_USAGE, "name a task, or --list: `zsched rehearse TASK`")
    order = verb.RehearseOrder(
        task=task, steps=verb.parse_steps(steps), rounds=rounds, pause_s=pause, limit_s=limit, cut_s=cut
    )
    raise typer.Exit(verb.rehearse(said.order(), order, places.asked_folder(said.runtime_dir, os.environ)))
