"""The verbs of this machine's own node: `up`, `init`, `recover`, `rejoin`, `dev`: arguments in, exit code out.

Knows: options. Does not know: how anything is done (files of the verbs' names, imported by the verb that runs).
"""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from zsched.commands.common import CliError
from zsched.commands.example import Example, give_example
from zsched.commands.options import AcceptOption, Here, Machine, PlanOption, YesOption
from zsched.exits import EXIT_USAGE


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
    folder: Annotated[
        Path | None, typer.Argument(metavar="DIR", help="With --example: where; without it the current folder.")
    ] = None,
    example: Annotated[
        Example | None, typer.Option("--example", help="Write an example into DIR instead; nothing is overwritten.")
    ] = None,
    generation: Annotated[
        int,
        typer.Option("--generation", metavar="G", min=0, help="Above 0: start anew, on every node."),
    ] = 0,
    force: Annotated[
        bool, typer.Option("--force", help="With --generation: although nobody says that it is needed.")
    ] = False,
    settle: Annotated[
        bool, typer.Option("--settle", help="The other machine of this name is gone: be an elector again.")
    ] = False,
    accept: Annotated[
        list[str] | None,
        typer.Option("--accept", metavar="DANGER", help="lost-state: its state is lost, and no other node is left."),
    ] = None,
) -> None:
    """Create this node's blank state: "this name has never voted here".

    Refuses in another node's folder, and when a node that can be reached knows this name as an elector that has voted.
    If too many states are lost to agree, stop every daemon, and run it on every node with the --generation that
    `zsched status` names. That is refused while the fleet agrees, and where a good state would be lost.

    A machine that has lost its state gets the fleet's document first: what `zsched fleet export` writes on a living
    node, as its fleet file.

    With --example it writes no state but a small task: a fleet file, a worker, an application (see `zsched dev`).
    """
    if example is not None:
        if here.config or here.node or here.state_dir or generation or force or settle or accept:
            raise CliError(EXIT_USAGE, "--example goes with a folder only")
        give_example(example, folder or Path())
        return
    if folder is not None:
        raise CliError(EXIT_USAGE, f"{folder}: a folder goes with --example; name the state folder with --state-dir")
    from zsched.commands.init import create_state  # noqa: PLC0415 - each verb imports what it needs

    place = (here.config, here.node, here.state_dir)
    create_state(*place, generation, is_forced=force, is_settling=settle, accepted=accept or ())


def recover(
    here: Here,
    brought: Annotated[
        list[Path] | None,
        typer.Option("--from", metavar="STATE_FILE", help="State of a dead machine's disk; give it once for each."),
    ] = None,
    plan: PlanOption = False,
    yes: YesOption = False,
    accept: AcceptOption = None,
) -> None:
    """Begin a new generation on one survivor when a majority of the electors is lost for good.

    Tasks keep their newest values of all states that are given, under higher epochs. Its daemon must be stopped. It is
    refused while a majority of the electors can agree. Every other node changes sides by `zsched rejoin` there.
    """
    from zsched.commands.recover import Manner, place_of  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.recover import recover as run  # noqa: PLC0415 - as above

    manner = Manner(is_plan=plan, is_sure=yes, accepted=tuple(accept or ()))
    raise typer.Exit(run(place_of(here.config, here.node, here.state_dir), manner, tuple(brought or ())))


def rejoin(
    here: Here,
    generation: Annotated[
        str, typer.Argument(metavar="[GENERATION]", help="The beginning of its id; needed where there are several.")
    ] = "",
    plan: PlanOption = False,
    yes: YesOption = False,
) -> None:
    """Let this node change sides to another generation of its fleet, as after `zsched recover` elsewhere.

    It starts blank there: what it has promised and learnt in its own generation is dropped. Its daemon must be stopped.
    """
    from zsched.commands.recover import Manner, place_of  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.recover import rejoin as run  # noqa: PLC0415 - as above

    manner = Manner(is_plan=plan, is_sure=yes)
    raise typer.Exit(run(place_of(here.config, here.node, here.state_dir), manner, generation))


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
