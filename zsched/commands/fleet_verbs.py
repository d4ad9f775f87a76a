"""The verbs below `zsched fleet`, `zsched task` and `zsched node`: arguments in, exit code out.

Knows: options. Does not know: how anything is done (`zsched.commands.fleet`, `zsched.commands.entries`, imported by the
verb that runs).
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from zsched.commands.common import Verb, Verbs
from zsched.commands.options import AskedOption, ConnectOption, JsonOption, PlanOption, RuntimeOption, YesOption

if TYPE_CHECKING:
    from zsched.commands.apply import ApplyView


def _group(name: str, help_: str) -> typer.Typer:
    return typer.Typer(name=name, cls=Verbs, help=help_, no_args_is_help=True, rich_markup_mode=None)


fleet_app = _group("fleet", "The document that all nodes of the fleet go by.")
task_app = _group("task", "Tasks that come and go while the fleet runs.")
node_app = _group("node", "Machines that come and go while the fleet runs.")

RevisionOption = Annotated[
    int | None, typer.Option("--revision", min=0, metavar="N", help="Only if this is still the fleet's revision.")
]
AcceptOption = Annotated[
    list[str] | None, typer.Option("--accept", metavar="DANGER", help="Accept this danger; give it once for each.")
]
ReasonOption = Annotated[str, typer.Option("--reason", "-m", metavar="TEXT", help="Why; the journal shows it.")]
PauseAfterOption = Annotated[
    int | None,
    typer.Option(
        "--pause-after",
        min=1,
        max=1000,
        metavar="N",
        help="Changed workers start on N candidates, and wait for `zsched task promote`.",
    ),
]


def where_of(at: tuple[str | None, Path | None, str | None]) -> tuple[str, ...]:
    """The words that say which daemon is asked; ``at`` are --node, --runtime-dir and --connect."""
    return tuple(
        word
        for option, value in zip(("--node", "--runtime-dir", "--connect"), at, strict=True)
        if value is not None
        for word in (option, str(value))
    )


def view_of(
    words: tuple[str, ...],
    *,
    plan: bool,
    yes: bool,
    revision: int | None,
    accept: list[str] | None,
    reason: str,
    is_json: bool,
    at: tuple[str | None, Path | None, str | None],
    is_data: bool = False,
    pause_after: int | None = None,
) -> ApplyView:
    """The options of every verb that changes the document; ``at`` are --node, --runtime-dir and --connect."""
    from zsched.commands.apply import ApplyView  # noqa: PLC0415 - each verb imports what it needs

    return ApplyView(
        words=words,
        is_plan=plan,
        is_sure=yes,
        is_json=is_json,
        accepted=tuple(accept or ()),
        revision=revision,
        reason=reason,
        is_data=is_data,
        pause_after=pause_after,
        where=where_of(at),
    )


@fleet_app.command("show", cls=Verb)
def fleet_show(
    json_: JsonOption = False,
    node: AskedOption = None,
    runtime_dir: RuntimeOption = None,
    connect: ConnectOption = None,
) -> None:
    """Show the fleet's revision, its electors and its document, and which node goes by which."""
    from zsched.commands.ask import find_door  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.fleet import show  # noqa: PLC0415 - as above

    raise typer.Exit(show(find_door(runtime_dir, node, connect=connect), is_json=json_))


@fleet_app.command("export", cls=Verb)
def fleet_export(
    file: Annotated[Path | None, typer.Option("--output", "-o", metavar="FILE", help="Where to; else stdout.")] = None,
    node: AskedOption = None,
    runtime_dir: RuntimeOption = None,
    connect: ConnectOption = None,
) -> None:
    """Write the document as its operator wrote it, comments and all."""
    from zsched.commands.ask import find_door  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.fleet import export  # noqa: PLC0415 - as above

    raise typer.Exit(export(find_door(runtime_dir, node, connect=connect), file))


@task_app.command("add", cls=Verb)
def task_add(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="YAML with the one key `tasks`, as in a fleet file.")],
    plan: PlanOption = False,
    yes: YesOption = False,
    revision: RevisionOption = None,
    accept: AcceptOption = None,
    reason: ReasonOption = "",
    json_: JsonOption = False,
    node: AskedOption = None,
    runtime_dir: RuntimeOption = None,
    connect: ConnectOption = None,
) -> None:
    """Add the tasks of a file to the document; the rest of it stays as it is written."""
    _add("task", "tasks", file, plan, yes, revision, accept, reason, json_, node, runtime_dir, connect)


@task_app.command("remove", cls=Verb)
def task_remove(
    task: Annotated[str, typer.Argument(metavar="TASK", help="A task of the fleet.")],
    plan: PlanOption = False,
    yes: YesOption = False,
    revision: RevisionOption = None,
    accept: AcceptOption = None,
    reason: ReasonOption = "",
    json_: JsonOption = False,
    node: AskedOption = None,
    runtime_dir: RuntimeOption = None,
    connect: ConnectOption = None,
) -> None:
    """Take a task out of the document: its workers stop, its streams end (--accept remove-task)."""
    from zsched.commands.ask import find_door  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.entries import drop_task  # noqa: PLC0415 - as above

    words = ("task", "remove", task)
    view = view_of(
        words,
        plan=plan,
        yes=yes,
        revision=revision,
        accept=accept,
        reason=reason,
        is_json=json_,
        at=(node, runtime_dir, connect),
    )
    raise typer.Exit(drop_task(find_door(runtime_dir, node, connect=connect), view, task))


@task_app.command("promote", cls=Verb)
def task_promote(
    tasks: Annotated[
        list[str] | None, typer.Argument(metavar="[TASK]...", help="Tasks that wait; none: only show what waits.")
    ] = None,
    plan: PlanOption = False,
    yes: YesOption = False,
    revision: RevisionOption = None,
    reason: ReasonOption = "",
    json_: JsonOption = False,
    node: AskedOption = None,
    runtime_dir: RuntimeOption = None,
    connect: ConnectOption = None,
) -> None:
    """Let a changed worker go on to all nodes, after `zsched apply --pause-after` and a look at the first ones.

    To take it back instead, apply the file of before.
    """
    from zsched.commands.ask import find_door  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.promote import promote  # noqa: PLC0415 - as above

    words = ("task", "promote", *(tasks or ()))
    view = view_of(
        words,
        plan=plan,
        yes=yes,
        revision=revision,
        accept=None,
        reason=reason,
        is_json=json_,
        at=(node, runtime_dir, connect),
    )
    raise typer.Exit(promote(find_door(runtime_dir, node, connect=connect), view, tasks or []))


@node_app.command("add", cls=Verb)
def node_add(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="YAML with the one key `nodes`, as in a fleet file.")],
    plan: PlanOption = False,
    yes: YesOption = False,
    revision: RevisionOption = None,
    accept: AcceptOption = None,
    reason: ReasonOption = "",
    json_: JsonOption = False,
    node: AskedOption = None,
    runtime_dir: RuntimeOption = None,
    connect: ConnectOption = None,
) -> None:
    """Add the nodes of a file to the document; then start their daemons."""
    _add("node", "nodes", file, plan, yes, revision, accept, reason, json_, node, runtime_dir, connect)


@node_app.command("remove", cls=Verb)
def node_remove(
    name: Annotated[str, typer.Argument(metavar="NODE", help="A node of the fleet that owns no task.")],
    plan: PlanOption = False,
    yes: YesOption = False,
    revision: RevisionOption = None,
    accept: AcceptOption = None,
    reason: ReasonOption = "",
    json_: JsonOption = False,
    node: AskedOption = None,
    runtime_dir: RuntimeOption = None,
    connect: ConnectOption = None,
) -> None:
    """Take a node out of the document, and out of every list of names in it (--accept remove-node).

    Refused for the last elector, and for a node that is alive and owns tasks.
    """
    _drop(name, False, plan, yes, revision, accept, reason, json_, node, runtime_dir, connect)


@node_app.command("forget", cls=Verb)
def node_forget(
    name: Annotated[str, typer.Argument(metavar="NODE", help="A node that is gone and does not come back.")],
    plan: PlanOption = False,
    yes: YesOption = False,
    revision: RevisionOption = None,
    accept: AcceptOption = None,
    reason: ReasonOption = "",
    json_: JsonOption = False,
    node: AskedOption = None,
    runtime_dir: RuntimeOption = None,
    connect: ConnectOption = None,
) -> None:
    """Take out a node that is gone for good; refused while it is alive (--accept remove-node)."""
    _drop(name, True, plan, yes, revision, accept, reason, json_, node, runtime_dir, connect)


def _add(
    what: str,
    section: str,
    file: Path,
    plan: bool,
    yes: bool,
    revision: int | None,
    accept: list[str] | None,
    reason: str,
    json_: bool,
    node: str | None,
    runtime_dir: Path | None,
    connect: str | None,
) -> None:
    from zsched.commands.ask import find_door  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.entries import add  # noqa: PLC0415 - as above

    words = (what, "add", str(file))
    view = view_of(
        words,
        plan=plan,
        yes=yes,
        revision=revision,
        accept=accept,
        reason=reason,
        is_json=json_,
        at=(node, runtime_dir, connect),
    )
    raise typer.Exit(add(find_door(runtime_dir, node, connect=connect), view, section, file))


def _drop(
    name: str,
    is_lost: bool,
    plan: bool,
    yes: bool,
    revision: int | None,
    accept: list[str] | None,
    reason: str,
    json_: bool,
    node: str | None,
    runtime_dir: Path | None,
    connect: str | None,
) -> None:
    from zsched.commands.ask import find_door  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.entries import drop_node  # noqa: PLC0415 - as above

    words = ("node", "forget" if is_lost else "remove", name)
    view = view_of(
        words,
        plan=plan,
        yes=yes,
        revision=revision,
        accept=accept,
        reason=reason,
        is_json=json_,
        at=(node, runtime_dir, connect),
    )
    raise typer.Exit(drop_node(find_door(runtime_dir, node, connect=connect), view, name, is_lost=is_lost))
