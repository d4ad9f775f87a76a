"""`zsched wait`: asks again and again until a condition holds, and says what is missing when it does not in time.

Knows: the conditions, what a status must say for each. Does not know: how a status came about.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Annotated, Final

import typer

from zsched.commands.base.ask import Door, ask_door
from zsched.commands.base.common import CliError, Json, check_known, print_json, say, told_task
from zsched.commands.base.options import Answers
from zsched.commands.base.page import span
from zsched.commands.base.report import all_problems
from zsched.core.values.exits import EXIT_OK, EXIT_TIMED_OUT, EXIT_UNREACHABLE, EXIT_USAGE
from zsched.core.values.struct import Struct
from zsched.host.clock import monotonic_s

SCHEMA: Final = "zsched.wait/1"
PAUSE_S: Final = 0.5
"""Between two questions."""
FORMS: Final = "healthy, quorum, owner=TASK@NODE, settled=TASK, empty=NODE"
RESTING: Final = ("settled", "idle")
"""Phases of a handover in which nothing is under way."""


class Condition(Struct, frozen=True, kw_only=True):
    """What is waited for: ``kind`` and, where it has them, the ``task`` and the ``node``."""

    kind: str
    task: str = ""
    node: str = ""

    @property
    def is_of_all(self) -> bool:
        """Whether every robot must be asked: each knows of its own streams only."""
        return self.kind in ("settled", "empty")


def parse_condition(text: str) -> Condition:
    """The condition that ``text`` names.

    >>> parse_condition("owner=echo@edge1")
    Condition(kind='owner', task='echo', node='edge1')

    Raises:
        CliError: it names none.
    """
    kind, _, rest = text.partition("=")
    task, at, node = rest.partition("@")
    if text in ("healthy", "quorum"):
        return Condition(kind=kind)
    if kind == "owner" and task and node:
        return Condition(kind=kind, task=task, node=node)
    if kind == "settled" and task and not at:
        return Condition(kind=kind, task=task)
    if kind == "empty" and task and not at:
        return Condition(kind=kind, node=task)
    raise CliError(EXIT_USAGE, f"--until {text!r} is no condition; there are {FORMS}")


def missing(condition: Condition, statuses: Mapping[str, Json]) -> list[str]:
    """What the condition still lacks, by the statuses of the nodes that were asked; empty: it holds.

    The first status is that of the node that was asked first; it alone tells of quorum, owners and problems.
    """
    first = next(iter(statuses.values()))
    tasks = {str(task["name"]): task for task in first["tasks"]}
    if condition.task and condition.task not in tasks:  # it was taken out meanwhile, or this node is behind
        return [f"{condition.task}: {next(iter(statuses))} does not know it"]
    if condition.kind == "healthy":
        return all_problems(first)
    if condition.kind == "quorum":
        quorum = first["quorum"]
        lack = f"{quorum['alive']} of {quorum['electors']} electors can answer, {quorum['needed']} needed"
        return [] if quorum["ok"] else [lack]
    if condition.kind == "owner":
        owner = tasks[condition.task]["owner"]
        return [] if owner == condition.node else [f"{condition.task}: its owner is {owner or 'nobody'}"]
    if condition.kind == "settled":
        return [*_lack_of_owner(first, tasks[condition.task]), *_under_way(statuses, condition.task, "")]
    owned = [f"{name} is owned by {condition.node}" for name, task in tasks.items() if task["owner"] == condition.node]
    return owned or [lack for name in tasks for lack in _under_way(statuses, name, "the old owner may be in use: ")]


def _lack_of_owner(status: Json, task: Json) -> list[str]:
    name, owner = task["name"], task["owner"]
    if owner is None or task["owner_state"] != "alive":
        return [f"{name}: its owner is " + ("nobody" if owner is None else f"{owner}, {task['owner_state']}")]
    workers = [worker for node in status["nodes"] if node["name"] == owner for worker in node["workers"]]
    state = next((worker["state"] for worker in workers if worker["task"] == name), "unknown")
    return [] if state == "ready" else [f"{name}: the worker on {owner} is {state}"]


def _under_way(statuses: Mapping[str, Json], name: str, why: str) -> list[str]:
    """The nodes whose handover of a task is not over, or that know another owner than the first of them."""
    found, owner = [], None
    for node, status in statuses.items():
        task = told_task(status, name)
        if not task:
            if not why:  # who does not know a task has no stream of it, so none to an old owner either
                found.append(f"{name}: {node} has not learnt of it yet")
            continue
        owner = owner or task["owner"]
        if task["phase"] not in RESTING:
            found.append(f"{name}: {why}{node} is {task['phase']}")
        elif task["owner"] != owner:
            found.append(f"{name}: {node} takes {task['owner'] or 'nobody'} for the owner, not {owner}")
    return found


# --- the verb --------------------------------------------------------------------------------------------------------


def wait(
    asked: Answers,
    condition: Annotated[
        str,
        typer.Option("--until", metavar="CONDITION", help="healthy, quorum, owner=TASK@NODE, settled=TASK, empty=NODE"),
    ],
    timeout: Annotated[
        float, typer.Option("--timeout", min=0.0, max=86400.0, metavar="S", help="Seconds; 0: look once.")
    ] = 30.0,
) -> int:
    """Wait until a condition holds; say what is missing if it does not in time.

    Example: zsched wait --until healthy --timeout 60

    Exits with 5 when the time is over, with 3 when nobody answers then. A daemon that is not there yet is waited for.
    """
    wanted = parse_condition(condition)
    began = monotonic_s()
    while True:
        lacks: list[str] | CliError = _look(asked.door, wanted)
        waited_s = monotonic_s() - began
        is_over = waited_s + PAUSE_S > timeout
        if lacks == [] or is_over:
            break
        time.sleep(PAUSE_S)
    if isinstance(lacks, CliError):
        raise lacks
    if asked.json_:
        print_json({"schema": SCHEMA, "condition": condition, "met": not lacks, "waited_s": waited_s, "missing": lacks})
    else:
        say(f"{condition}: {'not met' if lacks else 'met'} after {span(waited_s)}")
        for lack in lacks:
            say(f"  {lack}", indent=4)
    return EXIT_TIMED_OUT if lacks else EXIT_OK


def _look(find: Callable[[], Door], condition: Condition) -> list[str] | CliError:
    """What is missing now; an error when nobody answers, which may be over soon.

    Raises:
        CliError: there is no such task or node (2).
    """
    try:
        door = find()
        first = ask_door(door, {"verb": "status"})
        check_known(first, "task", condition.task or None)
        check_known(first, "node", condition.node or None)
        statuses = {str(first["node"]): first}
        if condition.is_of_all:
            others = [node for node in first["nodes"] if node["kind"] == "robot" and node["state"] == "alive"]
            for other in others:
                name = str(other["name"])
                if name not in statuses:
                    statuses[name] = ask_door(door.to(name), {"verb": "status"})
    except CliError as error:
        if error.code == EXIT_USAGE:
            raise
        return CliError(EXIT_UNREACHABLE, str(error))
    return missing(condition, statuses)
