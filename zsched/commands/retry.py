"""`zsched retry`: has a task's failures forgotten on every node that can be reached, and says where it was not.

Knows: which daemon to ask, outcomes as exit codes. Does not know: what a node remembers, or how a worker is started.
"""

from __future__ import annotations

import sys
from concurrent.futures import ThreadPoolExecutor
from functools import partial

from zsched.commands.ask import Door, ask_door
from zsched.commands.common import CliError, Json, nearest, print_json
from zsched.commands.page import harmless
from zsched.exits import EXIT_FAILED, EXIT_OK, EXIT_TIMED_OUT, EXIT_USAGE

SCHEMA = "zsched.retry/1"
AT_ONCE = 8
"""Nodes asked at a time: one that is silent takes 3 s to be given up, and the socket has 16 places."""


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
    able = next(list(known["candidates"]) for known in status["tasks"] if known["name"] == task)
    able += [str(node["name"]) for node in status["nodes"] if task in (one["task"] for one in node["workers"])]
    if whose is not None and whose not in able:
        known = ", ".join(dict.fromkeys(able))
        raise CliError(EXIT_USAGE, f"{whose} is no candidate of {task} and has no worker of it; there are: {known}")
    done: dict[str, str] = {}
    missed: dict[str, str] = {}
    there = [node for node, state in states.items() if state in ("alive", "suspect")]
    missed.update((node, f"it is {state}") for node, state in states.items() if node not in there)
    with ThreadPoolExecutor(AT_ONCE) as errands:
        answers = errands.map(partial(_forget, door, task=task, whose=whose), there)
        for node, answer in zip(there, answers, strict=True):
            if isinstance(answer, CliError):
                missed[node] = str(answer)
            else:
                done[node] = answer
    if is_json:
        print_json({"schema": SCHEMA, "task": task, "node": whose, "done": done, "missed": missed})
    else:
        _print(task, done, missed)
    if not done:
        return EXIT_FAILED
    return EXIT_TIMED_OUT if missed else EXIT_OK


def _forget(door: Door, node: str, *, task: str, whose: str | None) -> str | CliError:
    """What one node answers, or why it does not."""
    try:
        answer = ask_door(Door(socket=door.socket, node=node), {"verb": "retry", "task": task, "whose": whose})
    except CliError as error:
        return error
    detail = str(answer["detail"])
    return detail if answer["outcome"] == "ok" else CliError(EXIT_FAILED, detail)


def _print(task: str, done: Json, missed: Json) -> None:
    for node, detail in done.items():
        sys.stdout.write(f"{task} on {node}: {harmless(detail)}\n")
    for node, why in missed.items():
        sys.stdout.write(f"{task} on {node}: not asked, {harmless(why)}\n")
