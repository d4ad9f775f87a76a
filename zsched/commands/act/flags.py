"""`zsched drain` and `undrain`: shows what a flag changes, has it agreed, and watches a node become empty.

Knows: how flags are shown before and after, the danger in one, when a node is empty. Does not know: how a document is
agreed (`zsched.commands.base.change`), what a robot makes of a flag (`zsched.core.scheduler.flags`).
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from enum import StrEnum
from typing import Annotated, Any, Final

import typer

from zsched.commands.base.ask import Door
from zsched.commands.base.change import (
    DOCUMENT,
    NOTHING,
    InForce,
    OrderView,
    OverError,
    Plan,
    change_over,
    check_revision,
    consent,
    counted_before,
    document_text,
    in_force,
    lost_since,
    ordered,
    status_of,
    statuses_of,
    told_switch,
    until,
)
from zsched.commands.base.common import CliError, Json, check_dangers, check_known, print_json, say, told_task
from zsched.commands.base.options import Changes, ForOption, Orders
from zsched.commands.base.page import Row, duration_s, span
from zsched.commands.base.report import told_flag
from zsched.commands.look.wait import Condition, missing
from zsched.config.difference import SEAT_AGAIN, names_electors, unseated
from zsched.config.load import check_bytes
from zsched.core.values.exits import EXIT_FAILED, EXIT_OK, EXIT_TIMED_OUT, EXIT_USAGE
from zsched.core.values.struct import Struct, replace
from zsched.host.clock import monotonic_s

SCHEMA: Final = "zsched.drain/1"
DRAIN, INELIGIBLE, LEAVE = "drain", "ineligible", "leave"
STAYS_S: Final = 3.0
"""A task that has not left after this time is reported, with the reason; again when the reason changes."""
NO_OTHER: Final = "no-other-candidate"
"""The danger: a task would have no candidate left that may get it."""
SEAT_ADVICE: Final = ", then ".join(f"`{command}`" for command in SEAT_AGAIN) + " mends that"
"""Where a document names an elector that is none."""
TITLES: Final = ("WHAT", "KIND", "NOW", "AFTER")
BLANK: Final[Json] = dict.fromkeys(
    ("node", "task", "to", "by", "reason", "known_s", "for_s", "revision", "switched_s", "lost", "doubled")
)


class DrainOrder(Struct, frozen=True, kw_only=True):
    """Which nodes, and how their drain is watched."""

    nodes: tuple[str, ...]
    is_detached: bool = False
    deadline_s: float | None = 600.0
    """``None``: wait until they are empty."""
    kind: str = DRAIN
    """``LEAVE``: they give up their seats among the electors, too. ``INELIGIBLE``: they keep what they own."""
    more_rows: tuple[Row, ...] = ()
    """What else follows, in the table of what changes."""


class Only(StrEnum):
    """What a drain keeps from nodes."""

    NEW = "new"


def drain(
    said: Changes,
    nodes: Annotated[list[str] | None, typer.Argument(metavar="[NODE]...", help="Nodes of the fleet.")] = None,
    self_: Annotated[bool, typer.Option("--self", help="The node that is asked.")] = False,
    only: Annotated[
        Only | None, typer.Option("--only", metavar="new", help="new: they get nothing new, and keep what they own.")
    ] = None,
    for_: ForOption = None,
    deadline: Annotated[
        str, typer.Option("--deadline", metavar="DURATION", help="How long to watch: 90s, 10m, 2h.")
    ] = "10m",
    force: Annotated[
        bool, typer.Option("--force", help="Ignore the deadline: watch until the nodes are empty.")
    ] = False,
    detach: Annotated[bool, typer.Option("--detach", help="Do not watch it.")] = False,
) -> int:
    """Empty nodes: they get nothing new, and their tasks move away one after another, also pinned ones (not --hard).

    Example: zsched drain edge1 -m "new fan"

    Watches until each node owns nothing and its old slots are closed. The nodes stay drained, over restarts, until
    `zsched undrain`. A task that nobody else can have stays. Without nodes it lists the drained ones. Exits with 5 at
    the deadline; the drain goes on all the same.
    """
    if self_ and (said.node is not None or said.connect is not None):
        raise CliError(EXIT_USAGE, "--self is the node of this machine: name the node instead")
    view = said.order(for_=for_, is_lines=True)
    status = status_of(view.door)
    chosen = tuple(dict.fromkeys((*([str(status["node"])] if self_ else ()), *(nodes or ()))))
    if not chosen:
        return _list(view, status)
    order = DrainOrder(
        nodes=chosen,
        is_detached=detach or only is Only.NEW,
        deadline_s=None if force else duration_s(deadline),
        kind=DRAIN if only is None else INELIGIBLE,
    )
    return drain_nodes(view, order, status)


def drain_nodes(view: OrderView, order: DrainOrder, status: Json) -> int:
    """Drain nodes and wait until they are empty; the exit code.

    Raises:
        CliError: there is no such node, no document is agreed, or the drain is not agreed.
    """
    nodes = order.nodes
    check_known(status, "node", *nodes)
    held = _held(view)
    after = _with(view, held, order.kind, nodes)
    rows = [_row(status, name, order.kind, after) for name in nodes]
    rows += [] if order.kind == INELIGIBLE else _task_rows(status, nodes, after)
    check_dangers(view.accepted, (NO_OTHER,))
    danger = _danger(status, held.flags, after)
    dangers = [] if danger is None else [(NO_OTHER, danger)]
    owned = [row[0] for row in rows if row[1] == "owner"]
    reason = None if danger is None else f"{NO_OTHER}: {danger}"
    body = _body("planned", nodes=nodes, revision=held.revision, tasks=owned, reason=reason)
    is_change = after != held.flags
    if is_change or view.is_plan:
        shown = (*rows, *order.more_rows)
        code = consent(view, Plan(rows=shown, body=body, is_change=is_change, titles=TITLES, dangers=dangers))
        if code is not None:
            return code
    before = {} if order.is_detached else counted_before(view.door, status, nodes)
    revision = _commit(view, held, after, f"{order.kind} {', '.join(nodes)}")
    had = "; ".join(f"{row[0]}: {row[2]}" for row in rows if row[1] == order.kind)
    what = f"It is agreed{_endless(held.flags, after)}" if is_change else f"Nothing would change ({had})"
    watch = "Ctrl-C ends the watching, not the drain."
    if order.kind == LEAVE:  # this command does the rest, once the node is empty
        watch = f"After Ctrl-C the same command goes on, and `zsched undrain {' '.join(nodes)}` takes it back."
    text = f"{what}." if order.is_detached else f"{what}. {watch}"
    tell(view, "agreed" if is_change else "unchanged", text, after_s=0.0, nodes=nodes, revision=revision)
    if order.is_detached:
        return EXIT_OK
    watched = _Watch(view, order.kind, nodes, revision, status, before)
    lacks = until(watched.look, order.deadline_s)
    return watched.tell_deadline(lacks) if lacks else EXIT_OK


def undrain(
    said: Orders,
    nodes: Annotated[
        list[str] | None, typer.Argument(metavar="[NODE]...", help="Nodes; without one: list the drained ones.")
    ] = None,
) -> int:
    """End every drain of nodes: they may get tasks again, when the fleet finds them better.

    Example: zsched undrain edge1

    Without a node it lists those that are drained.
    """
    view = said.order(is_lines=True)
    status = status_of(view.door)
    if not nodes:
        return _list(view, status)
    check_known(status, "node", *nodes)
    held = _held(view)
    after = tuple(flag for flag in held.flags if flag["subject"] not in nodes)
    gone = {name: [str(flag["kind"]) for flag in held.flags if flag["subject"] == name] for name in nodes}
    rows = [_row(status, name, kind, after) for name, kinds in gone.items() for kind in kinds or [DRAIN]]
    body = _body("planned", nodes=nodes, revision=held.revision)
    code = consent(view, Plan(rows=rows, body=body, is_change=after != held.flags, titles=TITLES))
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


def _held(view: OrderView) -> InForce:
    """The document in force, at the revision that the operator means.

    Raises:
        CliError: none is agreed, it is not here yet, or it was overtaken.
    """
    held = in_force(view.door)
    document_text(held)
    check_revision(view, held)
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


def _danger(status: Json, before: Sequence[Json], after: Sequence[Json]) -> str | None:
    """What it means that some task loses its last candidate that may get it; ``None``: none does."""
    was, closed = ({flag["subject"] for flag in flags} for flags in (before, after))
    told = [
        str(task["name"])
        for task in status["tasks"]
        if closed.issuperset(task["candidates"]) and not was.issuperset(task["candidates"])
    ]
    means = "no candidate may get it any more; when its owner ends, nobody does it"
    return f"{', '.join(told)}: {means}" if told else None


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


class _Watch:
    """What has been told of a drain so far."""

    def __init__(
        self, view: OrderView, kind: str, nodes: Sequence[str], revision: int, first: Json, before: Mapping[str, Json]
    ) -> None:
        self._view, self._kind, self._nodes, self._revision, self._before = view, kind, nodes, revision, before
        self._began = monotonic_s()
        owned = [task for task in first["tasks"] if task["owner"] in nodes]
        self._owners = {str(task["name"]): str(task["owner"]) for task in owned}
        """{task: the node that it is to leave}, of those that have not settled elsewhere yet."""
        self._stays: dict[str, str] = {}
        """{task: why it stays, as it was told last}."""
        self._empty: set[str] = set()
        self._flagged: set[str] = set()
        """Nodes of which the flag has been seen in force."""

    def _tell(self, event: str, text: str, **more: Any) -> None:
        tell(self._view, event, text, after_s=monotonic_s() - self._began, **more)

    def look(self) -> list[str]:
        """Tell what is new, and say what is missing yet; a node that does not answer now is asked again."""
        first = status_of(self._view.door)
        found, silent = statuses_of(self._view.door, first, self._nodes)
        if silent:
            return list(silent.values())
        if int(first["fleet_revision"]) < self._revision:
            return [f"{first['node']} has not learnt revision {self._revision} yet"]
        self._check_flagged(first)
        self._tell_moves(first, found)
        if monotonic_s() - self._began >= STAYS_S:
            self._tell_stays(first, found)
        lacks = []
        for name in self._nodes:
            missed = missing(Condition(kind="empty", node=name), found)
            if not missed and name not in self._empty:
                self._empty.add(name)
                until_when = _until(first, name) if self._kind == DRAIN else ""
                self._tell("empty", f"{name}: empty, and gets nothing new{until_when}", node=name)
            lacks += missed
        return lacks

    def tell_deadline(self, lacks: list[str]) -> int:
        """Say that the time is over; the exit code."""
        left = [name for name in self._nodes if name not in self._empty]
        took = span(monotonic_s() - self._began)
        text = f"{', '.join(left)}: not empty after {took}; the {self._kind} stays in force"
        self._tell("deadline", "\n".join((text, *(f"  {lack}" for lack in lacks))), nodes=left, missing=lacks)
        return EXIT_TIMED_OUT

    def _check_flagged(self, status: Json) -> None:
        """End the watching where the flag of a node that is not empty yet is over: nothing takes its tasks away.

        Raises:
            OverError: somebody has taken it back, or its time is over.
        """
        has = {one["name"] for one in status["nodes"] for flag in one.get("flags", ()) if flag["kind"] == self._kind}
        gone = [name for name in self._nodes if name in self._flagged - self._empty - has]
        self._flagged |= has
        if gone and in_force(self._view.door).text:  # without the document it knows no flags
            raise OverError(EXIT_FAILED, told_over(self._kind, gone))

    def _tell_moves(self, first: Json, found: Mapping[str, Json]) -> None:
        """Tell the tasks that have settled elsewhere since the last look."""
        for task in first["tasks"]:
            name, to = str(task["name"]), task["owner"]
            left = self._owners.get(name)
            if left is None or to in (None, left) or missing(Condition(kind="settled", task=name), found):
                continue
            del self._owners[name]
            tasks = [told_task(status, name) for status in found.values()]
            switched_s = max(
                (one["switched_s"] for one in tasks if one and one["switched_s"] is not None), default=None
            )
            losses = lost_since(self._before, found, name)
            text = f"{name}: {left} -> {to}{told_switch(switched_s, None, losses)}"
            self._tell("moved", text, node=left, task=name, to=to, switched_s=switched_s, **losses)

    def _tell_stays(self, first: Json, found: Mapping[str, Json]) -> None:
        """Tell the tasks that have not left, with the reason."""
        for name, node in self._owners.items():
            why = _why_it_stays(name, found)
            if told_task(first, name).get("owner") == node and why and why != self._stays.get(name):
                self._stays[name] = why
                self._tell("stays", f"{name} stays on {node}: {why}", node=node, task=name, reason=why)


def check_in_force(door: Door, kind: str, name: str) -> InForce:
    """Refuse to go on with a node whose flag somebody has taken back; what was looked at.

    Raises:
        CliError: it is so, as the node at the door knows, or nobody answers.
    """
    held = in_force(door)
    if held.text and not has_flag(held, kind, name):
        raise OverError(EXIT_FAILED, told_over(kind, [name]))
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


def _why_it_stays(name: str, found: Mapping[str, Json]) -> str:
    """The last judgement of some robot, with what keeps the other candidates from the task."""
    for status in found.values():
        task = told_task(status, name)
        if task and task["decision"] is not None:
            vetoed = task["decision"]["vetoed"]
            why = "; ".join(f"{other}: {veto}" for other, veto in vetoed.items() if other != task["owner"])
            return f"{task['decision']['reason']}{f' ({why})' if why else ''}"
    return ""
