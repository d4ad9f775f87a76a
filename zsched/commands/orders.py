"""`zsched move`, `pin`, `pause`, `tune` and `maint`: shows what an order changes, asks, gives it, and says what came.

Knows: how an order is shown before and after, who gives it, outcomes as exit codes. Does not know: how a change is
agreed, what a task does by it.
"""

from __future__ import annotations

import os
import pwd
import shlex
import socket
import sys
import time
from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import Any, Final

from zsched.clock import monotonic_s
from zsched.commands.ask import Door, ask_door
from zsched.commands.common import CliError, Json, check_reason, nearest, print_json, say, says_yes
from zsched.commands.page import span
from zsched.commands.report import FLAGS, millis, told_flag, told_hold, told_rollout
from zsched.commands.wait import Condition, missing
from zsched.commands.weight_words import NAMES, shares
from zsched.core.values.fleet import TUNED_LINKS, TUNED_RULES
from zsched.core.values.model import MAX_FOR_S, Aggregate, PairReading, Reach, ScoreForm, Tuning, Weights
from zsched.core.values.struct import Struct, replace
from zsched.core.values.words import MAX_ASKER
from zsched.exits import EXIT_DEGRADED, EXIT_FAILED, EXIT_OK, EXIT_TIMED_OUT, EXIT_USAGE, EXIT_WOULD_CHANGE
from zsched.screen import harmless

MOVE_SCHEMA: Final = "zsched.move/1"
TASK_SCHEMA: Final = "zsched.task/1"
TUNING_SCHEMA: Final = "zsched.tuning/1"
MAINT_SCHEMA: Final = "zsched.maint/1"
PAUSE_S: Final = 0.2
"""Between two looks at a move."""
KNOWN_S: Final = 30.0
"""How long `pause --wait` may take."""
GAP_S: Final = 3.0
"""How long a settled move is watched for the new owner's first answers; the relays count once a second."""
CODES: Final = {
    "ok": EXIT_OK,
    "unchanged": EXIT_OK,
    "conflict": EXIT_FAILED,
    "no_quorum": EXIT_DEGRADED,
    "invalid": EXIT_FAILED,
    "unknown": EXIT_TIMED_OUT,
}
ADVICE: Final = {
    "conflict": "; look at `zsched status`, then try again",
    "no_quorum": "; nothing was changed, and `zsched status` shows which electors are away",
    "unknown": "; it may or may not have been agreed: `zsched status` shows which",
}
NOTHING: Final = "-"
ROLLOUT: Final = "rollout"
Row = tuple[str, str, str, str]
"""(task, what, before, after)."""


class OrderView(Struct, frozen=True, kw_only=True):
    """Which daemon to ask, and what the operator has said beside the order itself."""

    door: Door
    is_json: bool = False
    is_yes: bool = False
    is_plan: bool = False
    reason: str = ""
    revision: int | None = None
    for_s: float | None = None

    @property
    def asked(self) -> Json:
        """Who gives the order, as a request carries it."""
        return {"by": asker(self.door), "reason": self.reason}


def asker(door: Door) -> str:
    """user@node of the person that runs this program, as orders carry it; in another cell user@fleet/node."""
    place = door.asked_from or door.socket.stem or socket.gethostname()  # no daemon of this machine is asked
    return f"{user_name()}@{place}"[:MAX_ASKER]


def user_name(env: Mapping[str, str] = os.environ) -> str:
    """The user that runs this program; under sudo the caller.

    >>> user_name({"SUDO_USER": "ada"}) if os.getuid() == 0 else "ada"
    'ada'
    """
    uid = os.getuid()
    if uid == 0 and env.get("SUDO_USER"):
        return env["SUDO_USER"]
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return str(uid)


def check_said(view: OrderView) -> None:
    """Refuse a reason or a duration that no order can carry.

    Raises:
        CliError: one is too long, or the reason is not one line.
    """
    check_reason(view.reason)
    if view.for_s is not None and not 1.0 <= view.for_s <= MAX_FOR_S:
        raise CliError(EXIT_USAGE, f"--for: {span(view.for_s)} is not from 1s to 366d")


# --- pause, resume, pin, unpin ---------------------------------------------------------------------------------------


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
    status = _status(view.door)
    known = {str(task["name"]): task for task in status["tasks"]}
    chosen = list(known) if is_all else list(dict.fromkeys(names))
    for name in chosen:
        _check_name(status, "task", name, list(known))
    if order.node is not None:
        _check_name(status, "node", order.node, [str(node["name"]) for node in status["nodes"]])
    if not chosen:
        return _list_holds(view, order.hold, list(known.values()))
    if view.revision is not None and len(chosen) > 1:
        raise CliError(EXIT_USAGE, "--revision goes with one task")
    rows = [_hold_row(view, order, known[name]) for name in chosen]
    changing = [row[0] for row in rows if row[2] != row[3]]
    plans = [
        {**_held(known[row[0]]), "outcome": "planned" if row[0] in changing else "unchanged", "detail": row[3]}
        for row in rows
    ]
    body = {"schema": TASK_SCHEMA, "tasks": plans}
    code = begin(view, rows, body, is_change=bool(changing), warning=_warning(order))
    if code is not None:
        return code
    results = {name: _give_hold(view, order, known[name]) for name in changing}
    after = {str(task["name"]): task for task in _status(view.door)["tasks"]}
    lacks = _wait_known(view, results) if order.is_waiting else []
    late = EXIT_TIMED_OUT if lacks else EXIT_OK
    if view.is_json:
        tasks = [{**_held(after[name]), **results.get(name, {"outcome": "unchanged", "detail": ""})} for name in chosen]
        print_json({"schema": TASK_SCHEMA, "tasks": tasks, "missing": lacks})
        return max([late, *[CODES.get(str(result["outcome"]), EXIT_FAILED) for result in results.values()]])
    code = _tell_results(results)
    for lack in lacks:
        say(f"  {lack}", indent=4)
    return max(code, late)


def _wait_known(view: OrderView, results: Mapping[str, Json]) -> list[str]:
    """Wait until every node that is alive has learnt what was agreed; what is missing when that takes too long."""
    revisions = {name: int(one["revision"]) for name, one in results.items() if one["outcome"] == "ok"}
    began = monotonic_s()
    while True:
        lacks = _not_known(view.door, revisions)
        if not lacks or monotonic_s() - began >= KNOWN_S:
            return lacks
        time.sleep(PAUSE_S)


def _not_known(door: Door, revisions: Mapping[str, int]) -> list[str]:
    lacks = []
    first = _status(door)
    for node in [str(one["name"]) for one in first["nodes"] if one["state"] == "alive"]:
        try:
            status = first if node == first["node"] else _status(door.to(node))
        except CliError as error:
            lacks.append(f"{node} does not answer: {error}")
            continue
        known = {str(task["name"]): int(task["revision"]) for task in status["tasks"]}
        late = [name for name, revision in revisions.items() if known.get(name, -1) < revision]
        lacks += [f"{node} has not learnt revision {revisions[name]} of {name}" for name in late]
    return lacks


def _warning(order: HoldOrder) -> str:
    if order.hold == "pause":
        return "A dead owner will not be replaced."
    return "Without that node nobody does the task." if order.is_hard else ""


def _give_hold(view: OrderView, order: HoldOrder, task: Json) -> Json:
    request = {
        "verb": "hold",
        "hold": order.hold,
        "task": task["name"],
        "target": order.node,
        "hard": order.is_hard,
        "for_s": view.for_s,
        "base_revision": task["revision"] if view.revision is None else view.revision,
        **view.asked,
    }
    return ask_door(view.door, request)


def _hold_row(view: OrderView, order: HoldOrder, task: Json) -> Row:
    kind = "pause" if order.hold in ("pause", "resume") else "pin"
    before = _told(kind, task.get(kind))
    if order.hold in ("resume", "unpin"):
        after = NOTHING
    else:
        wanted = {
            "node": (order.node or task["owner"]) if kind == "pin" else None,
            "is_hard": order.is_hard,
            "by": view.asked["by"],
            "reason": view.reason,
            "for_s": view.for_s,
        }
        after = _told(kind, wanted)
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


# --- move ------------------------------------------------------------------------------------------------------------


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
    status = _status(view.door)
    known = {str(task["name"]): task for task in status["tasks"]}
    _check_name(status, "task", order.task, list(known))
    _check_name(status, "node", order.node, [str(node["name"]) for node in status["nodes"]])
    task = known[order.task]
    request = {
        "verb": "move",
        "task": order.task,
        "target": order.node,
        "origin": order.origin,
        "base_revision": task["revision"] if view.revision is None else view.revision,
        **view.asked,
    }
    plan = ask_door(view.door, {**request, "plan": True})
    if plan["outcome"] not in ("ok", "unchanged"):
        raise _refused(order.task, plan)
    row = (order.task, "owner", str(task["owner"] or "nobody"), order.node)
    body: Json = {"schema": MOVE_SCHEMA, "task": order.task, "from": task["owner"], "to": order.node, "epoch": None}
    body |= {"revision": task["revision"], "settled": False, "switched_s": None, "gap_s": None}
    body |= {"lost": None, "doubled": None}
    code = begin(view, [row], {**body, "missing": []}, is_change=plan["outcome"] == "ok")
    if code is not None:
        return code
    before = _counts(_robots(view.door, status), order.task)
    result = ask_door(view.door, request)
    if result["outcome"] not in ("ok", "unchanged"):
        raise _refused(order.task, result)
    watch = not order.is_detached
    if watch and not view.is_json:
        say("It is agreed. Ctrl-C ends the watching, not the move.")
    found, lacks = _watch(view.door, order, int(result["revision"])) if watch else ({}, [])
    return _tell_move(view, order, str(task["owner"] or ""), result, before, found, lacks)


def _watch(door: Door, order: MoveOrder, revision: int) -> tuple[dict[str, Json], list[str]]:
    """Every robot's status once the move is over, and what is missing when it is not in time."""
    began, settled_at = monotonic_s(), None
    while True:
        first = _status(door)
        found = _robots(door, first)
        now = monotonic_s()
        task = next(task for task in first["tasks"] if task["name"] == order.task)
        statuses = {str(first["node"]): first, **found}
        lacks = missing(Condition(kind="settled", task=order.task), statuses)
        if task["revision"] < revision:
            lacks.append(f"{order.task}: {first['node']} has not learnt revision {revision}")
        settled_at = (settled_at or now) if not lacks else None
        is_measured = settled_at is not None and (not unmeasured(found, order.task) or now - settled_at >= GAP_S)
        if is_measured or now - began >= order.timeout_s:
            return found, lacks
        time.sleep(PAUSE_S)


def unmeasured(statuses: Mapping[str, Json], name: str) -> list[str]:
    """The robots at which answers flow, and the new owner's first one is not told yet."""
    found = []
    for node, status in statuses.items():
        task = next(one for one in status["tasks"] if one["name"] == name)
        flows = [stream for stream in task["streams"] if stream.get("gap_s") is not None]
        if flows and task.get("gap_s") is None:
            found.append(node)
    return found


def _robots(door: Door, status: Json) -> dict[str, Json]:
    """The statuses of all robots that are alive."""
    alive = [str(node["name"]) for node in status["nodes"] if node["kind"] == "robot" and node["state"] == "alive"]
    return {name: status if name == status["node"] else _status(door.to(name)) for name in alive}


def _counts(statuses: Mapping[str, Json], name: str) -> dict[str, int]:
    """What hops of the task's streams have lost and doubled so far, over all robots."""
    streams = [
        stream
        for status in statuses.values()
        for task in status["tasks"]
        if task["name"] == name
        for stream in task["streams"]
    ]
    return {key: sum(int(stream[key]) for stream in streams) for key in ("lost", "doubled")}


def _tell_move(
    view: OrderView,
    order: MoveOrder,
    left: str,
    result: Json,
    before: Mapping[str, int],
    found: Mapping[str, Json],
    lacks: Sequence[str],
) -> int:
    tasks = [task for status in found.values() for task in status["tasks"] if task["name"] == order.task]
    switched = [task["switched_s"] for task in tasks if task.get("switched_s") is not None]
    switched_s = max(switched, default=None)
    gap_s = max([task["gap_s"] for task in tasks if task.get("gap_s") is not None], default=None)
    after = _counts(found, order.task)
    more: dict[str, Any] = {key: max(after[key] - before[key], 0) if found else None for key in before}
    epoch = max([int(task["epoch"]) for task in tasks], default=None)
    if view.is_json:
        body = {"schema": MOVE_SCHEMA, "task": order.task, "from": left or None, "to": order.node, "epoch": epoch}
        body |= {"revision": result["revision"], "settled": bool(found) and not lacks, "switched_s": switched_s}
        body |= {"gap_s": gap_s}
        print_json({**body, **more, "missing": list(lacks)})
    elif not found:
        say(f"{order.task}: revision {result['revision']} is agreed; `zsched wait --for settled={order.task}`")
    elif lacks:
        say(f"{order.task}: not settled after {span(order.timeout_s)}")
        for lack in lacks:
            say(f"  {lack}", indent=4)
    else:
        took = "" if switched_s is None else f", streams switched in {millis(switched_s)}"
        took += "" if gap_s is None else f", no answer for at most {millis(gap_s)}"
        say(f"{order.task}: settled on {order.node}{took}, lost {more['lost']}, doubled {more['doubled']}")
    return EXIT_TIMED_OUT if lacks else EXIT_OK


# --- tune ------------------------------------------------------------------------------------------------------------

_NUMBERS: Final = ("bonus", "cool_down_s", "deadline_ms")
_WORDS: Final[Mapping[str, type[StrEnum]]] = {
    "aggregate": Aggregate,
    "score": ScoreForm,
    "reach": Reach,
    "pair": PairReading,
}
_WHOLE: Final = ("max_moves_per_minute",)
WEIGHTS: Final = NAMES
OF_THE_FILE: Final = (*TUNED_RULES, *TUNED_LINKS)
"""Settings that follow the fleet file, unless an operator has set another value."""
KEYS: Final = (*WEIGHTS, *_NUMBERS, "aggregate", "score", *OF_THE_FILE)


def tuned(before: Json, file: Json, pairs: Sequence[str]) -> dict[str, Any]:
    """A tuning, as JSON values, after ``key=value`` words; ``key=null`` is the file's value.

    >>> base = {"weights": {"cpu": 0.5, "memory": 0.5, "network": 0.0}, "bonus": 0.1}
    >>> tuned(base, base, ["bonus=0.2"])["bonus"]
    0.2

    Raises:
        CliError: a word is no such pair, or the key or its value is unknown.
    """
    after = {**before, "weights": shares(before["weights"])}
    by_file = shares(file["weights"])
    seen = set[str]()
    for pair in pairs:
        key, equals, text = pair.partition("=")
        key = key.removeprefix("weights.")
        if not equals:
            raise CliError(EXIT_USAGE, f"{pair!r} is no setting; write it like bonus=0.2, or bonus=null")
        if key not in KEYS:
            raise CliError(EXIT_USAGE, f"{pair!r}: there is no setting {key!r}{nearest(key, KEYS)}")
        if key in seen:
            raise CliError(EXIT_USAGE, f"{pair!r}: {key} is given twice; give it once")
        seen.add(key)
        place, source = (after["weights"], by_file) if key in WEIGHTS else (after, file)
        default = source.get(key, 0.0) if key in WEIGHTS else source.get(key)
        place[key] = default if text == "null" else _setting(pair, key, text)
    after["weights"] = shares(after["weights"])
    return after


def _setting(pair: str, key: str, text: str) -> Any:
    try:
        return str(_WORDS[key](text)) if key in _WORDS else int(text) if key in _WHOLE else float(text)
    except ValueError:
        number = "a whole number" if key in _WHOLE else "a number"
        kind = f"one of {', '.join(list(_WORDS[key]))}" if key in _WORDS else number
        raise CliError(EXIT_USAGE, f"{pair!r}: {text!r} is not {kind}") from None


def tune(view: OrderView, name: str | None, pairs: Sequence[str]) -> int:
    """Show tunings, or change one on the whole running fleet; returns the exit code.

    Raises:
        CliError: nobody answers, there is no such task or setting, or the change was not agreed.
    """
    check_said(view)
    status = _status(view.door)
    known = {str(task["name"]): task for task in status["tasks"]}
    if name is not None:
        _check_name(status, "task", name, list(known))
    if name is None or not pairs:
        return _list_tunings(view, [known[name]] if name is not None else list(known.values()))
    task = known[name]
    after = tuned(task["tuning"], _file_tuning(task), pairs)
    tuning = _checked(after, _file_tuning(task))
    flat_before, flat_after = _flat(task["tuning"]), _flat(after)
    rows = [
        (name, key, _figure(key, flat_before.get(key, 0.0)), _figure(key, flat_after.get(key, 0.0)))
        for key in KEYS
        if flat_before.get(key, 0.0) != flat_after.get(key, 0.0)
    ]
    told = {"task": name, "revision": task["revision"], "tuning": flat_after, "file": _flat(_file_tuning(task))}
    planned = {**told, "outcome": "planned" if rows else "unchanged", "detail": ""}
    code = begin(view, rows, {"schema": TUNING_SCHEMA, "tasks": [planned]}, is_change=bool(rows))
    if code is not None:
        return code
    base = task["revision"] if view.revision is None else view.revision
    request = {"verb": "tune", "task": name, "tuning": tuning, "base_revision": base, **view.asked}
    result = ask_door(view.door, request)
    if view.is_json:
        print_json({"schema": TUNING_SCHEMA, "tasks": [{**told, **result}]})
        return CODES.get(str(result["outcome"]), EXIT_FAILED)
    return _tell_results({name: result})


def _checked(after: Json, file: Json) -> Json:
    """The tuning as a request carries it: a setting that is the file's is left to the file.

    Raises:
        CliError: a figure is out of range, or the weights' sum is not 1.
    """
    from zsched.wire.codec import as_plain  # noqa: PLC0415 - the other orders need no codec

    try:
        deadline_ms = after.get("deadline_ms")
        tuning = Tuning(
            weights=Weights.of(after["weights"]),
            bonus=after["bonus"],
            cool_down_s=after["cool_down_s"],
            aggregate=Aggregate(after["aggregate"]),
            score=ScoreForm(after["score"]),
            deadline_ms=deadline_ms,
            **_own(after),
        )
    except ValueError as error:
        raise CliError(EXIT_USAGE, f"{error}; nothing was changed") from None
    nu, rho = tuning.nu_dbm, tuning.rho_dbm
    if nu is not None and rho is not None and nu >= rho:
        raise CliError(EXIT_USAGE, f"nu_dbm ({nu:g}) must be below rho_dbm ({rho:g}); nothing was changed")
    if tuning.deadline_ms is not None and tuning.score is ScoreForm.PAPER:
        raise CliError(EXIT_USAGE, "the paper's score knows no deadlines: score=service, or deadline_ms=null")
    kept: dict[str, Any] = {key: None for key in OF_THE_FILE if after.get(key) == file.get(key)}
    body: Json = as_plain(replace(tuning, **kept))
    return body


def _own(after: Json) -> Json:
    """The settings of the file that this tuning has; those in words as their enumerations."""
    given = {key: after.get(key) for key in OF_THE_FILE}
    return {key: _WORDS[key](value) if key in _WORDS and value is not None else value for key, value in given.items()}


def _file_tuning(task: Json) -> Json:
    """The fleet file's tuning; a daemon of an older program does not tell it."""
    found: Json = task.get("file_tuning") or task["tuning"]
    return found


def _flat(tuning: Json) -> Json:
    """Every setting; of the gauges' weights those above 0."""
    return {**shares(tuning["weights"]), **{key: tuning.get(key) for key in KEYS if key not in WEIGHTS}}


def _figure(key: str, value: Any) -> str:
    if value is None:
        return {"patience": "learnt"}.get(key, "none")
    return f"{value:g}" if isinstance(value, float | int) else str(value)


def _list_tunings(view: OrderView, tasks: Sequence[Json]) -> int:
    if view.is_json:
        found = [
            {
                "task": task["name"],
                "revision": task["revision"],
                "tuning": _flat(task["tuning"]),
                "file": _flat(_file_tuning(task)),
            }
            for task in tasks
        ]
        print_json({"schema": TUNING_SCHEMA, "tasks": found})
        return EXIT_OK
    for task in tasks:
        now, file = _flat(task["tuning"]), _flat(_file_tuning(task))
        words = [
            f"{key}={_figure(key, now.get(key, 0.0))}{_differs(key, now.get(key, 0.0), file.get(key, 0.0))}"
            for key in KEYS
            if key in now or key in file
        ]
        say(f"{task['name']} (revision {task['revision']}): {' '.join(words)}")
    return EXIT_OK


def _differs(key: str, now: Any, file: Any) -> str:
    return "" if now == file else f" (file: {_figure(key, file)})"


# --- maint -----------------------------------------------------------------------------------------------------------


def maint(door: Door, *, is_json: bool) -> int:
    """List every order that is in force, of tasks and of nodes, and every node that stops; returns the exit code.

    Raises:
        CliError: nobody answers.
    """
    status = _status(door)
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
    _table(("WHAT", "KIND", "ORDER", "SINCE"), rows)
    return EXIT_OK


def _told_order(order: Json) -> str:
    kind = str(order["kind"])
    if kind == ROLLOUT:
        return told_rollout(order)
    return told_flag(order) if kind in FLAGS else told_hold(kind, order)


# --- what they share -------------------------------------------------------------------------------------------------


def _status(door: Door) -> Json:
    return ask_door(door, {"verb": "status"})


def _check_name(status: Json, kind: str, name: str, known: Sequence[str]) -> None:
    if name not in known:
        raise CliError(EXIT_USAGE, f"fleet {status['fleet']} has no {kind} {name!r}{nearest(name, known)}")


def begin(
    view: OrderView,
    rows: Sequence[Row],
    plan: Json,
    *,
    is_change: bool,
    warning: str = "",
    titles: Row = ("TASK", "WHAT", "NOW", "AFTER"),
    is_line: bool = False,
) -> int | None:
    """Show before and after (``plan``, as JSON), and ask; the exit code when nothing is to be done now, else ``None``.

    Raises:
        CliError: off a terminal, without --yes.
    """
    if not view.is_json:
        _table(titles, rows)
    if view.is_plan:
        if view.is_json:
            print_json(plan, is_line=is_line)
        return EXIT_WOULD_CHANGE if is_change else EXIT_OK
    if not is_change:
        if not view.is_json:
            say("Nothing would change.")
            return EXIT_OK
        return None
    if view.is_yes:
        return None
    if not sys.stdin.isatty() or view.is_json:
        command = shlex.join(["zsched", *sys.argv[1:], "--yes"])
        raise CliError(EXIT_USAGE, f"nothing was done, for nobody can be asked here; to do it:\n{command}")
    if not says_yes(f"{warning}{' ' if warning else ''}Do it?", sys.stdout):
        say("Nothing was done.")
        return EXIT_FAILED
    return None


def _table(titles: Row, rows: Sequence[Row]) -> None:
    if not rows:
        return
    shown = [titles, *[tuple(harmless(cell) for cell in row) for row in rows]]
    widths = [max(len(row[column]) for row in shown) for column in range(len(titles))]
    for row in shown:
        cells = [cell.ljust(width) for cell, width in zip(row, widths, strict=True)]
        say("  ".join(cells).rstrip())


def _refused(task: str, result: Json) -> CliError:
    outcome, detail = str(result["outcome"]), str(result["detail"]).removeprefix(f"{task}: ")
    text = f"{task}: {outcome.replace('_', ' ')}: {detail}{ADVICE.get(outcome, '')}"
    return CliError(CODES.get(outcome, EXIT_FAILED), text)


def _tell_results(results: Mapping[str, Json]) -> int:
    """Print what became of each; the worst exit code.

    Raises:
        CliError: the only order was not agreed.
    """
    codes = [EXIT_OK]
    for name, result in results.items():
        code = CODES.get(str(result["outcome"]), EXIT_FAILED)
        codes.append(code)
        if code != EXIT_OK and len(results) == 1:
            raise _refused(name, result)
        word = "agreed" if result["outcome"] == "ok" else str(_refused(name, result)).removeprefix(f"{name}: ")
        say(f"{name}: {word} (revision {result['revision']})")
    return max(codes)
