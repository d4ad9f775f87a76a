"""The verbs by which an operator flags nodes: arguments in, exit code out.

Knows: options. Does not know: how anything is done (`zsched.commands.flags`, imported by the verb that runs).
"""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

import typer

from zsched.commands.common import CliError
from zsched.commands.fleet_verbs import AcceptOption, RevisionOption
from zsched.commands.options import AskedOption, ConnectOption, JsonOption, PlanOption, RuntimeOption, YesOption
from zsched.commands.order_verbs import ForOption, ReasonOption, order_view
from zsched.exits import EXIT_USAGE


class Only(StrEnum):
    """What a drain keeps from nodes."""

    NEW = "new"


NodesArgument = Annotated[list[str] | None, typer.Argument(metavar="[NODE]...", help="Nodes of the fleet.")]


def drain(
    nodes: NodesArgument = None,
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
    accept: AcceptOption = None,
    reason: ReasonOption = "",
    revision: RevisionOption = None,
    plan: PlanOption = False,
    yes: YesOption = False,
    json_: JsonOption = False,
    node: AskedOption = None,
    runtime_dir: RuntimeOption = None,
    connect: ConnectOption = None,
) -> None:
    """Empty nodes: they get nothing new, and their tasks move away one after another, also pinned ones (not --hard).

    Watches until each node owns nothing and its old slots are closed. The nodes stay drained, over restarts, until
    `zsched undrain`. A task that nobody else can have stays. Without nodes it lists the drained ones. Exits with 5 at
    the deadline; the drain goes on all the same.
    """
    from zsched.commands.flags import DRAIN, INELIGIBLE, DrainOrder  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.flags import drain as give  # noqa: PLC0415 - as above
    from zsched.commands.history import duration_s  # noqa: PLC0415 - as above

    if self_ and (node is not None or connect is not None):
        raise CliError(EXIT_USAGE, "--self is the node of this machine: name the node instead")
    order = DrainOrder(
        nodes=tuple(nodes or ()),
        is_self=self_,
        is_detached=detach or only is Only.NEW,
        deadline_s=None if force else duration_s(deadline),
        accepted=tuple(accept or ()),
        kind=DRAIN if only is None else INELIGIBLE,
    )
    view = order_view(node, runtime_dir, connect, reason, revision, for_, json_=json_, yes=yes, plan=plan)
    raise typer.Exit(give(view, order))


def undrain(
    nodes: Annotated[
        list[str] | None, typer.Argument(metavar="[NODE]...", help="Nodes; without one: list the drained ones.")
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
    """End every drain of nodes: they may get tasks again, when the fleet finds them better.

    Without a node it lists those that are drained.
    """
    from zsched.commands.flags import undrain as give  # noqa: PLC0415 - each verb imports what it needs

    view = order_view(node, runtime_dir, connect, reason, revision, None, json_=json_, yes=yes, plan=plan)
    raise typer.Exit(give(view, nodes or ()))
