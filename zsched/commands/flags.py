"""`zsched drain` and `undrain`: shows what a flag changes, has it agreed, and watches a node become empty.

Knows: how flags are shown before and after, the danger in one, when a node is empty. Does not know: how a document is
agreed (`zsched.commands.document`), what a robot makes of a flag (`zsched.core.scheduler.flags`).
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from zsched.clock import monotonic_s
from zsched.commands.ask import Door, ask_door
from zsched.commands.common import CliError, Json, check_dangers, check_taken, nearest, print_json, say, told_task
from zsched.commands.document import DOCUMENT, InForce, change_over, document_text, in_force, ordered
from zsched.commands.orders import (
    OrderView,
    Row,
    begin,
    check_said,
    lost_since,
    statuses_of,
    tell_uncounted,
    told_losses,
)
from zsched.commands.page import span
from zsched.commands.report import millis, told_flag
from zsched.commands.wait import Condition, missing
from zsched.config.difference import SEAT_AGAIN, names_electors, unseated
from zsched.config.load import check_bytes
from zsched.core.values.struct import Struct, field, replace
from zsched.exits import EXIT_FAILED, EXIT_OK, EXIT_TIMED_OUT, EXIT_USAGE

SCHEMA: Final = "zsched.drain/1"
DRAIN, INELIGIBLE, LEAVE = "drain", "ineligible", "leave"
PAUSE_S: Final = 0.2
"""Between two looks at a node that is drained."""
STAYS_S: Final = 3.0
"""A task that has not left after this time is reported, with the reason; again when the reason changes."""
NO_OTHER: Final = "no-other-candidate"
"""The danger: a task would have no candidate left that may get it."""
SEAT_ADVICE: Final = ", then ".join(f"`{command}`" for command in SEAT_AGAIN) + " mends that"
"""Where a document names an elector that is none."""
NOTHING: Final = "-"
TITLES: Final = ("WHAT", "KIND", "NOW", "AFTER")
BLANK: Final[Json] = dict.fromkeys(
    ("node", "task", "to", "by", "reason", "known_s", "for_s", "revision", "switched_s", "lost", "doubled")
)


class DrainOrder(Struct, frozen=True, kw_only=True):
    """Which nodes, and how their drain is watched."""

    nodes: tuple[str, ...]
    is_self: bool = False
    is_detached: bool = False
    deadline_s: float | None = 600.0
    """``None``: wait until they are empty."""
    kind: str = DRAIN
    """``LEAVE``: they give up their seats among the electors, too. ``INELIGIBLE``: they keep what they own."""
    more_rows: tuple[Row, ...] = ()
    """What else follows, in the table of what changes."""
    is_shown: bool = False
    """The operator has seen the table, and has agreed."""


class _Watch(Struct):
    """What has been told of a drain so far."""

    view: OrderView
    began: float
    owners: dict[str, str]
    """{task: the node that it is to leave}, of those that have not settled elsewhere yet."""
    before: Mapping[str, Json]
    """{node: its status before the drain}."""
    stays: dict[str, str] = field(default_factory=dict)
    """{task: why it stays, as it was told last}."""
    empty: set[str] = field(default_factory=set)
    flagged: set[str] = field(default_factory=set)
    """Nodes of which the flag has been seen in force."""
    kind: str = DRAIN

    def tell(self, event: str, text: str, **more: Any) -> None:
        tell(self.view, event, text, after_s=monotonic_s() - self.began, **more)


def drain(view: OrderView, order: DrainOrder) -> int:
    """Drain nodes and wait until they are empty, or list the drained ones; returns the exit code.

    Raises:
        CliError: nobody answers, there is no such node, no document is agreed, or the drain is not agreed.
    """
    check_said(view)
    status = _status(view.door)
    nodes = _chosen(status, order)
    if not nodes:
        return _list(view, status)
    held = _held(view)
    after = _with(view, held, order.kind, nodes)
    rows = [_row(status, name, order.kind, after) for name in nodes]
    rows += [] if order.kind == INELIGIBLE else _task_rows(status, nodes, after)
    danger = _check_dangers(view, status, held.flags, after)
    owned = [row[0] for row in rows if row[1] == "owner"]
    plan = _body("planned", nodes=nodes, revision=held.revision, tasks=owned, reason=danger)
    is_change = after != held.flags
    if (is_change or view.is_plan) and not order.is_shown:
        code = begin(view, [*rows, *order.more_rows], plan, is_change=is_change, titles=TITLES, is_line=True)
        if code is not None:
            return code
    before, silent = ({}, {}) if order.is_detached else _statuses(view.door, status, nodes)
    tell_uncounted(silent)
    revision = _commit(view, held, after, f"{order.kind} {', '.join(nodes)}")
    had = "; ".join(f"{row[0]}: {row[2]}" for row in rows if row[1] == order.kind)
    what = f"It is agreed{_endless(held.flags, after)}" if is_change else f"Nothing would change ({had})"
    watch = ". Ctrl-C ends the watching, not the drain"
    if order.kind == LEAVE:  # this command does the rest, once the node is empty
        watch = f". After Ctrl-C the same command goes on, and `zsched undrain {' '.join(nodes)}` takes it back"
    watch = "" if order.is_detached else watch
    event = "agreed" if is_change else "unchanged"
    tell(view, event, f"{what}{watch}.", after_s=0.0, nodes=nodes, revision=revision)
    if order.is_detached:
        return EXIT_OK
    watching = _Watch(view=view, began=monotonic_s(), owners=_owned(status, nodes), before=before, kind=order.kind)
    return _watch(watching, nodes, revision, order.deadline_s)


def undrain(view: OrderView, nodes: Sequence[str]) -> int:
    """Take every flag off nodes; returns the exit code.

    Raises:
        CliError: as of `drain`.
    """
    if not nodes:
        return _list(view, _status(view.door))
    check_said(view)
    status = _status(view.door)
    _check_nodes(status, nodes)
    held = _held(view)
    after = tuple(flag for flag in held.flags if flag["subject"] not in nodes)
    gone = {name: [str(flag["kind"]) for flag in held.flags if flag["subject"] == name] for name in nodes}
    rows = [_row(status, name, kind, after) for name, kinds in gone.items() for kind in kinds or [DRAIN]]
    plan = _body("planned", nodes=nodes, revision=held.revision)
    code = begin(view, rows, plan, is_change=after != held.flags, titles=TITLES, is_line=True)
    if code is not None:
        return code
    if after == held.flags:
        return tell(view, "unchanged", "Nothing would change.", nodes=nodes, revision=held.revision)
    revision = _commit(view, held, after, f"undrain {', '.join(gone)}")
    lost = _seats_lost(view.door, held, nodes)
    text = f"It is agreed.{''.join(f' {lack}.' for lack in lost)}"
    return tell(view, "agreed", text, after_s=0.0, nodes=nodes, revision=revision, missing=lost)


def _seats_lost(door: Door, held: InForce, nodes: Sequence[str]) -> list[str]:
    """What nodes lack whose leave was taken back too late: a seat that the document names does not come by itself."""
    left = [name for name in nodes if has_flag(held, LEAVE, name)]
    if not left or not names_electors(held.text):
        return []
    with contextlib.suppress(CliError):  # it is agreed all the same
        held = replace(held, electors=in_force(door).electors)
    lost = without_seat(held)
    told = f"is no elector any more, and the document names it as one: {SEAT_ADVICE}"
    return [f"{name} {told}" for name in left if name in lost]


def without_seat(held: InForce) -> tuple[str, ...]:
    """The electors that the document names, and that are none; of one that cannot be read here nobody knows."""
    fleet = check_bytes(held.text.encode(), DOCUMENT).fleet if held.text else None
    return () if fleet is None else unseated(held.text, fleet, [name for name, _ in held.electors])


def _endless(before: Sequence[Json], after: Sequence[Json]) -> str:
    """Which nodes' flags had an end by themselves, and have none any more; empty: none."""
    had = {(flag["kind"], flag["subject"]): flag["for_s"] for flag in before if flag.get("for_s") is not None}
    ones = [flag for flag in after if flag.get("for_s") is None and (flag["kind"], flag["subject"]) in had]
    told = ", ".join(f"{one['subject']}, was for {span(had[one['kind'], one['subject']])}" for one in ones)
    return f", and ends by hand only ({told})" if told else ""


# --- what is shown ---------------------------------------------------------------------------------------------------


def tell(view: OrderView, event: str, text: str, **more: Any) -> int:
    """One thing that has happened: a line of text, or one of NDJSON."""
    if view.is_json:
        print_json(_body(event, **more), is_line=True)
    else:
        say(text)
    return EXIT_OK


def _body(event: str, **more: Any) -> Json:
    body = {"schema": SCHEMA, "event": event, "after_s": None, "nodes": [], "tasks": [], "missing": [], **BLANK}
    return {**body, **more, "nodes": list(more.get("nodes", ()))}


def _list(view: OrderView, status: Json) -> int:
    found = [(str(node["name"]), flag) for node in status["nodes"] for flag in node.get("flags", ())]
    if not found and not view.is_json:
        say(f"no node is drained, as {status['node']} knows")
    for name, flag in found:
        text = f"{name}: {told_flag(flag)}, known for {span(flag['known_s'])}"
        told = {key: flag[key] for key in ("by", "reason", "known_s", "for_s")}
        tell(view, "listed", text, node=name, nodes=[name], **told)
    return EXIT_OK


def _row(status: Json, name: str, kind: str, after: Sequence[Json]) -> tuple[str, str, str, str]:
    node = next(node for node in status["nodes"] if node["name"] == name)
    now = next((flag for flag in node.get("flags", ()) if flag["kind"] == kind), None)
    then = next((flag for flag in after if flag["subject"] == name and flag["kind"] == kind), None)
    before, later = (NOTHING if flag is None else told_flag(flag) for flag in (now, then))
    return name, kind, before, later


def _task_rows(status: Json, nodes: Sequence[str], after: Sequence[Json]) -> Iterator[tuple[str, str, str, str]]:
    """What becomes of each task that the nodes own, as far as it can be told before."""
    closed = {flag["subject"] for flag in after}
    for task in status["tasks"]:
        if task["owner"] in nodes:
            others = [name for name in task["candidates"] if name not in closed]
            pin, pause = task.get("pin"), task.get("pause")
            if pause is not None:
                then = "stays: it is paused"
            elif pin is not None and pin["is_hard"] and pin["node"] in closed:
                then = f"stays: it is pinned to {pin['node']} (hard)"
            else:
                then = f"one of {', '.join(others)}" if others else "stays: there is no other candidate"
            yield str(task["name"]), "owner", str(task["owner"]), then


# --- asking, and agreeing --------------------------------------------------------------------------------------------


def _status(door: Door) -> Json:
    return ask_door(door, {"verb": "status"})


def _check_nodes(status: Json, names: Sequence[str]) -> None:
    known = [str(node["name"]) for node in status["nodes"]]
    for name in names:
        if name not in known:
            raise CliError(EXIT_USAGE, f"fleet {status['fleet']} has no node {name!r}{nearest(name, known)}")


def _chosen(status: Json, order: DrainOrder) -> tuple[str, ...]:
    own = (str(status["node"]),) if order.is_self else ()
    nodes = tuple(dict.fromkeys((*own, *order.nodes)))
    _check_nodes(status, nodes)
    return nodes


def _held(view: OrderView) -> InForce:
    """The document in force, at the revision that the operator means.

    Raises:
        CliError: none is agreed, it is not here yet, or it was overtaken.
    """
    held = in_force(view.door)
    document_text(held)
    if view.revision is not None and view.revision != held.revision:
        raise CliError(EXIT_FAILED, f"revision {view.revision} is overtaken: {held.fleet} has revision {held.revision}")
    return held


def _with(view: OrderView, held: InForce, kind: str, nodes: Sequence[str]) -> tuple[Json, ...]:
    """The flags with this one of each node, which ends when this order says, or by hand alone.

    One that a node has stays where it says the same; its reason stays where no other is given.
    """
    flags = list(held.flags)
    for name in nodes:
        known = next((flag for flag in flags if (flag["kind"], flag["subject"]) == (kind, name)), None)
        says_same = known is not None and view.reason in ("", known.get("reason", ""))
        if known is not None and says_same and view.for_s is None and known.get("for_s") is None:
            continue
        flags = [flag for flag in flags if flag is not known]
        said = {"kind": kind, "subject": name, **view.asked, "for_s": view.for_s, "revision": held.revision + 1}
        if known is not None and not view.reason:
            said["reason"] = known.get("reason", "")
        flags.append(said)
    return tuple(sorted(flags, key=lambda flag: (flag["subject"], flag["kind"])))


def _check_dangers(view: OrderView, status: Json, before: Sequence[Json], after: Sequence[Json]) -> str | None:
    """The danger that some task loses its last candidate that may get it, in words; a plan shows it.

    Raises:
        CliError: it is there, and is not accepted by name.
    """
    check_dangers(view.accepted, (NO_OTHER,))
    was, closed = ({flag["subject"] for flag in flags} for flags in (before, after))
    told = [
        str(task["name"])
        for task in status["tasks"]
        if closed.issuperset(task["candidates"]) and not was.issuperset(task["candidates"])
    ]
    if not told:
        return None
    means = f"{', '.join(told)}: no candidate may get it any more; when its owner ends, nobody does it"
    if view.is_plan and not view.is_json:
        say(f"{NO_OTHER}: {means}")
    if not view.is_plan:
        check_taken([(NO_OTHER, means)], view.accepted)
    return f"{NO_OTHER}: {means}"


def _commit(view: OrderView, held: InForce, flags: Sequence[Json], what: str) -> int:
    """Have a document with these flags agreed; the revision that has them.

    Raises:
        CliError: it was not agreed.
    """
    if tuple(flags) == held.flags:
        return held.revision
    text = {"text": held.text, "flags": list(flags), "rollouts": list(held.rollouts)}
    answer = change_over(view.door, {**text, **ordered(what, view.asked)}, held)
    return int(answer["revision"])


def drain_quietly(view: OrderView, node: str) -> int:
    """Have a node drained for ``view.for_s``, without a question; the revision that has it.

    Raises:
        CliError: nobody answers, no document is agreed, the node has an order already, or the drain is not agreed.
    """
    held = _held(view)
    if any(flag["subject"] == node for flag in held.flags):
        raise CliError(EXIT_FAILED, f"{node} has an order already; see `zsched status`")
    return _commit(view, held, _with(view, held, DRAIN, [node]), f"drain {node}")


def lift_quietly(view: OrderView, since: int) -> tuple[str, ...]:
    """End the drains with this view's reason, which no other drain has; their nodes.

    Raises:
        CliError: nobody answers, the node asked does not know revision ``since`` yet, or the end is not agreed.
    """
    held = in_force(view.door)
    if held.revision < since:
        raise CliError(EXIT_FAILED, f"{held.node} has not learnt revision {since} yet")
    ours = tuple(str(flag["subject"]) for flag in held.flags if is_given_for(view.reason, flag))
    if ours:
        left = [flag for flag in held.flags if not is_given_for(view.reason, flag)]
        _commit(view, held, left, f"undrain {', '.join(ours)}")
    return ours


def is_given_for(reason: str, flag: Json) -> bool:
    """Whether a flag is a drain for this reason; who gave it, each node that takes a command may call another name."""
    return bool(flag["kind"] == DRAIN and flag.get("reason", "") == reason)


# --- watching --------------------------------------------------------------------------------------------------------


def _owned(status: Json, nodes: Sequence[str]) -> dict[str, str]:
    return {str(task["name"]): str(task["owner"]) for task in status["tasks"] if task["owner"] in nodes}


def _watch(watch: _Watch, nodes: Sequence[str], revision: int, deadline_s: float | None) -> int:
    """Look again and again until the nodes are empty, or the deadline has come."""
    while True:
        lacks = _look(watch, nodes, revision)
        if not lacks:
            return EXIT_OK
        passed_s = monotonic_s() - watch.began
        if deadline_s is not None and passed_s >= deadline_s:
            left = [name for name in nodes if name not in watch.empty]
            text = f"{', '.join(left)}: not empty after {span(passed_s)}; the {watch.kind} stays in force"
            watch.tell("deadline", "\n".join((text, *(f"  {lack}" for lack in lacks))), nodes=left, missing=lacks)
            return EXIT_TIMED_OUT
        time.sleep(PAUSE_S)


def _look(watch: _Watch, nodes: Sequence[str], revision: int) -> list[str]:
    """Tell what is new, and say what is missing yet; a node that does not answer now is asked again."""
    try:
        first = _status(watch.view.door)
    except CliError as error:
        return [str(error)]
    found, silent = _statuses(watch.view.door, first, nodes)
    if silent:
        return list(silent.values())
    if int(first["fleet_revision"]) < revision:
        return [f"{first['node']} has not learnt revision {revision} yet"]
    _check_flagged(watch, first, nodes)
    _tell_moves(watch, found)
    _tell_stays(watch, found)
    lacks = []
    for name in nodes:
        missed = missing(Condition(kind="empty", node=name), found)
        if not missed and name not in watch.empty:
            watch.empty.add(name)
            until = _until(first, name) if watch.kind == DRAIN else ""
            watch.tell("empty", f"{name}: empty, and gets nothing new{until}", node=name)
        lacks += missed
    return lacks


def _check_flagged(watch: _Watch, status: Json, nodes: Sequence[str]) -> None:
    """End the watching where the flag of a node that is not empty yet is over: nothing takes its tasks away any more.

    Raises:
        CliError: somebody has taken it back, or its time is over.
    """
    has = {
        str(node["name"]) for node in status["nodes"] for flag in node.get("flags", ()) if flag["kind"] == watch.kind
    }
    gone = [name for name in nodes if name in watch.flagged - watch.empty - has]
    watch.flagged |= has
    if gone and in_force(watch.view.door).text:  # without the document it knows no flags
        raise CliError(EXIT_FAILED, told_over(watch.kind, gone))


def check_in_force(door: Door, kind: str, name: str) -> InForce:
    """Refuse to go on with a node whose flag somebody has taken back; what was looked at.

    Raises:
        CliError: it is so, as the node at the door knows, or nobody answers.
    """
    held = in_force(door)
    if held.text and not has_flag(held, kind, name):
        raise CliError(EXIT_FAILED, told_over(kind, [name]))
    return held


def has_flag(held: InForce, kind: str, name: str) -> bool:
    """Whether a flag of a node is in force."""
    return any((flag["kind"], flag["subject"]) == (kind, name) for flag in held.flags)


def told_over(kind: str, names: Sequence[str]) -> str:
    """That a flag is not in force any more, which a command has gone by so far."""
    return f"{', '.join(names)}: the {kind} is not in force any more: it was taken back, or its time is over"


def _until(status: Json, name: str) -> str:
    """When a drained node gets tasks again."""
    flags = next((node.get("flags", ()) for node in status["nodes"] if node["name"] == name), ())
    flag = next((flag for flag in flags if flag["kind"] == DRAIN), None)
    if flag is None or flag["for_s"] is None:
        return f" until `zsched undrain {name}`"
    return f" for {span(max(flag['for_s'] - flag['known_s'], 0.0))}, or until `zsched undrain {name}`"


def _statuses(door: Door, first: Json, nodes: Sequence[str]) -> tuple[dict[str, Json], dict[str, str]]:
    """As `statuses_of`, of all robots and the drained nodes that are alive; the first one is the node at the door."""
    wanted = [
        str(node["name"])
        for node in first["nodes"]
        if node["state"] == "alive" and (node["kind"] == "robot" or node["name"] in nodes)
    ]
    return statuses_of(door, first, list(dict.fromkeys((str(first["node"]), *wanted))))


def _tell_moves(watch: _Watch, found: Mapping[str, Json]) -> None:
    """Tell the tasks that have settled elsewhere since the last look."""
    first = next(iter(found.values()))
    for task in first["tasks"]:
        name = str(task["name"])
        left = watch.owners.get(name)
        if left is None or task["owner"] in (None, left) or missing(Condition(kind="settled", task=name), found):
            continue
        del watch.owners[name]
        spans = [one["switched_s"] for status in found.values() for one in status["tasks"] if one["name"] == name]
        switched_s = max((one for one in spans if one is not None), default=None)
        took = "" if switched_s is None else f", streams switched in {millis(switched_s)}"
        losses = lost_since(watch.before, found, name)
        text = f"{name}: {left} -> {task['owner']}{took}{told_losses(losses)}"
        watch.tell("moved", text, node=left, task=name, to=task["owner"], switched_s=switched_s, **losses)


def _tell_stays(watch: _Watch, found: Mapping[str, Json]) -> None:
    """Tell the tasks that have not left, with the reason."""
    if monotonic_s() - watch.began < STAYS_S:
        return
    first = next(iter(found.values()))
    owners = {str(task["name"]): task["owner"] for task in first["tasks"]}
    for name, node in watch.owners.items():
        why = _why_it_stays(name, found)
        if owners.get(name) == node and why and why != watch.stays.get(name):
            watch.stays[name] = why
            watch.tell("stays", f"{name} stays on {node}: {why}", node=node, task=name, reason=why)


def _why_it_stays(name: str, found: Mapping[str, Json]) -> str:
    """The last judgement of some robot, with what keeps the other candidates from the task."""
    for status in found.values():
        task = told_task(status, name)
        if task and task["decision"] is not None:
            vetoed = task["decision"]["vetoed"]
            why = "; ".join(f"{other}: {veto}" for other, veto in vetoed.items() if other != task["owner"])
            return f"{task['decision']['reason']}{f' ({why})' if why else ''}"
    return ""
