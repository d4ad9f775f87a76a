"""`zsched restart`: has one worker stopped and started again, after asking where that interrupts the task.

Knows: which node is meant, when to ask, outcomes as exit codes. Does not know: how a worker is stopped.
"""

from __future__ import annotations

import sys

from zsched.commands.ask import Door, ask_door
from zsched.commands.common import CliError, print_json
from zsched.commands.logs import worker_node
from zsched.commands.page import harmless
from zsched.exits import EXIT_FAILED, EXIT_OK, EXIT_USAGE

SCHEMA = "zsched.restart/1"


def restart(door: Door, task: str, whose: str | None, *, is_sure: bool, is_json: bool) -> int:
    """Ask the node to start its worker again; prints what it answers and returns the exit code.

    Raises:
        CliError: nobody answers, there is no such task or node (2), the owner's worker is meant and nobody said yes
            (1, or 2 off a terminal), or the node refuses (1).
    """
    status = ask_door(door, {"verb": "status"})
    node = worker_node(status, task, whose)
    owner = next(known["owner"] for known in status["tasks"] if known["name"] == task)
    if node == owner and not is_sure:
        _ask(task, node)
    answer = ask_door(Door(socket=door.socket, node=node), {"verb": "restart", "task": task})
    outcome, detail = str(answer["outcome"]), str(answer["detail"])
    if is_json:
        print_json({"schema": SCHEMA, "task": task, "node": node, "outcome": outcome, "detail": detail})
    elif outcome == "ok":
        sys.stdout.write(harmless(f"{task} on {node}: {detail}") + "\n")
    else:
        raise CliError(EXIT_FAILED, f"{task} on {node}: {detail}")
    return EXIT_OK if outcome == "ok" else EXIT_FAILED


def _ask(task: str, node: str) -> None:
    """Let the operator decide: the task pauses while its owner's worker starts."""
    command = f"zsched restart {task} {node} --yes"
    if not sys.stdin.isatty():
        raise CliError(EXIT_USAGE, f"{node} owns {task}, which pauses meanwhile; if that may be: {command}")
    sys.stderr.write(f"{node} owns {task}, which pauses until its worker is ready again. Restart it? [y/N] ")
    sys.stderr.flush()
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        raise CliError(EXIT_FAILED, "nothing was done")
