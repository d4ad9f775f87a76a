"""`zsched maint`: every order that is in force.

Knows: where a status tells them. Does not know: how one is given.
"""

from __future__ import annotations

from typing import Final

from zsched.commands.ask import Door
from zsched.commands.common import Json, print_json, say
from zsched.commands.document import status_of
from zsched.commands.orders import show_rows
from zsched.commands.page import span
from zsched.commands.report import FLAGS, told_flag, told_hold, told_rollout
from zsched.exits import EXIT_OK

MAINT_SCHEMA: Final = "zsched.maint/1"
ROLLOUT: Final = "rollout"


def maint(door: Door, *, is_json: bool) -> int:
    """List every order that is in force, of tasks and of nodes, and every node that stops; returns the exit code.

    Raises:
        CliError: nobody answers.
    """
    status = status_of(door)
    found = [
        {"kind": kind, "subject": task["name"], **task[kind]}
        for task in status["tasks"]
        for kind in ("pause", "pin")
        if task.get(kind) is not None
    ]
    found += [
        {"kind": flag["kind"], "subject": node["name"], "node": None, "is_hard": False, **flag}
        for node in status["nodes"]
        for flag in node.get("flags", ())
    ]
    found += [
        {"kind": ROLLOUT, "subject": task["name"], "for_s": None, "node": None, "is_hard": False, **task[ROLLOUT]}
        for task in status["tasks"]
        if task.get(ROLLOUT) is not None
    ]
    stopping = [str(node["name"]) for node in status["nodes"] if node["draining"] and node["state"] == "alive"]
    if is_json:
        print_json({"schema": MAINT_SCHEMA, "node": status["node"], "orders": found, "stopping": stopping})
        return EXIT_OK
    rows = [
        (
            str(order["subject"]),
            str(order["kind"]),
            _told_order(order),
            f"known for {span(order['known_s'])}",
        )
        for order in found
    ]
    rows += [(name, "stopping", "hands its tasks over and takes none", "") for name in stopping]
    if not rows:
        say(f"no order is in force, as {status['node']} knows")
    show_rows(("WHAT", "KIND", "ORDER", "SINCE"), rows)
    return EXIT_OK


def _told_order(order: Json) -> str:
    kind = str(order["kind"])
    if kind == ROLLOUT:
        return told_rollout(order)
    return told_flag(order) if kind in FLAGS else told_hold(kind, order)
