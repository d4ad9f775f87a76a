"""`zsched task promote`: a changed worker that has waited for a look goes on to all nodes.

Knows: which rollouts wait. Does not know: how a change is shown and agreed (`zsched.commands.apply`).
"""

from __future__ import annotations

from collections.abc import Sequence

from zsched.commands.apply import Plan, agree
from zsched.commands.common import CliError, nearest
from zsched.commands.document import document_text, in_force
from zsched.commands.orders import OrderView
from zsched.commands.rollout import promoted
from zsched.config.load import check_bytes
from zsched.core.values.struct import replace
from zsched.exits import EXIT_FAILED, EXIT_OK, EXIT_USAGE, EXIT_WOULD_CHANGE


def promote(view: OrderView, names: Sequence[str]) -> int:
    """Let the changed workers of tasks go on to all nodes; without a task only show what waits; the exit code.

    Raises:
        CliError: nobody answers, a task is not there or does not wait, or the change is not agreed.
    """
    held = in_force(view.door)
    fleet = check_bytes(document_text(held).encode(), "the fleet's document").fleet
    if fleet is None:
        raise CliError(EXIT_FAILED, "the document in force has faults for this version of zsched; update zsched here")
    known, waiting = [task.name for task in fleet.tasks], [str(one["task"]) for one in held.rollouts]
    for name in names:
        if name not in known:
            raise CliError(EXIT_USAGE, f"fleet {held.fleet} has no task {name!r}{nearest(name, known)}")
        if name not in waiting:
            raise CliError(EXIT_FAILED, f"{name} waits for nothing: all its nodes run the same worker")
    chosen = names or waiting
    plan = Plan(
        held=held,
        text=held.text,
        fleet=fleet,
        changes=tuple(promoted(held.rollouts, chosen, fleet)),
        dangers=(),
        rollouts=tuple(one for one in held.rollouts if one["task"] not in chosen),
    )
    if names:
        return agree(view, plan)
    code = agree(replace(view, is_plan=True), plan)
    return EXIT_OK if code == EXIT_WOULD_CHANGE and not view.is_plan else code
