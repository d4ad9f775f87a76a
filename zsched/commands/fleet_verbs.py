"""The verbs below `zsched fleet`, `zsched task` and `zsched node`: arguments in, exit code out.

Knows: options. Does not know: how anything is done (`zsched.commands.fleet`, `zsched.commands.entries`, imported by the
verb that runs).
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from zsched.commands.options import Answers, Asks, Changes, Orders, OutputOption, new_group


def show(asked: Answers) -> None:
    """Show the fleet's revision, its electors and its document, and which node goes by which."""
    from zsched.commands import fleet  # noqa: PLC0415 - each verb imports what it needs

    raise typer.Exit(fleet.show(asked.door(), is_json=asked.json_))


def export(asked: Asks, file: OutputOption = None) -> None:
    """Write the document as its operator wrote it, comments and all."""
    from zsched.commands import fleet  # noqa: PLC0415 - each verb imports what it needs

    raise typer.Exit(fleet.export(asked.door(), file))


def task_add(
    said: Changes,
    file: Annotated[Path, typer.Argument(metavar="FILE", help="YAML with the one key `tasks`, as in a fleet file.")],
) -> None:
    """Add the tasks of a file to the document; the rest of it stays as it is written."""
    _add(said, "task", file)


def task_remove(
    said: Changes, task: Annotated[str, typer.Argument(metavar="TASK", help="A task of the fleet.")]
) -> None:
    """Take a task out of the document: its workers stop, its streams end (--accept remove-task)."""
    from zsched.commands.entries import drop_task  # noqa: PLC0415 - each verb imports what it needs

    raise typer.Exit(drop_task(said.order("task", "remove", task), task))


def task_promote(
    said: Orders,
    tasks: Annotated[
        list[str] | None, typer.Argument(metavar="[TASK]...", help="Tasks that wait; none: only show what waits.")
    ] = None,
) -> None:
    """Let a changed worker go on to all nodes, after `zsched apply --pause-after` and a look at the first ones.

    To take it back instead, apply the file of before.
    """
    from zsched.commands.promote import promote  # noqa: PLC0415 - each verb imports what it needs

    raise typer.Exit(promote(said.order("task", "promote", *(tasks or ())), tasks or []))


def node_add(
    said: Changes,
    file: Annotated[Path, typer.Argument(metavar="FILE", help="YAML with the one key `nodes`, as in a fleet file.")],
) -> None:
    """Add the nodes of a file to the document; then start their daemons."""
    _add(said, "node", file)


def node_remove(
    said: Changes, name: Annotated[str, typer.Argument(metavar="NODE", help="A node of the fleet that owns no task.")]
) -> None:
    """Take a node out of the document, and out of every list of names in it (--accept remove-node).

    Refused for the last elector, and for a node that is alive and owns tasks.
    """
    _drop(said, name, is_lost=False)


def node_forget(
    said: Changes,
    name: Annotated[str, typer.Argument(metavar="NODE", help="A node that is gone and does not come back.")],
) -> None:
    """Take out a node that is gone for good; refused while it is alive (--accept remove-node)."""
    _drop(said, name, is_lost=True)


def _add(said: Changes, what: str, file: Path) -> None:
    from zsched.commands.entries import add  # noqa: PLC0415 - each verb imports what it needs

    raise typer.Exit(add(said.order(what, "add", str(file)), f"{what}s", file))


def _drop(said: Changes, name: str, *, is_lost: bool) -> None:
    from zsched.commands.entries import drop_node  # noqa: PLC0415 - each verb imports what it needs

    words = ("node", "forget" if is_lost else "remove", name)
    raise typer.Exit(drop_node(said.order(*words), name, is_lost=is_lost))


TASK = new_group(
    "task",
    "Tasks that come and go while the fleet runs.",
    {"add": task_add, "remove": task_remove, "promote": task_promote},
)
NODE = new_group(
    "node",
    "Machines that come and go while the fleet runs.",
    {"add": node_add, "remove": node_remove, "forget": node_forget},
)
