"""The verbs that take a whole fleet file: `check`, `apply`, `edit`: arguments in, exit code out.

Knows: options. Does not know: how anything is done (`zsched.commands.apply` and others, imported when a verb runs).
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from zsched.commands.common import Json, counted, print_json, say, warn
from zsched.commands.fleet_verbs import (
    AcceptOption,
    PauseAfterOption,
    PlanOption,
    ReasonOption,
    RevisionOption,
    YesOption,
)
from zsched.commands.options import AskedOption, ConfigOption, ConnectOption, JsonOption, RuntimeOption
from zsched.exits import EXIT_CONFIG


def check(
    file: Annotated[Path | None, typer.Argument(metavar="[FILE]", help="Fleet file; as --config.")] = None,
    config: ConfigOption = None,
    json_: JsonOption = False,
) -> None:
    """Check a fleet file: all faults that can be judged at once, each with file:line:col; exits with 78 on any.

    Of a file without fault it says in words when each task moves, setting by setting, once for tasks alike.
    """
    from zsched import paths as places  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.rules import told_once  # noqa: PLC0415 - as above
    from zsched.config.load import check_file  # noqa: PLC0415 - ruamel.yaml is slow to import
    from zsched.core.values.fleet import fleet_hash  # noqa: PLC0415 - as above

    result = check_file(places.config_path(file or config, os.environ))
    fleet = result.fleet
    counts: Json | None = None
    digest = None if fleet is None else fleet_hash(fleet)
    if fleet is not None:
        counts = {"nodes": len(fleet.nodes), "tasks": len(fleet.tasks), "electors": len(fleet.electors)}
    if json_:
        lists = {"faults": result.faults, "warnings": result.warnings}
        keys = ("line", "col", "message", "hint", "source_line")
        found = {name: [{key: getattr(fault, key) for key in keys} for fault in items] for name, items in lists.items()}
        named = None if fleet is None else {"name": fleet.name, **(counts or {})}
        body = {"schema": "zsched.check/1", "file": result.file, "ok": fleet is not None, "hash": digest}
        print_json({**body, "fleet": named, **found})
    elif report := result.report():
        warn(report)
    if counts is None:
        raise typer.Exit(EXIT_CONFIG)
    if not json_:
        say("ok: " + ", ".join(counted(number, noun) for noun, number in counts.items()))
        say(f"hash: {digest} (nodes whose files have another one say so in `zsched status`)")
    for first, *more in told_once(fleet.tasks, fleet.timing) if fleet is not None and not json_ else ():
        say(first)
        for line in more:
            say(f"  {line}", indent=4)


def apply(
    file: Annotated[str, typer.Argument(metavar="FILE", help="Fleet file; -: stdin.")],
    plan: PlanOption = False,
    yes: YesOption = False,
    revision: RevisionOption = None,
    accept: AcceptOption = None,
    pause_after: PauseAfterOption = None,
    reason: ReasonOption = "",
    json_: JsonOption = False,
    node: AskedOption = None,
    runtime_dir: RuntimeOption = None,
    connect: ConnectOption = None,
) -> None:
    """Change the running fleet to what a fleet file says: shows what follows, asks, and has it agreed for all nodes.

    The first one of a fleet agrees the file that its nodes run by. A danger has a name, and --accept takes it.
    Exits with 1 when the fleet was changed meanwhile, with 4 without a quorum, with 10 when --plan shows a change.
    """
    from zsched.commands.apply import apply as change  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.apply import read_text  # noqa: PLC0415 - as above
    from zsched.commands.ask import find_door  # noqa: PLC0415 - as above
    from zsched.commands.fleet_verbs import view_of  # noqa: PLC0415 - as above

    words = ("apply", file)
    view = view_of(
        words,
        plan=plan,
        yes=yes,
        revision=revision,
        accept=accept,
        reason=reason,
        is_json=json_,
        pause_after=pause_after,
        at=(node, runtime_dir, connect),
    )
    door = find_door(runtime_dir, node, connect=connect)
    text = read_text(file)
    raise typer.Exit(change(door, view, lambda _held: text, file))


def edit(
    plan: PlanOption = False,
    yes: YesOption = False,
    revision: RevisionOption = None,
    accept: AcceptOption = None,
    pause_after: PauseAfterOption = None,
    reason: ReasonOption = "",
    node: AskedOption = None,
    runtime_dir: RuntimeOption = None,
    connect: ConnectOption = None,
) -> None:
    """Open the fleet's document in your editor (VISUAL, EDITOR, else vi), and apply what comes of it.

    A text with faults, or one that is refused, stays in a file that the message names.
    """
    from zsched.commands.ask import find_door  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.fleet import edit as open_document  # noqa: PLC0415 - as above
    from zsched.commands.fleet_verbs import view_of  # noqa: PLC0415 - as above

    view = view_of(
        ("edit",),
        plan=plan,
        yes=yes,
        revision=revision,
        accept=accept,
        reason=reason,
        is_json=False,
        at=(node, runtime_dir, connect),
        pause_after=pause_after,
    )
    raise typer.Exit(open_document(find_door(runtime_dir, node, connect=connect), view))
