"""`zsched task add|remove|promote`, `zsched node add|remove|forget`: one entry of the document, the rest as it stands.

Knows: which entry is meant, when a node may not go, which workers wait. Does not know: where an entry stands in the
text (`zsched.config.editing`), what follows from the change (`zsched.config.difference`).
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from zsched.commands.act.apply import Draft, agree, apply_change, read_text
from zsched.commands.base.change import DOCUMENT, HERE, InForce, document_text, fleet_of, in_force, status_of
from zsched.commands.base.common import CliError, Json, check_known
from zsched.commands.base.options import Changes, Orders, new_group
from zsched.commands.base.rollout import promoted
from zsched.config.editing import add_entries, remove_node, remove_task
from zsched.config.parts import Part
from zsched.core.values.exits import EXIT_FAILED, EXIT_OK, EXIT_WOULD_CHANGE
from zsched.core.values.struct import replace

FileArgument = Annotated[
    Path, typer.Argument(metavar="FILE", help="YAML with the one key `tasks` or `nodes`, as in a fleet file.")
]


def task_add(said: Changes, file: FileArgument) -> int:
    """Add the tasks of a file to the document; the rest of it stays as it is written.

    Example: zsched task add echo.yaml
    """
    return _add(said, "task", file)


def task_remove(
    said: Changes, task: Annotated[str, typer.Argument(metavar="TASK", help="A task of the fleet.")]
) -> int:
    """Take a task out of the document: its workers stop, its streams end (--accept remove-task).

    Example: zsched task remove echo --accept remove-task
    """
    view = said.order("task", "remove", task)

    def make(held: InForce) -> str:
        text = document_text(held)
        check_known(status_of(view.door), "task", task)
        return remove_task(text, task)

    return apply_change(view, make, DOCUMENT)


def task_promote(
    said: Orders,
    tasks: Annotated[
        list[str] | None, typer.Argument(metavar="[TASK]...", help="Tasks that wait; none: only show what waits.")
    ] = None,
) -> int:
    """Let a changed worker go on to all nodes, after `zsched apply --pause-after` and a look at the first ones.

    Example: zsched task promote map_merge

    To take it back instead, apply the file of before.
    """
    names = tasks or []
    view = said.order("task", "promote", *names)
    held = in_force(view.door)
    fleet = fleet_of(document_text(held))
    known, waiting = [task.name for task in fleet.tasks], [str(one["task"]) for one in held.rollouts]
    check_known({"fleet": held.fleet, "tasks": [{"name": name} for name in known]}, "task", *names)
    for name in names:
        if name not in waiting:
            raise CliError(EXIT_FAILED, f"{name} waits for nothing: all its nodes run the same worker")
    chosen = names or waiting
    draft = Draft(
        held=held,
        text=held.text,
        fleet=fleet,
        changes=tuple(promoted(held.rollouts, chosen, fleet)),
        dangers=(),
        rollouts=tuple(one for one in held.rollouts if one["task"] not in chosen),
    )
    if names:
        return agree(view, draft)
    code = agree(replace(view, is_plan=True), draft)
    return EXIT_OK if code == EXIT_WOULD_CHANGE and not view.is_plan else code


def node_add(said: Changes, file: FileArgument) -> int:
    """Add the nodes of a file to the document; then start their daemons.

    Example: zsched node add edge2.yaml
    """
    return _add(said, "node", file)


def node_remove(
    said: Changes, name: Annotated[str, typer.Argument(metavar="NODE", help="A node of the fleet that owns no task.")]
) -> int:
    """Take a node out of the document, and out of every list of names in it (--accept remove-node).

    Example: zsched node remove edge2 --accept remove-node

    Refused for the last elector, and for a node that is alive and owns tasks.
    """
    return _drop(said, name, is_lost=False)


def node_forget(
    said: Changes,
    name: Annotated[str, typer.Argument(metavar="NODE", help="A node that is gone and does not come back.")],
) -> int:
    """Take out a node that is gone for good; refused while it is alive (--accept remove-node).

    Example: zsched node forget edge2 --accept remove-node
    """
    return _drop(said, name, is_lost=True)


def _add(said: Changes, what: str, file: Path) -> int:
    section, view = f"{what}s", said.order(what, "add", str(file))
    fragment = read_text(str(file))
    part = Part(section=section, text=fragment, file=str(file))
    return apply_change(
        view, lambda held: add_entries(document_text(held), section, fragment, str(file)), DOCUMENT, part
    )


def _drop(said: Changes, node: str, *, is_lost: bool) -> int:
    """``is_lost``: it does not come back; only a node that is not there may be forgotten."""
    view = said.order("node", "forget" if is_lost else "remove", node)

    def make(held: InForce) -> str:
        text = document_text(held)
        status = status_of(view.door)
        check_known(status, "node", node)
        _check_may_go(held, status, node, is_lost=is_lost)
        return remove_node(text, node)

    return apply_change(view, make, DOCUMENT)


def _check_may_go(held: InForce, status: Json, node: str, *, is_lost: bool) -> None:
    """Refuse to take out a node that the fleet needs, with what to do."""
    state = next(str(one["state"]) for one in status["nodes"] if one["name"] == node)
    owned = [str(task["name"]) for task in status["tasks"] if task["owner"] == node]
    if [name for name, _ in held.electors] == [node]:
        advice = "add another elector first (`electorate:` in `zsched edit`)"
        raise CliError(EXIT_FAILED, f"{node} is the last elector: without it nothing can be agreed; {advice}")
    if is_lost and state in HERE:
        raise CliError(EXIT_FAILED, f"{node} is {state}: zsched node remove {node}")
    if state in HERE and owned:
        flags = next(one.get("flags", ()) for one in status["nodes"] if one["name"] == node)
        advice = f"`zsched drain {node}` first: it hands them over, and gets nothing new"
        if any(flag["kind"] in ("drain", "leave") for flag in flags):
            advice = f"it is drained: `zsched drain {node}` says what it waits for"
        raise CliError(EXIT_FAILED, f"{node} is {state} and owns {', '.join(owned)}; {advice}")


task = new_group(
    "task",
    "Tasks that come and go while the fleet runs.",
    {"add": task_add, "remove": task_remove, "promote": task_promote},
)


node = new_group(
    "node",
    "Machines that come and go while the fleet runs.",
    {"add": node_add, "remove": node_remove, "forget": node_forget},
)
