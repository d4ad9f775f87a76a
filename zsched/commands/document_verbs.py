"""The verbs that take a whole fleet file: `check`, `apply`, `edit`: arguments in, exit code out.

Knows: options. Does not know: how anything is done (`zsched.commands.apply` and others, imported when a verb runs).
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from zsched.commands.options import Changes, ConfigOption, Edits, JsonOption, PauseAfterOption


def check(
    file: Annotated[Path | None, typer.Argument(metavar="[FILE]", help="Fleet file; as --config.")] = None,
    config: ConfigOption = None,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Say in words when each task moves.")] = False,
    json_: JsonOption = False,
) -> None:
    """Check a fleet file: all faults that can be judged at once, each with file:line:col; exits with 78 on any.

    A file without fault is one line. With -v it says when each task moves, setting by setting, once for tasks alike.
    """
    from zsched.commands.check import show_faults  # noqa: PLC0415 - each verb imports what it needs

    raise typer.Exit(show_faults(file or config, is_json=json_, is_verbose=verbose))


def apply(
    said: Changes,
    file: Annotated[str, typer.Argument(metavar="FILE", help="Fleet file; -: stdin.")],
    pause_after: PauseAfterOption = None,
) -> None:
    """Change the running fleet to what a fleet file says: shows what follows, asks, and has it agreed for all nodes.

    The first one of a fleet agrees the file that its nodes run by. A danger has a name, and --accept takes it.
    Exits with 1 when the fleet was changed meanwhile, with 4 without a quorum, with 10 when --plan shows a change.
    """
    from zsched.commands.apply import apply as change  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.apply import read_text  # noqa: PLC0415 - as above

    view, text = said.order("apply", file, pause_after=pause_after), read_text(file)
    raise typer.Exit(change(view, lambda _held: text, file))


def edit(said: Edits, pause_after: PauseAfterOption = None) -> None:
    """Open the fleet's document in your editor (VISUAL, EDITOR, else vi), and apply what comes of it.

    A text with faults, or one that is refused, stays in a file that the message names.
    """
    from zsched.commands.fleet import edit as open_document  # noqa: PLC0415 - each verb imports what it needs

    raise typer.Exit(open_document(said.order("edit", pause_after=pause_after)))
