"""`zsched pause`, `resume`, `pin`, `unpin`: orders that last, and their end.

Knows: how they are shown before and after, when each robot knows them. Does not know: what a task does by them.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Final

from zsched.clock import monotonic_s
from zsched.commands.ask import Door, ask_door
from zsched.commands.common import CliError, Json, print_json, say
from zsched.commands.document import CODES, status_of
from zsched.commands.orders import (
    NOTHING,
    PAUSE_S,
    OrderView,
    Row,
    begin,
    check_name,
    check_said,
    refused,
    tell_results,
)
from zsched.commands.page import span
from zsched.commands.report import told_hold
from zsched.core.values.struct import Struct
from zsched.core.values.words import meant, shown
from zsched.exits import EXIT_FAILED, EXIT_OK, EXIT_TIMED_OUT, EXIT_USAGE

TASK_SCHEMA: Final = "zsched.task/1"
KNOWN_S: Final = 30.0
"""How long `pause --wait` may take."""


class HoldOrder(Struct, frozen=True, kw_only=True):
    """A pause or a pin, or the end of one: ``hold`` is the verb."""

    hold: str
    node: str | None = None
    is_hard: bool = False
    is_waiting: bool = False
    """Until every node that is alive knows it."""


def hold(view: OrderView, order: HoldOrder, names: Sequence[str], *, is_all: bool) -> int:
    """Give a lasting order about tasks, or list those that are in force; returns the exit code.

    Raises:
        CliError: nobody answers, there is no such task, it was not agreed to, or an order was not agreed.
    """
    check_said(view)
    status = status_of(view.door)
    known = {str(task["name"]): task for task in status["tasks"]}
    chosen = list(known) if is_all else list(dict.fromkeys(names))
    for name in chosen:
        check_name(status, "task", name, list(known))
    if order.node is not None:
        check_name(status, "node", order.node, [str(node["name"]) for node in status["nodes"]])
    # the daemon plans no pin, so a plan would say yes to what it refuses
    if order.node is not None and len(chosen) == 1 and order.node not in known[chosen[0]]["candidates"]:
        able = ", ".join(known[chosen[0]]["candidates"])
        detail = f"{order.node!r} is no candidate; there are {able}"
        raise refused(chosen[0], {"outcome": "invalid", "detail": detail})
    if not chosen:
        return _list_holds(view, order.hold, list(known.values()))
    if view.revision is not None and len(chosen) > 1:
        raise CliError(EXIT_USAGE, "--revision goes with one task")
    rows = [_hold_row(view, order, known[name]) for name in chosen]
    changing = [name for name in chosen if _is_change(view, order, known[name])]
    plans = [
        {**_held(known[row[0]]), "outcome": "planned" if row[0] in changing else "unchanged", "detail": row[3]}
        for row in rows
    ]
    body = {"schema": TASK_SCHEMA, "tasks": plans}
    code = begin(view, rows, body, is_change=bool(changing), warning=_warning(order))
    is_agreed = not changing and not view.is_plan
    if code is not None and not (order.is_waiting and is_agreed):
        return code
    results = _give_holds(view, order, [known[name] for name in changing])
    after = _tasks_now(view)
    # what an earlier order has agreed may be unknown somewhere, too
    held = {name: results.get(name, {**known[name], "outcome": "ok"}) for name in chosen}
    agreed = {name: int(one["revision"]) for name, one in held.items() if one["outcome"] == "ok"}
    lacks = _wait_known(view, agreed) if order.is_waiting else []
    late = EXIT_TIMED_OUT if lacks else EXIT_OK
    if view.is_json:
        # one that was taken out of the document meanwhile is told as it was
        now = [after.get(name, known[name]) for name in chosen]
        unchanged = {"outcome": "unchanged", "detail": ""}
        tasks = [{**_held(task), **results.get(str(task["name"]), unchanged)} for task in now]
        print_json({"schema": TASK_SCHEMA, "tasks": tasks, "missing": lacks})
        return max([late, *[CODES.get(str(result["outcome"]), EXIT_FAILED) for result in results.values()]])
    code = tell_results(results)
    for lack in lacks:
        say(f"  {lack}", indent=4)
    return max(code, late)


def _tasks_now(view: OrderView) -> dict[str, Json]:
    """{task: what the daemon says of it after the orders}, for programs; of one that is silent now: nothing.

    What was agreed is told all the same.
    """
    if not view.is_json:
        return {}
    try:
        return {str(task["name"]): task for task in status_of(view.door)["tasks"]}
    except CliError:
        return {}


def _wait_known(view: OrderView, revisions: Mapping[str, int]) -> list[str]:
    """Wait until every node that is alive has learnt what was agreed; what is missing when that takes too long."""
    began = monotonic_s()
    while True:
        lacks = _not_known(view.door, revisions)
        if not lacks or monotonic_s() - began >= KNOWN_S:
            return lacks
        time.sleep(PAUSE_S)


def _not_known(door: Door, revisions: Mapping[str, int]) -> list[str]:
    lacks = []
    try:
        first = status_of(door)
    except CliError as error:  # it may be beginning again
        return [str(error)]
    for node in [str(one["name"]) for one in first["nodes"] if one["state"] == "alive"]:
        try:
            status = first if node == first["node"] else status_of(door.to(node))
        except CliError as error:
            lacks.append(f"{node} does not answer: {error}")
            continue
        known = {str(task["name"]): int(task["revision"]) for task in status["tasks"]}
        late = [name for name, revision in revisions.items() if known.get(name, -1) < revision]
        lacks += [f"{node} has not learnt revision {shown(revisions[name])} of {name}" for name in late]
    return lacks


def _warning(order: HoldOrder) -> str:
    if order.hold == "pause":
        return "A dead owner will not be replaced."
    return "Without that node nobody does the task." if order.is_hard else ""


def _give_holds(view: OrderView, order: HoldOrder, tasks: Sequence[Json]) -> dict[str, Json]:
    """{task: what became of its order}; behind one that is agreed an error is the next one's result, and no end.

    Raises:
        CliError: the first one is refused, or nobody answers it.
    """
    results: dict[str, Json] = {}
    for task in tasks:
        try:
            result = _give_hold(view, order, task)
        except CliError as error:
            if not results:
                raise
            outcome = "invalid" if error.code == EXIT_FAILED else "unknown"
            result = {"outcome": outcome, "detail": str(error), "revision": None}
        results[str(task["name"])] = result
    return results


def _give_hold(view: OrderView, order: HoldOrder, task: Json) -> Json:
    request = {
        "verb": "hold",
        "hold": order.hold,
        "task": task["name"],
        "target": order.node,
        "hard": order.is_hard,
        "for_s": view.for_s,
        "base_revision": meant(view.revision, task["revision"]),
        **view.asked,
        "reason": _reason(view, order, task),
    }
    return ask_door(view.door, request)


def _kind(order: HoldOrder) -> str:
    return "pause" if order.hold in ("pause", "resume") else "pin"


def _ends(order: HoldOrder) -> bool:
    return order.hold in ("resume", "unpin")


def _known(order: HoldOrder, task: Json) -> Json | None:
    """The order in force that this one gives again, whoever has given it: the same pause, or pin to the same place."""
    held: Json | None = task.get(_kind(order))
    if held is None or order.hold == "pause":
        return held
    wanted = (order.node or task["owner"], order.is_hard)
    return held if (held["node"], held["is_hard"]) == wanted else None


def _reason(view: OrderView, order: HoldOrder, task: Json) -> str:
    """Why; an order that is given again without a reason keeps the one that it had."""
    known = None if _ends(order) or view.reason else _known(order, task)
    return view.reason if known is None else str(known["reason"])


def _is_change(view: OrderView, order: HoldOrder, task: Json) -> bool:
    """Whether it changes anything: a time that is given again begins anew (`zsched.commands.flags` judges so, too)."""
    if _ends(order):
        return task.get(_kind(order)) is not None
    known = _known(order, task)
    if known is None or view.for_s is not None or known["for_s"] is not None:
        return True
    return bool(known["reason"] != _reason(view, order, task))


def _hold_row(view: OrderView, order: HoldOrder, task: Json) -> Row:
    kind = _kind(order)
    before = _told(kind, task.get(kind))
    if _ends(order):
        after = NOTHING
    elif _is_change(view, order, task):
        wanted = {
            "node": (order.node or task["owner"]) if kind == "pin" else None,
            "is_hard": order.is_hard,
            "by": view.asked["by"],
            "reason": _reason(view, order, task),
            "for_s": view.for_s,
        }
        after = _told(kind, wanted)
    else:
        after = before
    return str(task["name"]), kind, before, after


def _told(kind: str, order: Json | None) -> str:
    return NOTHING if order is None else told_hold(kind, order)


def _held(task: Json) -> Json:
    return {key: task.get(key) for key in ("owner", "revision", "pause", "pin")} | {"task": task["name"]}


def _list_holds(view: OrderView, verb: str, tasks: Sequence[Json]) -> int:
    """The orders of one kind that are in force."""
    verb = {"resume": "pause", "unpin": "pin"}.get(verb, verb)
    held = [task for task in tasks if task.get(verb) is not None]
    if view.is_json:
        print_json({"schema": TASK_SCHEMA, "tasks": [_held(task) for task in held]})
        return EXIT_OK
    if not held:
        say(f"no task is {verb}{'ned' if verb == 'pin' else 'd'}")
    for task in held:
        age = span(task[verb]["known_s"])
        say(f"{task['name']}: {told_hold(verb, task[verb])}, known for {age}")
    return EXIT_OK
