"""Completion of the command line in a shell: the script for each shell, and the words that may come next.

The script asks the program itself for the words, so it is never older than the program.

Knows: the tree of verbs as typer builds it, which words stand for nodes and tasks. Does not know: any verb.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Sequence
from enum import Enum
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from zsched.commands.base.common import Json
from zsched.core.values.errors import AdapterError, ConfigError
from zsched.host import paths as places
from zsched.host.operator_client import ask

ANSWER_S: Final = 0.5
"""A daemon that does not answer so soon is not waited for: somebody holds the tab key."""
CONDITIONS: Final = ("healthy", "quorum", "owner=", "settled=", "empty=")
"""Of `zsched wait --until`."""

SCRIPTS: Final = {"bash": "zsched", "zsh": "_zsched", "fish": "zsched.fish"}
"""{shell: its script's file, called as the shell looks for it}."""


def script_file(shell: str) -> Path:
    """The file that teaches a shell."""
    return Path(__file__).parent / "completions" / SCRIPTS[shell]


def next_words(program: Any, ctx: Any, words: Sequence[str]) -> list[str]:
    """What the last of ``words`` may become; empty where any word, or a file's name, may stand.

    ``program`` is typer's group of all verbs, ``ctx`` its context; ``words`` begins behind the program's name.
    """
    *before, last = words or ("",)
    command, position, option = program, 0, None
    for word in before:
        if option is not None:
            option = None  # that was its value
        elif word.startswith("-"):
            option = _option_with_value(command, word)
        elif hasattr(command, "commands"):
            command = command.get_command(ctx, word)
            if command is None:
                return []
        else:
            position += 1
    return sorted(word for word in _candidates(command, ctx, position, option, last) if word.startswith(last))


def _candidates(command: Any, ctx: Any, position: int, option: Any, last: str) -> list[str]:
    if option is not None:
        return _values(option)
    if last.startswith("-"):
        return [name for param in command.params if param.param_type_name == "option" for name in param.opts] + [
            "--help"
        ]
    if hasattr(command, "commands"):
        return list(command.list_commands(ctx))
    arguments = [param for param in command.params if param.param_type_name == "argument"]
    return _values(arguments[position]) if position < len(arguments) else []


def _option_with_value(command: Any, word: str) -> Any:
    """The option that takes the next word as its value; ``None`` when ``word`` takes none."""
    found = next((param for param in command.params if word in (*param.opts, *param.secondary_opts)), None)
    return None if found is None or found.is_flag else found


def _values(param: Any) -> list[str]:
    """What an argument, or an option's value, may be: by its name in the help."""
    name = (param.metavar or "").strip("[]")
    if name == "TASK":
        return fleet_names("tasks")
    if name == "NODE" or "--node" in param.opts:
        return fleet_names("nodes")
    if name == "CONDITION":
        return list(CONDITIONS)
    if name == "DANGER":
        from zsched.commands.act.apply import DANGERS  # noqa: PLC0415 - only who completes it pays for it

        return list(DANGERS)
    kind = getattr(getattr(param, "type_descriptor", None), "annotation", None)
    return [str(one.value) for one in kind] if isinstance(kind, type) and issubclass(kind, Enum) else []


def fleet_names(kind: str) -> list[str]:
    """The fleet's ``nodes`` or ``tasks``, by a daemon here, else by the fleet file; empty when neither says."""
    for read in (_from_daemon, _from_file):
        names = read(kind)
        if names:
            return names
    return []


def _from_daemon(kind: str) -> list[str]:
    with contextlib.suppress(AdapterError, OSError, KeyError):
        sockets = places.local_sockets(places.asked_folder(None, os.environ))
        own = places.node_name(None, os.environ)
        for path in sorted(sockets, key=lambda path: path.stem != own)[:1]:
            answer: Json = ask(path, {"verb": "status"}, ANSWER_S)
            return [str(one["name"]) for one in answer[kind]]
    return []


def _from_file(kind: str) -> list[str]:
    from zsched.config.load import load_fleet  # noqa: PLC0415 - ruamel.yaml is slow to import

    with contextlib.suppress(ConfigError, OSError):
        fleet = load_fleet(places.config_path(None, os.environ))
        return [one.name for one in (fleet.nodes if kind == "nodes" else fleet.tasks)]
    return []


def complete(
    ctx: typer.Context,
    words: Annotated[list[str] | None, typer.Argument(metavar="WORD...", help="Typed so far.")] = None,
) -> None:
    """Print what the last word may become, for the scripts that `zsched install` brings."""
    for word in next_words(ctx.find_root().command, ctx, words or ()):
        typer.echo(word)
