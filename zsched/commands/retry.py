"""`zsched retry`: has a task's failures forgotten on every node that can be reached, before and after first.

Knows: which daemon to ask, outcomes as exit codes. Does not know: what a node remembers, or how a worker is started.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial

from zsched.commands.ask import ask_door
from zsched.commands.common import CliError, Json, nearest, print_json, say
from zsched.commands.orders import OrderView, Row, begin, check_said
from zsched.exits import EXIT_FAILED, EXIT_OK, EXIT_TIMED_OUT, EXIT_USAGE

SCHEMA = "zsched.retry/1"
AT_ONCE = 8
"""Nodes asked at a time: one that is silent takes 3 s to be given up, and the socket has 16 places."""


def retry(view: OrderView, task: str, whose: str | None) -> int:
    """Ask every node to forget; prints what each answered and returns the exit code.

    Raises:
        CliError: nobody answers, there is no such task or node, or it was not agreed to.
    """
    check_said(view)
    status = ask_door(view.door, {"verb": "status"})
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
    plan: Json = {"schema": SCHEMA, "task": task, "node": whose, "done": {}, "missed": {}}
    code = begin(view, list(_rows(status, task, whose)), plan, is_change=True)
    if code is not None:
        return code
    done: dict[str, str] = {}
    missed: dict[str, str] = {}
    there = [node for node, state in states.items() if state in ("alive", "suspect")]
    missed.update((node, f"it is {state}") for node, state in states.items() if node not in there)
    with ThreadPoolExecutor(AT_ONCE) as errands:
        answers = errands.map(partial(_forget, view, task=task, whose=whose), there)
        for node, answer in zip(there, answers, strict=True):
            if isinstance(answer, CliError):
                missed[node] = str(answer)
            else:
                done[node] = answer
    if view.is_json:
        print_json({"schema": SCHEMA, "task": task, "node": whose, "done": done, "missed": missed})
    else:
        _print(task, done, missed)
    if not done:
        return EXIT_FAILED
    return EXIT_TIMED_OUT if missed else EXIT_OK


def worker_states(status: Json, task: str) -> dict[str, str]:
    """{node: how its worker of the task is}, of those that have one."""
    return {
        str(node["name"]): str(worker["state"])
        for node in status["nodes"]
        for worker in node["workers"]
        if worker["task"] == task
    }


def _rows(status: Json, task: str, whose: str | None) -> Iterator[Row]:
    """What is forgotten: workers that have failed start again, and the penalty for failures goes everywhere."""
    for node, state in worker_states(status, task).items():
        if whose in (None, node) and state == "failed":
            yield task, f"worker on {node}", state, "started again"
    yield task, f"failures of {whose or 'every node'}", "remembered", "forgotten"


def _forget(view: OrderView, node: str, *, task: str, whose: str | None) -> str | CliError:
    """What one node answers, or why it does not."""
    try:
        answer = ask_door(view.door.to(node), {"verb": "retry", "task": task, "whose": whose, **view.asked})
    except CliError as error:
        return error
    detail = str(answer["detail"])
    return detail if answer["outcome"] == "ok" else CliError(EXIT_FAILED, detail)


def _print(task: str, done: Json, missed: Json) -> None:
    for node, detail in done.items():
        say(f"{task} on {node}: {detail}")
    for node, why in missed.items():
        say(f"{task} on {node}: not asked, {why}")
