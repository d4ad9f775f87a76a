"""The verbs of this machine's own node: `up`, `init`, `recover`, `rejoin`, `dev`: arguments in, exit code out.

Knows: options. Does not know: how anything is done (files of the verbs' names, imported by the verb that runs).
"""

from __future__ import annotations

import os
import shlex
import signal
import sys
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from zsched.commands.common import CliError, counted, say, warn
from zsched.commands.example import Example, write_example
from zsched.commands.fleet_verbs import AcceptOption, PlanOption, YesOption
from zsched.commands.options import ConfigOption, NameOption, RuntimeOption, StateOption
from zsched.errors import ConfigError
from zsched.exits import EXIT_USAGE

if TYPE_CHECKING:
    from zsched.commands.recover import Place  # imports zenoh
    from zsched.runtime.init import Heard  # likewise


STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class LogLevel(StrEnum):
    """How much the daemon says on stderr."""

    DEBUG = "DEBUG"
    INFO = "INFO"
    WARNING = "WARNING"
    ERROR = "ERROR"


def up(
    config: ConfigOption = None,
    node: NameOption = None,
    state_dir: StateOption = None,
    runtime_dir: RuntimeOption = None,
    log_level: Annotated[LogLevel, typer.Option("--log-level", help="What goes to stderr.")] = LogLevel.INFO,
) -> None:
    """Run this machine's daemon in the foreground (what systemd runs)."""
    from zsched import paths as places  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.here import need_file, own_name  # noqa: PLC0415 - as above

    file = places.config_path(config, os.environ)
    need_file(file)
    name = own_name(node)
    state = places.state_folder(state_dir, os.environ)
    runtime = places.runtime_folder(runtime_dir, os.environ)
    daemon = [sys.executable, "-m", "zsched.daemon", "--config", str(file), "--node", name]
    daemon += ["--state-dir", str(state), "--runtime-dir", str(runtime), "--log-level", log_level.value]
    sys.stdout.flush()
    sys.stderr.flush()
    signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)  # the daemon takes what comes while it loads, see there
    # the same process id (systemd's main process), without this command line's memory
    os.execv(sys.executable, daemon)  # noqa: S606 - no shell is wanted


def init(
    folder: Annotated[
        Path | None, typer.Argument(metavar="DIR", help="With --example: where; without it the current folder.")
    ] = None,
    example: Annotated[
        Example | None, typer.Option("--example", help="Write an example into DIR instead; nothing is overwritten.")
    ] = None,
    config: ConfigOption = None,
    node: NameOption = None,
    state_dir: StateOption = None,
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
) -> None:
    """Create this node's blank state: "this name has never voted here".

    Refuses in another node's folder, and when a node that can be reached knows this name as an elector that has voted.
    If too many states are lost to agree, stop every daemon, and run it on every node with the --generation that
    `zsched status` names. That is refused while the fleet agrees, and where a good state would be lost.

    With --example it writes no state but a small task: a fleet file, a worker, an application (see `zsched dev`).
    """
    if example is not None:
        if config or node or state_dir or generation or force or settle:
            raise CliError(EXIT_USAGE, "--example goes with a folder only")
        _write_example(example, folder or Path())
        return
    if folder is not None:
        raise CliError(EXIT_USAGE, f"{folder}: a folder goes with --example; name the state folder with --state-dir")
    from zsched import paths as places  # noqa: PLC0415 - each verb imports what it needs
    from zsched.adapters.machine import core_speed  # noqa: PLC0415 - likewise
    from zsched.commands.here import own_name  # noqa: PLC0415 - as above
    from zsched.config.load import load_fleet, require_node  # noqa: PLC0415 - ruamel.yaml is slow to import
    from zsched.core.vote.belief import MAX_GENERATION  # noqa: PLC0415 - likewise
    from zsched.runtime.init import begin_anew, check_blank, init_state, settle_dispute, standing_state  # noqa: PLC0415 - imports zenoh

    if generation > MAX_GENERATION:
        raise CliError(EXIT_USAGE, f"--generation {generation}: at most {MAX_GENERATION}")
    file = places.config_path(config, os.environ)
    fleet = load_fleet(file)
    name = own_name(node)
    try:
        require_node(fleet, name, file)
    except ConfigError as error:
        if node is None:
            raise
        raise CliError(EXIT_USAGE, str(error)) from error  # a wrong word, and no wrong file
    state = places.state_folder(state_dir, os.environ)
    if settle:
        done = settle_dispute(fleet, name, state)
        say(f"{name}: {'settled; restart its daemon' if done else 'there was no dispute'}")
        return
    if force and not generation:
        raise CliError(EXIT_USAGE, "--force goes with --generation G")
    standing = standing_state(fleet, name, state)
    if standing is not None and generation in (0, standing.generation):
        text = f"{name} has its state in fleet {fleet.name}, generation {standing.generation}: nothing to do"
        say(f"{state}: {text}")
        return
    heard = check_blank(fleet, name, state, generation, standing, is_forced=force)
    side = heard.side
    path = init_state(fleet, name, state, generation) if side is None else begin_anew(fleet, name, state, side)
    warn(_heard(heard, name, generation, is_elector=name in fleet.electors))
    say(f"a core of this machine has speed {core_speed.kept_or_new(state):.2f}")
    if side is not None:
        text = "the others know it as an elector with another disk: it is a new member, and no elector until"
        say(f"{path}: blank state of {name} in fleet {fleet.name}; {text} it is added as one")
        return
    say(f"{path}: blank state of {name} in fleet {fleet.name}, generation {generation}")


def recover(
    config: ConfigOption = None,
    node: NameOption = None,
    state_dir: StateOption = None,
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
    from zsched.commands.recover import Manner  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.recover import recover as run  # noqa: PLC0415 - as above

    words = ["recover", *_place_words(config, node, state_dir)]
    words += [part for path in brought or () for part in ("--from", str(path))]
    manner = Manner(words=tuple(words), is_plan=plan, is_sure=yes, accepted=tuple(accept or ()))
    raise typer.Exit(run(_place(config, node, state_dir), manner, tuple(brought or ())))


def rejoin(
    generation: Annotated[
        str, typer.Argument(metavar="GENERATION", help="The beginning of its id; needed where there are several.")
    ] = "",
    config: ConfigOption = None,
    node: NameOption = None,
    state_dir: StateOption = None,
    plan: PlanOption = False,
    yes: YesOption = False,
) -> None:
    """Let this node change sides to another generation of its fleet, as after `zsched recover` elsewhere.

    It starts blank there: what it has promised and learnt in its own generation is dropped. Its daemon must be stopped.
    """
    from zsched.commands.recover import Manner  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.recover import rejoin as run  # noqa: PLC0415 - as above

    words = ("rejoin", *([generation] if generation else []), *_place_words(config, node, state_dir))
    manner = Manner(words=words, is_plan=plan, is_sure=yes)
    raise typer.Exit(run(_place(config, node, state_dir), manner, generation))


def _place_words(config: Path | None, node: str | None, state_dir: Path | None) -> list[str]:
    """The options that name a node and its files, as they were given."""
    given = (("--config", config), ("--node", node), ("--state-dir", state_dir))
    return [part for name, value in given if value is not None for part in (name, str(value))]


def _place(config: Path | None, node: str | None, state_dir: Path | None) -> Place:
    from zsched import paths as places  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.here import own_name  # noqa: PLC0415 - as above
    from zsched.commands.recover import Place  # noqa: PLC0415 - likewise
    from zsched.config.load import load_fleet, require_node  # noqa: PLC0415 - ruamel.yaml is slow to import

    file = places.config_path(config, os.environ)
    fleet = load_fleet(file)
    name = own_name(node)
    require_node(fleet, name, file)
    return Place(fleet=fleet, node=name, config=file, folder=places.state_folder(state_dir, os.environ))


def _write_example(example: Example, folder: Path) -> None:
    for path in write_example(example, folder):
        say(str(path))
    words = shlex.join(("zsched", "dev", *(() if folder == Path() else (str(folder),))))
    warn(f"next: `{words}`; it prints the line that starts the application in another terminal")


def _heard(heard: Heard, name: str, generation: int, *, is_elector: bool) -> str:
    """Which nodes were asked before a blank state was written, and what their answers say."""
    if not heard.asked:
        return "no other node has an address in the fleet file: nobody was asked"
    asked = f"asked {counted(heard.asked, 'other nodes')}"
    if not heard.answers:
        return f"{asked}: none answered" + (f", so nobody could say whether {name} has voted" if is_elector else "")
    said = f"{asked}, {len(heard.answers)} answered"
    where = f" in generation {generation}" if generation else ""
    return f"{said}: none remembers a vote of {name}{where}" if is_elector else said


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
