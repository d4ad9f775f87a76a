"""The verbs by which an operator gives orders: arguments in, exit code out.

Knows: options. Does not know: how anything is done (files of the verbs' names, imported by the verb that runs).
"""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

import typer

from zsched.commands.common import CliError
from zsched.commands.options import Changes, Consents, ForOption, Orders, TaskArgument
from zsched.exits import EXIT_USAGE

TasksArgument = Annotated[list[str] | None, typer.Argument(metavar="[TASK]...", help="Tasks of the fleet file.")]
AllOption = Annotated[bool, typer.Option("--all", help="Every task.")]


class Only(StrEnum):
    """What a drain keeps from nodes."""

    NEW = "new"


def move(
    said: Orders,
    task: TaskArgument,
    to: Annotated[str, typer.Argument(metavar="NODE", help="A candidate of the task.")],
    origin: Annotated[str | None, typer.Option("--from", metavar="NODE", help="Only if this is the owner.")] = None,
    detach: Annotated[bool, typer.Option("--detach", help="Do not wait until the streams have settled.")] = False,
    timeout: Annotated[float, typer.Option(min=0.0, max=3600.0, metavar="S", help="Seconds to wait.")] = 30.0,
) -> None:
    """Hand a task over to a node, and wait until its streams have settled there.

    It does not pin: the fleet may move the task again when it has reason to. Exits with 5 when it has not settled in
    time; it goes on all the same.
    """
    from zsched.commands.move import MoveOrder  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.move import move as give  # noqa: PLC0415 - as above

    order = MoveOrder(task=task, node=to, origin=origin, is_detached=detach, timeout_s=timeout)
    raise typer.Exit(give(said.order(), order))


def pin(
    said: Orders,
    task: Annotated[str | None, typer.Argument(metavar="[TASK]", help="A task; without it: list the pins.")] = None,
    to: Annotated[str | None, typer.Argument(metavar="[NODE]", help="Where it belongs. [its owner]")] = None,
    hard: Annotated[bool, typer.Option("--hard", help="No other node ever gets it, though this one be dead.")] = False,
    for_: ForOption = None,
) -> None:
    """Keep a task on a node: it moves for an escape only, and comes back when that node is fit again.

    Without a task it lists the pins.
    """
    _hold(said, "pin", [task] if task else [], to, is_hard=hard, for_=for_)


def unpin(
    said: Orders,
    task: Annotated[str | None, typer.Argument(metavar="[TASK]", help="A task; without it: list the pins.")] = None,
) -> None:
    """End a task's pin: the fleet places it again. Without a task it lists the pins."""
    _hold(said, "unpin", [task] if task else [])


def pause(
    said: Orders,
    tasks: TasksArgument = None,
    all_: AllOption = False,
    wait: Annotated[
        bool, typer.Option("--wait", help="Until every node that is alive knows it; at most 30 s.")
    ] = False,
    for_: ForOption = None,
) -> None:
    """Let nothing move tasks but `zsched move`: a dead owner is not replaced.

    Without a task it lists the pauses.
    """
    _hold(said, "pause", tasks or [], is_all=all_, is_waiting=wait, for_=for_)


def resume(said: Orders, tasks: TasksArgument = None, all_: AllOption = False) -> None:
    """End the pause of tasks. Without a task it lists the pauses."""
    _hold(said, "resume", tasks or [], is_all=all_)


def tune(
    said: Orders,
    task: Annotated[str | None, typer.Argument(metavar="[TASK]", help="A task; without it: show all.")] = None,
    pairs: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[KEY=VALUE]...",
            help="Weights (of gauges, too), all of scheduling (deadline_ms, not objective) and link, as bonus=0.2; "
            "null: the file's.",
        ),
    ] = None,
) -> None:
    """Show a task's tuning, or change it on the whole running fleet.

    A change is agreed like an allocation: it holds for every robot, or for none (exit 4 without a quorum).
    """
    from zsched.commands.tune import tune as give  # noqa: PLC0415 - each verb imports what it needs

    raise typer.Exit(give(said.order(), task, pairs or []))


def restart(
    said: Consents,
    task: TaskArgument,
    whose: Annotated[str | None, typer.Argument(metavar="[NODE]", help="Whose worker; without it the owner's.")] = None,
) -> None:
    """Stop a task's worker and start it again, also one that has failed for good; that counts as no failure.

    The task pauses meanwhile if it is the owner's.
    """
    from zsched.commands.restart import restart as give  # noqa: PLC0415 - each verb imports what it needs

    raise typer.Exit(give(said.order(), task, whose))


def drain(
    said: Changes,
    nodes: Annotated[list[str] | None, typer.Argument(metavar="[NODE]...", help="Nodes of the fleet.")] = None,
    self_: Annotated[bool, typer.Option("--self", help="The node that is asked.")] = False,
    only: Annotated[
        Only | None, typer.Option("--only", metavar="new", help="new: they get nothing new, and keep what they own.")
    ] = None,
    for_: ForOption = None,
    deadline: Annotated[
        str, typer.Option("--deadline", metavar="DURATION", help="How long to watch: 90s, 10m, 2h.")
    ] = "10m",
    force: Annotated[
        bool, typer.Option("--force", help="Ignore the deadline: watch until the nodes are empty.")
    ] = False,
    detach: Annotated[bool, typer.Option("--detach", help="Do not watch it.")] = False,
) -> None:
    """Empty nodes: they get nothing new, and their tasks move away one after another, also pinned ones (not --hard).

    Watches until each node owns nothing and its old slots are closed. The nodes stay drained, over restarts, until
    `zsched undrain`. A task that nobody else can have stays. Without nodes it lists the drained ones. Exits with 5 at
    the deadline; the drain goes on all the same.
    """
    from zsched.commands.flags import DRAIN, INELIGIBLE, DrainOrder  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.flags import drain as give  # noqa: PLC0415 - as above
    from zsched.commands.history import duration_s  # noqa: PLC0415 - as above

    if self_ and (said.node is not None or said.connect is not None):
        raise CliError(EXIT_USAGE, "--self is the node of this machine: name the node instead")
    order = DrainOrder(
        nodes=tuple(nodes or ()),
        is_self=self_,
        is_detached=detach or only is Only.NEW,
        deadline_s=None if force else duration_s(deadline),
        kind=DRAIN if only is None else INELIGIBLE,
    )
    raise typer.Exit(give(said.order(for_=for_), order))


def undrain(
    said: Orders,
    nodes: Annotated[
        list[str] | None, typer.Argument(metavar="[NODE]...", help="Nodes; without one: list the drained ones.")
    ] = None,
) -> None:
    """End every drain of nodes: they may get tasks again, when the fleet finds them better.

    Without a node it lists those that are drained.
    """
    from zsched.commands.flags import undrain as give  # noqa: PLC0415 - each verb imports what it needs

    raise typer.Exit(give(said.order(), nodes or ()))


def _hold(
    said: Orders,
    verb: str,
    tasks: list[str],
    node: str | None = None,
    *,
    is_hard: bool = False,
    is_all: bool = False,
    is_waiting: bool = False,
    for_: str | None = None,
) -> None:
    from zsched.commands.hold import HoldOrder, hold  # noqa: PLC0415 - as above

    view = said.order(for_=for_)
    if tasks and is_all:
        raise CliError(EXIT_USAGE, "--all goes without tasks")
    order = HoldOrder(hold=verb, node=node, is_hard=is_hard, is_waiting=is_waiting)
    raise typer.Exit(hold(view, order, tasks, is_all=is_all))
