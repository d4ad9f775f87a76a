"""`zsched restart`: has one worker stopped and started again.

Knows: which node is meant. Does not know: how a worker is stopped.
"""

from __future__ import annotations

from typing import Annotated

import typer

from zsched.commands.base.ask import ask_door
from zsched.commands.base.change import CODES, Plan, consent, status_of
from zsched.commands.base.common import CliError, Json, print_json, say, told_task
from zsched.commands.base.options import Consents, TaskArgument
from zsched.commands.look.logs import worker_node
from zsched.core.values.exits import EXIT_FAILED

SCHEMA = "zsched.restart/1"


def restart(
    said: Consents,
    task: TaskArgument,
    whose: Annotated[str | None, typer.Argument(metavar="[NODE]", help="Whose worker; without it the owner's.")] = None,
) -> int:
    """Stop a task's worker and start it again, also one that has failed for good; that counts as no failure.

    Example: zsched restart map_merge edge1

    The task pauses meanwhile if it is the owner's.
    """
    view = said.order()
    status = status_of(view.door)
    node = worker_node(status, task, whose)
    is_owner = told_task(status, task)["owner"] == node
    after = f"started again{'; the task pauses until it is ready' if is_owner else ''}"
    workers = [worker for one in status["nodes"] if one["name"] == node for worker in one["workers"]]
    state = next((str(worker["state"]) for worker in workers if worker["task"] == task), "-")

    def body(outcome: str, detail: str) -> Json:
        return {"schema": SCHEMA, "task": task, "node": node, "outcome": outcome, "detail": detail}

    rows = [(task, f"worker on {node}", state, after)]
    plan = Plan(rows=rows, body=body("planned", after), warning=f"{node} owns {task}." if is_owner else "")
    code = consent(view, plan)
    if code is not None:
        return code
    answer = ask_door(view.door.to(node), {"verb": "restart", "task": task, **view.asked})
    outcome, detail = str(answer["outcome"]), str(answer["detail"])
    if view.is_json:
        print_json(body(outcome, detail))
    elif outcome == "ok":
        say(f"{task} on {node}: {detail}")
    else:
        advice = f"; it may or may not start again, see `zsched logs {task} {node}`" if outcome == "unknown" else ""
        raise CliError(CODES.get(outcome, EXIT_FAILED), f"{task} on {node}: {detail}{advice}")
    return CODES.get(outcome, EXIT_FAILED)
