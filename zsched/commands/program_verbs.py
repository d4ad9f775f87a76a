"""The verbs about the program itself: its versions, completion, installation and manual.

Knows: options. Does not know: how anything is done (files of the verbs' names, imported by the verb that runs).
"""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from zsched.commands.options import JsonOption, PlanOption


def version(json_: JsonOption = False) -> None:
    """Show the versions of zsched, its wire format, zenoh and Python."""
    from zsched.commands.versions import show_versions  # noqa: PLC0415 - each verb imports what it needs

    show_versions(is_json=json_)


class Shell(StrEnum):
    """Where completion is wanted."""

    BASH = "bash"
    ZSH = "zsh"
    FISH = "fish"


def completion(shell: Annotated[Shell, typer.Argument(metavar="SHELL", help="bash, zsh or fish.")]) -> None:
    """Print the script that completes verbs, options, nodes and tasks in a shell.

    For bash: zsched completion bash > /etc/bash_completion.d/zsched
    """
    from zsched.commands.completion import script_file  # noqa: PLC0415 - each verb imports what it needs

    typer.echo(script_file(shell.value).read_text(encoding="utf-8"), nl=False)


def complete(
    ctx: typer.Context,
    words: Annotated[list[str] | None, typer.Argument(metavar="WORD...", help="Typed so far.")] = None,
) -> None:
    """Print what the last word may become, for the scripts of `zsched completion`."""
    from zsched.commands.completion import next_words  # noqa: PLC0415 - each verb imports what it needs

    for word in next_words(ctx.find_root().command, ctx, words or ()):
        typer.echo(word)


RootOption = Annotated[
    Path, typer.Option("--root", metavar="DIR", help="Below this folder instead; starts, stops and asks nothing.")
]


def install(plan: PlanOption = False, root: RootOption = Path("/")) -> None:
    """Let the system find a zsched that pip installed: units, the user, completion, manual pages, the program.

    It links or copies, says each step, and starts and enables nothing. Once more, it renews what is old.
    """
    from zsched.commands.install import install as do  # noqa: PLC0415 - each verb imports what it needs

    raise typer.Exit(do(root.absolute(), is_plan=plan))


def uninstall(plan: PlanOption = False, root: RootOption = Path("/")) -> None:
    """Stop the services and take away what `zsched install` made. Fleet file, state and the program stay."""
    from zsched.commands.install import uninstall as do  # noqa: PLC0415 - each verb imports what it needs

    raise typer.Exit(do(root.absolute(), is_plan=plan))


def man(ctx: typer.Context, folder: Annotated[Path, typer.Argument(metavar="DIR", help="Where to.")]) -> None:
    """Write the manual pages of all verbs, as files for man."""
    from zsched.commands.manual import write_pages  # noqa: PLC0415 - each verb imports what it needs

    write_pages(ctx.find_root().command, folder)
