"""`zsched move`: hands a task over, and watches until its streams have settled.

Knows: what is watched, and for how long. Does not know: how a move is agreed.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Final, NamedTuple

from zsched.clock import monotonic_s
from zsched.commands.ask import Door, ask_door
from zsched.commands.common import CliError, Json, print_json, say, told_task
from zsched.commands.document import status_of
from zsched.commands.orders import (
    PAUSE_S,
    OrderView,
    begin,
    check_name,
    check_said,
    lost_since,
    refused,
    statuses_of,
    tell_uncounted,
    told_losses,
)
from zsched.commands.page import span
from zsched.commands.report import millis
from zsched.commands.wait import Condition, missing
from zsched.core.values.struct import Struct
from zsched.core.values.words import meant, shown
from zsched.exits import EXIT_FAILED, EXIT_OK, EXIT_TIMED_OUT

MOVE_SCHEMA: Final = "zsched.move/1"
GAP_S: Final = 3.0
"""How long a settled move is watched for the new owner's first answers; the relays count once a second."""
KNOWN_S: Final = 3.0
"""How long a daemon that has just begun may take to hear a living node's profile; nodes publish once a second."""


class MoveOrder(Struct, frozen=True, kw_only=True):
    """A handover to a named node."""

    task: str
    node: str
    origin: str | None = None
    is_detached: bool = False
    timeout_s: float = 30.0


def move(view: OrderView, order: MoveOrder) -> int:
    """Hand a task over and wait until its streams have settled; returns the exit code.

    Raises:
        CliError: nobody answers, there is no such task or node, or the move is refused.
    """
    check_said(view)
    status = _once_it_is_known(view.door, order.node)
    known = {str(task["name"]): task for task in status["tasks"]}
    check_name(status, "task", order.task, list(known))
    check_name(status, "node", order.node, [str(node["name"]) for node in status["nodes"]])
    task = known[order.task]
    request = {
        "verb": "move",
        "task": order.task,
        "target": order.node,
        "origin": order.origin,
        "base_revision": meant(view.revision, task["revision"]),
        **view.asked,
    }
    plan = ask_door(view.door, {**request, "plan": True})
    if plan["outcome"] not in ("ok", "unchanged"):
        raise refused(order.task, plan)
    row = (order.task, "owner", str(task["owner"] or "nobody"), order.node)
    body: Json = {"schema": MOVE_SCHEMA, "task": order.task, "from": task["owner"], "to": order.node, "epoch": None}
    body |= {"revision": task["revision"], "settled": False, "switched_s": None, "gap_s": None}
    body |= {"lost": None, "doubled": None}
    code = begin(view, [row], {**body, "missing": []}, is_change=plan["outcome"] == "ok")
    if code is not None:
        return code
    before, silent = _robots(view.door, status)
    tell_uncounted(silent)
    result = ask_door(view.door, request)
    if result["outcome"] not in ("ok", "unchanged"):
        raise refused(order.task, result)
    watch = not order.is_detached
    if watch and not view.is_json:
        say("It is agreed. Ctrl-C ends the watching, not the move.")
    end = _watch(view.door, order, int(result["revision"])) if watch else _End({}, [])
    return _tell_move(view, order, str(task["owner"] or ""), result, before, end)


def _once_it_is_known(door: Door, target: str) -> Json:
    """The status, as soon as it has a profile of the target, if that node lives; after `KNOWN_S` as it is."""
    began = monotonic_s()
    while True:
        status = status_of(door)
        node = next((node for node in status["nodes"] if node["name"] == target), None)
        is_awaited = node is not None and node["state"] == "alive" and node["cpu_cores"] is None
        if not is_awaited or monotonic_s() - began >= KNOWN_S:
            return status
        time.sleep(PAUSE_S)


class _End(NamedTuple):
    """How a move stands: every robot's status, and what is missing yet."""

    found: dict[str, Json]
    lacks: list[str]
    has_left: bool = False
    """The task is with another owner since, or with nobody; `lacks` says so."""


def _watch(door: Door, order: MoveOrder, revision: int) -> _End:
    """How the move stands once it is over, or the time is."""
    began, settled_at = monotonic_s(), None
    while True:
        end = _look(door, order, revision)
        now = monotonic_s()
        settled_at = (settled_at or now) if not end.lacks else None
        is_measured = settled_at is not None and (not unmeasured(end.found, order.task) or now - settled_at >= GAP_S)
        if is_measured or end.has_left or now - began >= order.timeout_s:
            return end
        time.sleep(PAUSE_S)


def _look(door: Door, order: MoveOrder, revision: int) -> _End:
    """How the move stands; a node that does not answer now is asked again."""
    try:
        first = status_of(door)
    except CliError as error:
        return _End({}, [str(error)])
    found, silent = _robots(door, first)
    lacks = missing(Condition(kind="settled", task=order.task), {str(first["node"]): first, **found})
    task = told_task(first, order.task)
    if task and task["revision"] < revision:
        lacks.append(f"{order.task}: {first['node']} has not learnt revision {shown(revision)}")
    elif task and task["owner"] != order.node:
        owner = f"{task['owner'] or 'nobody'} owns it (epoch {shown(task['epoch'])})"
        return _End(found, [f"{order.task}: {owner}; `zsched history` tells why"], has_left=True)
    return _End(found, [*lacks, *silent.values()])


def unmeasured(statuses: Mapping[str, Json], name: str) -> list[str]:
    """The robots at which answers flow, and the new owner's first one is not told yet."""
    found = []
    for node, status in statuses.items():
        task = told_task(status, name)
        if not task:
            continue
        flows = [stream for stream in task["streams"] if stream.get("gap_s") is not None]
        if flows and task.get("gap_s") is None:
            found.append(node)
    return found


def _robots(door: Door, status: Json) -> tuple[dict[str, Json], dict[str, str]]:
    """As `statuses_of`, of all robots that are alive."""
    alive = [str(node["name"]) for node in status["nodes"] if node["kind"] == "robot" and node["state"] == "alive"]
    return statuses_of(door, status, alive)


def _tell_move(
    view: OrderView,
    order: MoveOrder,
    left: str,
    result: Json,
    before: Mapping[str, Json],
    end: _End,
) -> int:
    found, lacks = end.found, end.lacks
    tasks = [task for status in found.values() for task in status["tasks"] if task["name"] == order.task]
    switched = [task["switched_s"] for task in tasks if task.get("switched_s") is not None]
    switched_s = max(switched, default=None)
    gap_s = max([task["gap_s"] for task in tasks if task.get("gap_s") is not None], default=None)
    losses = lost_since(before, found, order.task)
    epoch = max([int(task["epoch"]) for task in tasks], default=None)
    if view.is_json:
        body = {"schema": MOVE_SCHEMA, "task": order.task, "from": left or None, "to": order.node, "epoch": epoch}
        body |= {"revision": result["revision"], "settled": bool(found) and not lacks, "switched_s": switched_s}
        body |= {"gap_s": gap_s}
        print_json({**body, **losses, "missing": list(lacks)})
    elif end.has_left:
        say(f"{order.task}: it was given to {order.node}, and has left it again")
        for lack in lacks:
            say(f"  {lack}", indent=4)
    elif lacks:
        say(f"{order.task}: not settled after {span(order.timeout_s)}")
        for lack in lacks:
            say(f"  {lack}", indent=4)
        say("the move stands; `zsched status` on such a node names what it waits for")
    elif not found:
        say(f"{order.task}: revision {shown(result['revision'])} is agreed; `zsched wait --for settled={order.task}`")
    else:
        took = "" if switched_s is None else f", streams switched in {millis(switched_s)}"
        took += "" if gap_s is None else f", answers at most {millis(gap_s)} apart"
        say(f"{order.task}: settled on {order.node}{took}{told_losses(losses)}")
    if end.has_left:
        return EXIT_FAILED
    return EXIT_TIMED_OUT if lacks else EXIT_OK
