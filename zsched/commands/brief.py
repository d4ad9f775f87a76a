"""The short form of a status: a line per node, a line per task, and what is wrong (pure).

Knows: which figures an operator looks at first. Does not know: the stages in detail (`zsched.commands.report`).
"""

from __future__ import annotations

from typing import Any

from zsched.commands.page import (
    SINCE_START,
    Cell,
    Page,
    clock_time,
    missed_of,
    name_room,
    short_name,
    short_span,
    since_drop,
    span,
)
from zsched.commands.report import (
    STATE_STYLES,
    flag_rows,
    header,
    node_rows,
    per_second,
    told_hold,
    troubles,
)

Json = dict[str, Any]

SINCE_ROOM = 15
TITLES = ("TASK", "owner", "state", "since", "phase", "in", "out", "missed")
NO_TASK = "none yet; `zsched task add FILE` gives the fleet one"


def render_brief(status: Json, width: int, color: bool, at: float | None = None) -> str:
    """The short form; arguments as of `zsched.commands.report.render_status`."""
    page = Page(width, color, at)
    header(page, status)
    node_rows(page, status, "NODE")
    flag_rows(page, status)
    task_rows(page, status, at)
    _pin_rows(page, status)
    troubles(page, status)
    return "\n".join(page.lines) + "\n"


def task_rows(page: Page, status: Json, at: float | None) -> None:
    """Titles and a line per task; ``at``: now, for wall times beside ages."""
    tasks: list[Json] = status["tasks"]
    if not tasks:
        page.row((TITLES[0], page.indent - 1, "stage"), (NO_TASK, page.width, "dim"))
        return
    task_room = name_room(page.width, 10, *(len(task["name"]) for task in tasks))
    owner_room = name_room(page.width, 6, *(len(task["owner"] or "nobody") + len(_marks(task)) for task in tasks))
    columns = (task_room, owner_room, 8, SINCE_ROOM if at is not None else 6, 9, -7, -7, page.width)
    page.row(*((t, w, "dim" if i else "stage") for i, (t, w) in enumerate(zip(TITLES, columns, strict=True))))
    for task in tasks:
        cells = _cells(task, at, task_room, owner_room)
        page.row(*((text, wide, style) for (text, style), wide in zip(cells, columns, strict=True)))


def _pin_rows(page: Page, status: Json) -> None:
    """A line for each pin, with who asked and why; a pause is among the problems."""
    for task in status["tasks"]:
        if (pin := task.get("pin")) is not None:
            text = f"{task['name']}: pinned to {told_hold('pin', pin)}, known for {span(pin['known_s'])}"
            page.row((text, page.width, "yellow"))


def _cells(task: Json, at: float | None, task_room: int, owner_room: int) -> list[Cell]:
    marks, owner, since_s, state = _marks(task), task["owner"], task["since_s"], task["owner_state"]
    since = span(since_s)
    if at is not None and since_s is not None:
        since += f" {clock_time(at - since_s, at)}"
        if len(since) > SINCE_ROOM:  # of another day
            since = f"{short_span(since_s)} {clock_time(at - since_s, at)}"
    missed, is_new = _missed(task)
    return [
        (short_name(task["name"], task_room), "bold"),
        (short_name(owner or "nobody", owner_room - len(marks)) + marks, "bold" if owner else "red"),
        (state, STATE_STYLES.get(state, "red")),
        (since, ""),
        (str(task["phase"]), "" if task["phase"] in ("idle", "settled") else "yellow"),
        (_flow(task, "in"), ""),
        (_flow(task, "out"), ""),
        (missed, "yellow" if is_new else "dim"),
    ]


def _marks(task: Json) -> str:
    """What an operator has ordered, in a word each; both are later fields of the schema's major version."""
    pin = task.get("pin")
    where = "" if pin is None or pin["node"] in (None, task["owner"]) else f" {pin['node']}"
    return f"{'' if pin is None else f' (pin{where})'}{' (rollout)' if task.get('rollout') else ''}"


def _flow(task: Json, way: str) -> str:
    """How fast all of a task's inputs or outputs of the answering node flow together; ``-`` when that is not known."""
    told = [stream.get("hz") for stream in task["streams"] if f"/{way}/" in stream["stream"]]
    known = [hz for hz in told if hz is not None]
    return per_second(sum(known)) if known else "-"


def _missed(task: Json) -> tuple[str, bool]:
    """How many samples somebody may miss, when that is over, and whether it is not."""
    losers = [stream for stream in task["streams"] if missed_of(stream)]
    if not losers:
        return "-", False
    over = [since_drop(stream) for stream in losers]
    told = SINCE_START if set(over) == {SINCE_START} else " (none in the last minute)"
    return f"{sum(map(missed_of, losers))}{told if all(over) else ''}", not all(over)
