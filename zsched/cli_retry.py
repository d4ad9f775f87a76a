"""`zsched retry`: has a task's failures forgotten on every node that can be reached, and says where it was not.

Knows: whom to ask, outcomes as exit codes. Does not know: what a node remembers, or how a worker is started.
"""

from __future__ import annotations

import sys

from zsched.cli_ask import Door, ask_door
from zsched.cli_common import EXIT_FAILED, EXIT_OK, EXIT_TIMED_OUT, EXIT_USAGE, CliError, Json, nearest, print_json
from zsched.cli_page import harmless

SCHEMA = "zsched.retry/1"


def retry(door: Door, task: str, whose: str | None, *, is_json: bool) -> int:
    """Ask every node to forget; prints what each answered and returns the exit code.

    Raises:
        CliError: nobody answers, or there is no such task or node.
    """
    status = ask_door(door, {"verb": "status"})
    tasks = [str(known["name"]) for known in status["tasks"]]
    states = {str(known["name"]): str(known["state"]) for known in status["nodes"]}
    if task not in tasks:
        raise CliError(EXIT_USAGE, f"fleet {status['fleet']} has no task {task!r}{nearest(task, tasks)}")
    if whose is not None and whose not in states:
        raise CliError(EXIT_USAGE, f"fleet {status['fleet']} has no node {whose!r}{nearest(whose, list(states))}")
    done: dict[str, str] = {}
    missed: dict[str, str] = {}
    for node, state in states.items():
        if state not in ("alive", "suspect"):
            missed[node] = f"it is {state}"
            continue
        try:
            done[node] = _forget(door, node, task, whose)
        except CliError as error:
            missed[node] = str(error)
    if is_json:
        print_json({"schema": SCHEMA, "task": task, "node": whose, "done": done, "missed": missed})
    else:
        _print(task, done, missed)
    if not done:
        return EXIT_FAILED
    return EXIT_TIMED_OUT if missed else EXIT_OK


def _forget(door: Door, node: str, task: str, whose: str | None) -> str:
    answer = ask_door(Door(socket=door.socket, node=node), {"verb": "retry", "task": task, "whose": whose})
    if answer["outcome"] != "ok":
        raise CliError(EXIT_FAILED, str(answer["detail"]))
    return str(answer["detail"])


def _print(task: str, done: Json, missed: Json) -> None:
    for node, detail in done.items():
        sys.stdout.write(f"{task} on {node}: {harmless(detail)}\n")
    for node, why in missed.items():
        sys.stdout.write(f"{task} on {node}: not asked, {harmless(why)}\n")
