"""`zsched restart`: has one worker stopped and started again, before and after first.

Knows: which node is meant, outcomes as exit codes. Does not know: how a worker is stopped.
"""

from __future__ import annotations

from zsched.commands.ask import ask_door
from zsched.commands.common import CliError, print_json, say
from zsched.commands.document import CODES
from zsched.commands.logs import worker_node
from zsched.commands.orders import OrderView, begin, check_said
from zsched.exits import EXIT_FAILED

SCHEMA = "zsched.restart/1"


def restart(view: OrderView, task: str, whose: str | None) -> int:
    """Ask the node to start its worker again; prints what it answers and returns the exit code.

    Raises:
        CliError: nobody answers, there is no such task or node (2), it was not agreed to (1, or 2 off a terminal), the
            node refuses (1), or does not tell what has become of it (5).
    """
    check_said(view)
    status = ask_door(view.door, {"verb": "status"})
    node = worker_node(status, task, whose)
    owner = next(known["owner"] for known in status["tasks"] if known["name"] == task)
    after = "started again; the task pauses until it is ready" if node == owner else "started again"
    workers = next(one["workers"] for one in status["nodes"] if one["name"] == node)
    state = next((str(worker["state"]) for worker in workers if worker["task"] == task), "-")
    rows = [(task, f"worker on {node}", state, after)]
    plan = {"schema": SCHEMA, "task": task, "node": node, "outcome": "planned", "detail": after}
    code = begin(view, rows, plan, is_change=True, warning=f"{node} owns {task}." if node == owner else "")
    if code is not None:
        return code
    answer = ask_door(view.door.to(node), {"verb": "restart", "task": task, **view.asked})
    outcome, detail = str(answer["outcome"]), str(answer["detail"])
    if view.is_json:
        print_json({"schema": SCHEMA, "task": task, "node": node, "outcome": outcome, "detail": detail})
    elif outcome == "ok":
        say(f"{task} on {node}: {detail}")
    else:
        advice = f"; it may or may not start again, see `zsched logs {task} {node}`" if outcome == "unknown" else ""
        raise CliError(CODES.get(outcome, EXIT_FAILED), f"{task} on {node}: {detail}{advice}")
    return CODES.get(outcome, EXIT_FAILED)
