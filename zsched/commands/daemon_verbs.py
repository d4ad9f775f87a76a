"""The verbs of this machine's own node: `up`, `init`, `new`, `dev`: arguments in, exit code out.

Knows: options. Does not know: how anything is done (files of the verbs' names, imported by the verb that runs).
"""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from zsched.commands.example import Example, give_example
from zsched.commands.options import Here, Machine


class LogLevel(StrEnum):
    """How much the daemon says on stderr."""

    DEBUG = "DEBUG"
    INFO = "INFO"
    WARNING = "WARNING"
    ERROR = "ERROR"


def up(
    here: Machine,
    log_level: Annotated[LogLevel, typer.Option("--log-level", help="What goes to stderr.")] = LogLevel.INFO,
) -> None:
    """Run this machine's daemon in the foreground (what systemd runs)."""
    from zsched.commands.up import become_daemon  # noqa: PLC0415 - each verb imports what it needs

    become_daemon(here.config, here.node, here.state_dir, here.runtime_dir, log_level.value)


def init(
    here: Here,
    accept: Annotated[
        list[str] | None,
        typer.Option("--accept", metavar="DANGER", help="lost-state: its state is lost, and no other node is left."),
    ] = None,
) -> None:
    """Create this node's blank state: "this name has never voted here".

    Refuses in another node's folder, and when a node that can be reached knows this name as an elector that has voted.
    A machine that has lost its state gets the fleet's document first: what `zsched fleet export` writes on a living
    node, as its fleet file. Where too many states are lost to agree, `zsched fleet recover --generation` begins anew.
    """
    from zsched.commands.init import create_state, place_of  # noqa: PLC0415 - each verb imports what it needs

    create_state(place_of(here), accepted=accept or ())


def new(
    kind: Annotated[Example, typer.Argument(metavar="KIND", help="python, ros2 or zenoh: which way its worker goes.")],
    folder: Annotated[Path, typer.Argument(metavar="[DIR]", help="Where. [the current folder]")] = Path(),
) -> None:
    """Write a small task to begin with: a fleet file, a worker, an application (see `zsched dev`).

    Nothing is overwritten.
    """
    give_example(kind, folder)


def dev(
    file: Annotated[
        Path | None, typer.Argument(metavar="FILE", help="Fleet file, or its folder; else ./fleet.yaml.")
    ] = None,
    task: Annotated[
        list[str] | None,
        typer.Option("--task", metavar="[TASK=]FILE", help="This worker in place of the fleet file's."),
    ] = None,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="All that the daemons log.")] = False,
) -> None:
    """Run every node of a fleet file on this machine, to try a task of your own; nothing of it stays.

    It prints where applications join, and starts a worker again when its file is saved. On a terminal keys move the
    task, kill its owner and load it.
    """
    from zsched.commands.dev import DevOptions  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.dev import dev as run  # noqa: PLC0415 - as above

    raise typer.Exit(run(DevOptions(file=file, workers=task or (), is_verbose=verbose)))
