"""`zsched move`: hands a task over, and watches until its streams have settled.

Knows: what is watched, and for how long. Does not know: how a move is agreed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Final

import typer

from zsched.commands.base.ask import Door, ask_door
from zsched.commands.base.change import (
    Plan,
    agreed,
    consent,
    counted_before,
    lost_since,
    status_of,
    statuses_of,
    told_switch,
    until,
)
from zsched.commands.base.common import CliError, Json, check_known, print_json, say, told_task
from zsched.commands.base.options import Orders, TaskArgument
from zsched.commands.base.page import span
from zsched.commands.look.wait import Condition, missing
from zsched.core.values.exits import EXIT_FAILED, EXIT_OK, EXIT_TIMED_OUT
from zsched.core.values.words import meant, shown
from zsched.host.clock import monotonic_s

MOVE_SCHEMA: Final = "zsched.move/1"
GAP_S: Final = 3.0
"""How long a settled move is watched for the new owner's first answers; the relays count once a second."""
KNOWN_S: Final = 3.0
"""How long a daemon that has just begun may take to hear a living node's profile; nodes publish once a second."""
BLANK: Final = dict.fromkeys(("switched_s", "gap_s", "lost", "doubled"))


def move(
    said: Orders,
    task: TaskArgument,
    to: Annotated[str, typer.Argument(metavar="NODE", help="A candidate of the task.")],
    origin: Annotated[str | None, typer.Option("--from", metavar="NODE", help="Only if this is the owner.")] = None,
    detach: Annotated[bool, typer.Option("--detach", help="Do not wait until the streams have settled.")] = False,
    timeout: Annotated[float, typer.Option(min=0.0, max=3600.0, metavar="S", help="Seconds to wait.")] = 30.0,
) -> int:
    """Hand a task over to a node, and wait until its streams have settled there.

    Example: zsched move map_merge edge2 -m "new lens on edge1"

    It does not pin: the fleet may move the task again when it has reason to. Exits with 5 when it has not settled in
    time; it goes on all the same.
    """
    view = said.order()
    status = _once_it_is_known(view.door, to)
    check_known(status, "task", task)
    check_known(status, "node", to)
    before = told_task(status, task)
    left, base = before["owner"], meant(view.revision, before["revision"])
    request = {"verb": "move", "task": task, "target": to, "origin": origin, "base_revision": base, **view.asked}
    planned = agreed(task, ask_door(view.door, {**request, "plan": True}))

    def body(revision: int, **more: Any) -> Json:
        head = {"schema": MOVE_SCHEMA, "task": task, "from": left, "to": to, "epoch": None, "revision": revision}
        return {**head, "settled": False, **BLANK, "missing": [], **more}

    row = (task, "owner", str(left or "nobody"), to)
    code = consent(view, Plan(rows=[row], body=body(before["revision"]), is_change=planned["outcome"] == "ok"))
    if code is not None:
        return code
    known = counted_before(view.door, status)
    revision = int(agreed(task, ask_door(view.door, request))["revision"])
    end = _End(task, to, revision)
    if not detach:
        if not view.is_json:
            say("It is agreed. Ctrl-C ends the watching, not the move.")
        until(lambda: end.look(view.door), timeout)
    measured = end.measured(known)
    if view.is_json:
        print_json(body(revision, settled=bool(end.found) and not end.lacks, **measured, missing=end.lacks))
    else:
        end.tell(timeout, measured)
    return EXIT_FAILED if end.has_left else EXIT_TIMED_OUT if end.lacks else EXIT_OK


def _once_it_is_known(door: Door, target: str) -> Json:
    """The status, as soon as it has a profile of the target, if that node lives; after `KNOWN_S` as it is."""
    status, is_old = status_of(door), False

    def awaited() -> list[str]:
        nonlocal status, is_old
        status, is_old = status_of(door) if is_old else status, True
        nodes = [one for one in status["nodes"] if one["name"] == target]
        return [target for one in nodes if one["state"] == "alive" and one["cpu_cores"] is None]

    until(awaited, KNOWN_S)
    return status


class _End:
    """How a move stands: every robot's status, and what is missing yet."""

    def __init__(self, task: str, node: str, revision: int) -> None:
        self._task, self._node, self._revision = task, node, revision
        self._settled_at: float | None = None
        self.found: dict[str, Json] = {}
        self.lacks: list[str] = []
        self.has_left = False
        """The task is with another owner since, or with nobody; `lacks` says so."""

    def look(self, door: Door) -> list[str]:
        """What it is watched for yet; a node that does not answer now is asked again."""
        try:
            first = status_of(door)
        except CliError as error:
            self.lacks = [str(error)]
            raise
        self.found, silent = statuses_of(door, first)
        self.lacks = [*missing(Condition(kind="settled", task=self._task), self.found), *silent.values()]
        task = told_task(first, self._task)
        if task and task["revision"] < self._revision:
            self.lacks.append(f"{self._task}: {first['node']} has not learnt revision {shown(self._revision)}")
        elif task and task["owner"] != self._node:
            owner = f"{task['owner'] or 'nobody'} owns it (epoch {shown(task['epoch'])})"
            self.lacks, self.has_left = [f"{self._task}: {owner}; `zsched history` tells why"], True
            return []
        now = monotonic_s()
        self._settled_at = None if self.lacks else self._settled_at or now
        is_early = self._settled_at is not None and now - self._settled_at < GAP_S
        return self.lacks or (unmeasured(self.found, self._task) if is_early else [])

    def measured(self, before: Mapping[str, Json]) -> Json:
        """What the robots have measured of it."""
        tasks = [task for status in self.found.values() if (task := told_task(status, self._task))]

        def most(key: str) -> Any:
            return max((task[key] for task in tasks if task.get(key) is not None), default=None)

        told = {key: most(key) for key in ("epoch", "switched_s", "gap_s")}
        return {**told, **lost_since(before, self.found, self._task)}

    def tell(self, timeout_s: float, measured: Json) -> None:
        """Say it to people."""
        name = self._task
        if self.lacks:
            what = f"it was given to {self._node}, and has left it again"
            say(f"{name}: {what if self.has_left else f'not settled after {span(timeout_s)}'}")
            for lack in self.lacks:
                say(f"  {lack}", indent=4)
            if not self.has_left:
                say("the move stands; `zsched status` on such a node names what it waits for")
        elif not self.found:
            say(f"{name}: revision {shown(self._revision)} is agreed; `zsched wait --until settled={name}`")
        else:
            took = told_switch(measured["switched_s"], measured["gap_s"], measured)
            say(f"{name}: settled on {self._node}{took}")


def unmeasured(statuses: Mapping[str, Json], name: str) -> list[str]:
    """The robots at which answers flow, and the new owner's first one is not told yet."""
    tasks = {node: told_task(status, name) for node, status in statuses.items()}
    return [
        node
        for node, task in tasks.items()
        if task and task.get("gap_s") is None and any(one.get("gap_s") is not None for one in task["streams"])
    ]
