"""The verbs by which an operator gives orders: arguments in, exit code out.

Knows: options. Does not know: how anything is done (files of the verbs' names, imported by the verb that runs).
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from zsched.commands.common import CliError
from zsched.commands.options import AskedOption, ConnectOption, JsonOption, PlanOption, RuntimeOption, YesOption
from zsched.exits import EXIT_USAGE

if TYPE_CHECKING:
    from zsched.commands.orders import OrderView

TaskArgument = Annotated[str, typer.Argument(metavar="TASK", help="A task of the fleet file.")]
TasksArgument = Annotated[list[str] | None, typer.Argument(metavar="[TASK]...", help="Tasks of the fleet file.")]
ReasonOption = Annotated[
    str,
    typer.Option(
        "--reason", "-m", metavar="TEXT", help="Why; the history tells it, and of an order in force status, too."
    ),
]
RevisionOption = Annotated[
    int | None, typer.Option("--revision", min=0, metavar="N", help="Only if this is still the task's revision.")
]
ForOption = Annotated[
    str | None, typer.Option("--for", metavar="DURATION", help="End it by itself: 90s, 10m, 2h, 1d. [until taken back]")
]
AllOption = Annotated[bool, typer.Option("--all", help="Every task.")]


def move(
    task: TaskArgument,
    to: Annotated[str, typer.Argument(metavar="NODE", help="A candidate of the task.")],
    origin: Annotated[str | None, typer.Option("--from", metavar="NODE", help="Only if this is the owner.")] = None,
    detach: Annotated[bool, typer.Option("--detach", help="Do not wait until the streams have settled.")] = False,
    timeout: Annotated[float, typer.Option(min=0.0, max=3600.0, metavar="S", help="Seconds to wait.")] = 30.0,
    reason: ReasonOption = "",
    revision: RevisionOption = None,
    plan: PlanOption = False,
    yes: YesOption = False,
    json_: JsonOption = False,
    node: AskedOption = None,
    runtime_dir: RuntimeOption = None,
    connect: ConnectOption = None,
) -> None:
    """Hand a task over to a node, and wait until its streams have settled there.

    It does not pin: the fleet may move the task again when it has reason to. Exits with 5 when it has not settled in
    time; it goes on all the same.
    """
    from zsched.commands.move import MoveOrder  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.move import move as give  # noqa: PLC0415 - as above

    view = order_view(node, runtime_dir, connect, reason, revision, None, json_=json_, yes=yes, plan=plan)
    order = MoveOrder(task=task, node=to, origin=origin, is_detached=detach, timeout_s=timeout)
    raise typer.Exit(give(view, order))


def pin(
    task: Annotated[str | None, typer.Argument(metavar="[TASK]", help="A task; without it: list the pins.")] = None,
    to: Annotated[str | None, typer.Argument(metavar="[NODE]", help="Where it belongs. [its owner]")] = None,
    hard: Annotated[bool, typer.Option("--hard", help="No other node ever gets it, though this one be dead.")] = False,
    for_: ForOption = None,
    reason: ReasonOption = "",
    revision: RevisionOption = None,
    plan: PlanOption = False,
    yes: YesOption = False,
    json_: JsonOption = False,
    node: AskedOption = None,
    runtime_dir: RuntimeOption = None,
    connect: ConnectOption = None,
) -> None:
    """Keep a task on a node: it moves for an escape only, and comes back when that node is fit again.

    Without a task it lists the pins.
    """
    view = order_view(node, runtime_dir, connect, reason, revision, for_, json_=json_, yes=yes, plan=plan)
    _hold(view, "pin", [task] if task else [], to, is_hard=hard)


def unpin(
    task: Annotated[str | None, typer.Argument(metavar="[TASK]", help="A task; without it: list the pins.")] = None,
    reason: ReasonOption = "",
    revision: RevisionOption = None,
    plan: PlanOption = False,
    yes: YesOption = False,
    json_: JsonOption = False,
    node: AskedOption = None,
    runtime_dir: RuntimeOption = None,
    connect: ConnectOption = None,
) -> None:
    """End a task's pin: the fleet places it again. Without a task it lists the pins."""
    _hold(
        order_view(node, runtime_dir, connect, reason, revision, None, json_=json_, yes=yes, plan=plan),
        "unpin",
        [task] if task else [],
    )


def pause(
    tasks: TasksArgument = None,
    all_: AllOption = False,
    wait: Annotated[
        bool, typer.Option("--wait", help="Until every node that is alive knows it; at most 30 s.")
    ] = False,
    for_: ForOption = None,
    reason: ReasonOption = "",
    revision: RevisionOption = None,
    plan: PlanOption = False,
    yes: YesOption = False,
    json_: JsonOption = False,
    node: AskedOption = None,
    runtime_dir: RuntimeOption = None,
    connect: ConnectOption = None,
) -> None:
    """Let nothing move tasks but `zsched move`: a dead owner is not replaced.

    Without a task it lists the pauses.
    """
    view = order_view(node, runtime_dir, connect, reason, revision, for_, json_=json_, yes=yes, plan=plan)
    _hold(view, "pause", tasks or [], is_all=all_, is_waiting=wait)


def resume(
    tasks: TasksArgument = None,
    all_: AllOption = False,
    reason: ReasonOption = "",
    revision: RevisionOption = None,
    plan: PlanOption = False,
    yes: YesOption = False,
    json_: JsonOption = False,
    node: AskedOption = None,
    runtime_dir: RuntimeOption = None,
    connect: ConnectOption = None,
) -> None:
    """End the pause of tasks. Without a task it lists the pauses."""
    view = order_view(node, runtime_dir, connect, reason, revision, None, json_=json_, yes=yes, plan=plan)
    _hold(view, "resume", tasks or [], is_all=all_)


def tune(
    task: Annotated[str | None, typer.Argument(metavar="[TASK]", help="A task; without it: show all.")] = None,
    pairs: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[KEY=VALUE]...",
            help="Weights (of gauges, too), all of scheduling (deadline_ms, not objective) and link, as bonus=0.2; "
            "null: the file's.",
        ),
    ] = None,
    reason: ReasonOption = "",
    revision: RevisionOption = None,
    plan: PlanOption = False,
    yes: YesOption = False,
    json_: JsonOption = False,
    node: AskedOption = None,
    runtime_dir: RuntimeOption = None,
    connect: ConnectOption = None,
) -> None:
    """Show a task's tuning, or change it on the whole running fleet.

    A change is agreed like an allocation: it holds for every robot, or for none (exit 4 without a quorum).
    """
    from zsched.commands.tune import tune as give  # noqa: PLC0415 - each verb imports what it needs

    view = order_view(node, runtime_dir, connect, reason, revision, None, json_=json_, yes=yes, plan=plan)
    raise typer.Exit(give(view, task, pairs or []))


def restart(
    task: TaskArgument,
    whose: Annotated[str | None, typer.Argument(metavar="[NODE]", help="Whose worker; without it the owner's.")] = None,
    reason: ReasonOption = "",
    plan: PlanOption = False,
    yes: YesOption = False,
    json_: JsonOption = False,
    node: AskedOption = None,
    runtime_dir: RuntimeOption = None,
    connect: ConnectOption = None,
) -> None:
    """Stop a task's worker and start it again, also one that has failed for good; that counts as no failure.

    The task pauses meanwhile if it is the owner's.
    """
    from zsched.commands.restart import restart as give  # noqa: PLC0415 - each verb imports what it needs

    raise typer.Exit(
        give(order_view(node, runtime_dir, connect, reason, None, None, json_=json_, yes=yes, plan=plan), task, whose)
    )


def order_view(
    node: str | None,
    runtime_dir: Path | None,
    connect: str | None,
    reason: str,
    revision: int | None,
    for_: str | None,
    *,
    json_: bool,
    yes: bool,
    plan: bool,
) -> OrderView:
    """The options of every verb that gives an order; ``for_``: how long it holds."""
    from zsched.commands.ask import find_door  # noqa: PLC0415 - as above
    from zsched.commands.history import duration_s  # noqa: PLC0415 - as above
    from zsched.commands.orders import OrderView  # noqa: PLC0415 - as above

    for_s = None if for_ is None else duration_s(for_)
    return OrderView(
        door=find_door(runtime_dir, node, connect=connect),
        is_json=json_,
        is_yes=yes,
        is_plan=plan,
        reason=reason,
        revision=revision,
        for_s=for_s,
    )


def _hold(
    view: OrderView,
    verb: str,
    tasks: list[str],
    node: str | None = None,
    *,
    is_hard: bool = False,
    is_all: bool = False,
    is_waiting: bool = False,
) -> None:
    from zsched.commands.hold import HoldOrder, hold  # noqa: PLC0415 - as above

    if tasks and is_all:
        raise CliError(EXIT_USAGE, "--all goes without tasks")
    order = HoldOrder(hold=verb, node=node, is_hard=is_hard, is_waiting=is_waiting)
    raise typer.Exit(hold(view, order, tasks, is_all=is_all))
