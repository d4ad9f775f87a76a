"""`zsched task hand`: a task of this cell goes to another one of the site, and is ready there in the end.

Knows: what an operator may ask for, what speaks against it, what is shown before. Does not know: the steps
(`zsched.commands.hand_steps`), how a document says that a task is on its way (`zsched.config.handing`).

Which step is done is asked of both cells: the command can be broken off at any point, and given again.
"""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from typing import Final

from zsched import paths as places
from zsched.clock import monotonic_s
from zsched.commands.apply import read_text
from zsched.commands.ask import door_of
from zsched.commands.common import CliError, Json, check_reason, nearest, told_task
from zsched.commands.document import InForce, document_text, in_force, status_of
from zsched.commands.hand_steps import (
    HandOrder,
    Side,
    Way,
    body_of,
    bring_back,
    by_file,
    check_steps,
    go_over,
    take_over,
    task_in,
    tell_end,
    text_with,
)
from zsched.commands.membership import fleet_of
from zsched.commands.orders import OrderView, Row, begin
from zsched.config.editing import names_of, remove_task, task_entry
from zsched.config.handing import Mark, mark_of, names_in
from zsched.config.load import check_bytes
from zsched.core.values.fleet import Fleet, TaskSpec
from zsched.core.values.model import NodeKind, TaskId
from zsched.core.values.struct import Struct, replace
from zsched.exits import EXIT_FAILED, EXIT_USAGE

NOT_LEASED: Final = "not yet for the fleet"
"""Of a task that has just become exclusive (`zsched.core.executor.sealing`)."""


class _Seen(Struct, frozen=True, kw_only=True):
    """What both documents say before this command does anything."""

    fleet: Fleet
    """Of this cell."""
    mark: Mark | None
    here: TaskSpec | None
    """The task in this cell's document."""
    there: TaskSpec | None
    """And in the other one's."""
    status: Json
    """Of this cell."""
    status_there: Json
    text: str
    """This cell's document."""
    text_there: str


def hand(order: HandOrder) -> int:
    """Hand a task over to another cell, or take it back; the exit code.

    Raises:
        CliError: it was not agreed to, a step was not agreed, or the other cell did not get it ready in time.
        ConfigError: a document would have faults.
    """
    check_reason(order.reason)
    held = in_force(order.door)
    text = document_text(held)
    fleet, mark = fleet_of(text), mark_of(text, order.task)
    here = Side(name=held.fleet, door=order.door)
    if order.cell == here.name and mark is None:
        _spec(fleet, order.task)
        return tell_end(
            order, here.name, here.name, "unchanged", f"{order.task} is a task of {here.name}: nothing to do"
        )
    if mark is not None and order.cell not in (here.name, mark.cell):
        told = f"{order.task} is on its way from {here.name} to {mark.cell}"
        raise CliError(EXIT_USAGE, f"{told}: name that one, or {here.name} to take it back")
    there = _other(text, order, order.cell if mark is None else mark.cell)
    way = Way(order=order, here=here, there=there, began=monotonic_s(), run=secrets.token_hex(4))
    if order.cell == here.name:
        return _asked_back(way)
    seen = _look(way, held, fleet, mark)
    if seen.mark is None and seen.here is None and seen.there is not None:
        said = f"{order.task} is a task of {there.name}, and none of {here.name}: nothing to do"
        return tell_end(order, here.name, there.name, "unchanged", said)
    way = _checked(way, seen)
    warning = f"Nobody does {order.task} from its end in {here.name} until it is ready in {there.name}."
    plan = body_of(order, here.name, there.name, "planned")
    view = OrderView(door=order.door, is_json=order.is_json, is_yes=order.is_yes, is_plan=order.is_plan)
    code = begin(view, tuple(_rows(way, seen)), plan, is_change=True, warning=warning if way.is_exclusive else "")
    return go_over(way) if code is None else code


# --- what is where ---------------------------------------------------------------------------------------------------


def _spec(fleet: Fleet, task: TaskId) -> TaskSpec:
    """A task of a fleet. Raises `CliError`: it has none of this name."""
    found = task_in(fleet, task)
    if found is None:
        known = [one.name for one in fleet.tasks]
        raise CliError(EXIT_USAGE, f"fleet {fleet.name} has no task {task!r}{nearest(task, known)}")
    return found


def _other(text: str, order: HandOrder, name: str) -> Side:
    """The other cell; what a secured one takes lies beside this machine's fleet file.

    Raises:
        CliError: the site has none of this name.
    """
    fleet = check_bytes(text.encode(), str(places.config_path(None, os.environ))).fleet
    assert fleet is not None  # it was read already
    cell = next((one for one in fleet.cells if one.name == name), None)
    if cell is None:
        known = [one.name for one in fleet.cells]
        hint = nearest(name, known) if known else f"; fleet {fleet.name} names no other under `site:`"
        if mark_of(text, order.task) is not None:
            hint = f", and {order.task} is on its way there; name it under `site:` again: zsched edit"
        raise CliError(EXIT_USAGE, f"the site has no cell {name!r}{hint}")
    here = None if order.door.endpoint else order.door
    return Side(name=name, door=door_of(cell, fleet.name, here))


def _look(way: Way, held: InForce, fleet: Fleet, mark: Mark | None) -> _Seen:
    there = in_force(way.there.door)
    if there.fleet != way.there.name:
        raise CliError(EXIT_FAILED, f"nothing was changed: the gateways of {way.there.name} are of fleet {there.fleet}")
    text = document_text(there)
    if mark is None and any(one["task"] == way.task for one in held.rollouts):
        advice = "zsched task promote, or apply the file of before"
        raise CliError(EXIT_FAILED, f"nothing was changed: a changed worker of {way.task} waits for a look; {advice}")
    return _Seen(
        text=held.text,
        fleet=fleet,
        mark=mark,
        here=task_in(fleet, way.task),
        there=task_in(fleet_of(text), way.task),
        status=status_of(way.here.door),
        status_there=status_of(way.there.door),
        text_there=text,
    )


def _checked(way: Way, seen: _Seen) -> Way:
    """The way with what the other cell is to have, once nothing speaks against it.

    Raises:
        CliError: there is no such task, or something does.
        ConfigError: a document would have faults.
    """
    there = way.there.name
    way = replace(way, entry="" if seen.here is None else task_entry(seen.text, way.task))
    is_exclusive_here = seen.here is None or seen.here.exclusive  # only an exclusive one is taken out before its end
    if seen.mark is None:
        _spec(seen.fleet, way.task)
        for status in (seen.status, seen.status_there):
            if not status["quorum"]["ok"]:
                raise CliError(EXIT_FAILED, f"nothing was changed: {status['fleet']} has no quorum now")
    if seen.there is not None:
        if seen.mark is None:
            advice = f"take one away by `zsched task remove {way.task}`, here or with --node {there}/GATEWAY"
            raise CliError(EXIT_FAILED, f"nothing was changed: {there} has a task {way.task} of its own; {advice}")
        is_exclusive = seen.there.exclusive or is_exclusive_here
        if is_exclusive and seen.here is not None:
            told = f"{way.task} is exclusive, and stands in the documents of both cells"
            raise CliError(EXIT_FAILED, f"{told}: `zsched task remove {way.task}` takes it out of one")
        if way.order.entry is not None:
            _check_same(way, seen)
        return replace(way, is_exclusive=is_exclusive)
    wanted = _wanted(way, seen)
    spec = _spec(fleet_of(text_with(way, seen.text_there, wanted)), way.task)
    if way.order.entry is not None and spec.exclusive != is_exclusive_here:
        told = f"nothing was changed: {way.task} is exclusive in one of the two cells, and not in the other"
        advice = "no lease's end would tell that nobody works on it; change that before or afterwards: zsched edit"
        raise CliError(EXIT_FAILED, f"{told}: {advice}")
    is_exclusive = spec.exclusive or is_exclusive_here
    if is_exclusive and seen.here is not None:
        _check_leased(way, seen.status)
    way = replace(way, wanted=wanted, is_exclusive=is_exclusive)
    check_steps(way, seen.text)
    return way


def _check_same(way: Way, seen: _Seen) -> None:
    """Refuse a file that says something else than the other cell's document, which has the task already."""
    text = text_with(way, remove_task(seen.text_there, way.task), _wanted(way, seen))
    if task_in(fleet_of(text), way.task) != seen.there:
        told = f"{way.there.name} has {way.task} already, by another entry than {way.order.entry}"
        raise CliError(EXIT_FAILED, f"{told}; give no --entry, and change it there afterwards: zsched edit")


def _wanted(way: Way, seen: _Seen) -> str:
    """The entry that the other cell is to have.

    Raises:
        CliError: it names nodes of this cell that the other one has not.
        ConfigError: the file holds something else.
    """
    file = way.order.entry
    kept = seen.mark.entry if seen.mark is not None else ""
    entry = read_text(file) if file is not None else way.entry or kept
    names = names_of(entry, "tasks", file or f"the comment in {way.here.name}'s document")
    if names != (way.task,):
        told = f"it holds {', '.join(names)}, and {way.task} alone is handed over"
        raise CliError(EXIT_USAGE, f"{file or 'the comment at the end of the document'}: {told}")
    if file is not None:
        return entry
    theirs = {node.name for node in fleet_of(seen.text_there).nodes}
    foreign = names_in(entry, [node.name for node in seen.fleet.nodes if node.name not in theirs])
    if foreign:
        told = f"nothing was changed: the entry of {way.task} names {', '.join(foreign)}, no nodes of {way.there.name}"
        raise CliError(EXIT_FAILED, f"{told}; {by_file(way)}")
    return entry


def _check_leased(way: Way, status: Json) -> None:
    """Refuse a task whose workers may still work without a lease: no lease's end proves then that they have stopped."""
    for task in status["tasks"]:
        for problem in task["problems"] if task["name"] == way.task else ():
            if NOT_LEASED in str(problem):
                raise CliError(EXIT_FAILED, f"nothing was changed: {way.task}: {problem}")


# --- what is shown ---------------------------------------------------------------------------------------------------


def _rows(way: Way, seen: _Seen) -> Iterator[Row]:
    """Before and after, as far as it can be told."""
    task, here, there = way.task, way.here.name, way.there.name
    now = told_task(seen.status, task)
    yield task, "cell", here if seen.mark is None else f"between {here} and {there}", there
    owner = str(now["owner"] or "nobody") if now else "nobody"
    names = fleet_of(text_with(way, seen.text_there, way.wanted) if way.wanted else seen.text_there)
    yield task, "owner", owner, f"one of {', '.join(_spec(names, task).candidates)}"
    robots = [", ".join(_robots(fleet)) or "nobody" for fleet in (seen.fleet, names)]
    yield task, "works for", robots[0] if now else "nobody", robots[1]
    if now:
        yield task, "state", "its worker's", "none: it begins anew"
        if orders := _orders(now):
            yield task, "orders", orders, "-"
        yield task, f"in {here}", "works", "stops first" if way.is_exclusive else f"works until {there} is ready"


def _robots(fleet: Fleet) -> list[str]:
    return [node.name for node in fleet.nodes if node.kind is NodeKind.ROBOT]


def _orders(task: Json) -> str:
    """What operators have ordered of the task, which stays behind."""
    pin = task.get("pin")
    pinned = f"pinned to {pin['node']}" if pin else ""
    tuned = task.get("file_tuning") is not None and task["file_tuning"] != task["tuning"]
    return ", ".join(filter(None, (pinned, "paused" if task.get("pause") else "", "tuned" if tuned else "")))


def _asked_back(way: Way) -> int:
    """The operator takes it back; the exit code."""
    order, here, there = way.order, way.here.name, way.there.name
    rows: tuple[Row, ...] = ((way.task, "cell", f"between {here} and {there}", here),)
    view = OrderView(door=order.door, is_json=order.is_json, is_yes=order.is_yes, is_plan=order.is_plan)
    code = begin(view, rows, body_of(order, there, here, "planned"), is_change=True)
    if code is not None:
        return code
    take_over(way)
    bring_back(way)
    owner = told_task(status_of(way.here.door), way.task).get("owner")
    return tell_end(order, there, here, "taken_back", f"{way.task} is a task of {here} as before", owner)
