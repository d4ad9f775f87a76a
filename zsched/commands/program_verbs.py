"""The verbs about the program itself: its versions, completion and installation.

Knows: options. Does not know: how anything is done (files of the verbs' names, imported by the verb that runs).
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from zsched.commands.options import JsonOption, PlanOption


def version(json_: JsonOption = False) -> None:
    """Show the versions of zsched, its wire format, zenoh and Python."""
    from zsched.commands.versions import show_versions  # noqa: PLC0415 - each verb imports what it needs

    show_versions(is_json=json_)


def complete(
    ctx: typer.Context,
    words: Annotated[list[str] | None, typer.Argument(metavar="WORD...", help="Typed so far.")] = None,
) -> None:
    """Print what the last word may become, for the scripts that `zsched install` brings."""
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
