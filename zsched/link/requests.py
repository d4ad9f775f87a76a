"""Operators' requests as commands, and nodes' answers as JSON (pure): the words of the operators' socket.

Knows: the words of every request and answer. Does not know: who asks, where, who waits for an answer.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from zsched.core.values import codec as wire
from zsched.core.values.decision import Decision, Explanation
from zsched.core.values.document import Document, Flag, Rollout, Text
from zsched.core.values.errors import WireError
from zsched.core.values.messages import (
    ChangeFleet,
    Command,
    CommandOutcome,
    CommandResult,
    ExplainTask,
    FleetTold,
    HistoryTold,
    Hold,
    HoldTask,
    MoveTask,
    ReadFleet,
    ReadHistory,
    ReadLines,
    RestartTask,
    TakeCertificate,
    TuneTask,
    WorkerLines,
)
from zsched.core.values.model import MAX_REASON, Asked, Tuning
from zsched.core.values.rehearsal import KeepRehearsal, ReadRehearsals, RehearsalsTold, Step, Strike
from zsched.core.values.report import plain, snapshot_json
from zsched.core.values.snapshot import Snapshot
from zsched.core.values.words import MAX_ASKER


def _asked_of(request: dict[str, Any]) -> Asked:
    return Asked(by=str(request["by"])[:MAX_ASKER], reason=str(request.get("reason") or ""))


def _whole(request: dict[str, Any], name: str) -> int | None:
    number = request.get(name)
    if number is not None and type(number) is not int:
        raise ValueError(f"{name}: expected a whole number, not {number!r:.80}")
    return number


def _move_of(request: dict[str, Any]) -> MoveTask:
    origin = request.get("origin")
    return MoveTask(
        task=str(request["task"]),
        node=str(request["target"]),
        asked=_asked_of(request),
        origin=None if origin is None else str(origin),
        base_revision=_whole(request, "base_revision"),
        is_plan=bool(request.get("plan")),
    )


def _hold_of(request: dict[str, Any]) -> HoldTask:
    for_s = request.get("for_s")
    return HoldTask(
        task=str(request["task"]),
        hold=Hold(str(request["hold"])),
        asked=_asked_of(request),
        node=str(request.get("target") or ""),
        is_hard=bool(request.get("hard")),
        for_s=None if for_s is None else float(for_s),
        base_revision=_whole(request, "base_revision"),
    )


def _tune_of(request: dict[str, Any]) -> TuneTask:
    try:
        tuning = wire.from_plain(request["tuning"], Tuning)
    except WireError as error:
        raise ValueError(f"tuning: {error}") from error
    base = _whole(request, "base_revision")
    if base is None:
        raise KeyError("base_revision")
    return TuneTask(task=str(request["task"]), tuning=tuning, base_revision=base, asked=_asked_of(request))


def _explain_of(request: dict[str, Any]) -> ExplainTask:
    return ExplainTask(task=str(request["task"]))


def _restart_of(request: dict[str, Any]) -> RestartTask:
    return RestartTask(task=str(request["task"]), asked=_asked_of(request) if "by" in request else None)


def _certificate_of(request: dict[str, Any]) -> TakeCertificate:
    return TakeCertificate(certificate=Text(str(request["certificate"])))


def _lines_of(request: dict[str, Any]) -> ReadLines:
    after = request.get("after", 0)
    if type(after) is not int:
        raise ValueError(f"after: expected a whole number, not {after!r:.80}")
    return ReadLines(task=str(request["task"]), after=after)


def _history_of(request: dict[str, Any]) -> ReadHistory:
    return ReadHistory(cursor=str(request.get("cursor") or ""))


def _change_of(request: dict[str, Any]) -> ChangeFleet:
    """The whole document, or one elector: exactly one of them is named."""
    base, text = request.get("base_revision"), request.get("text")
    if base is not None and type(base) is not int:
        raise ValueError(f"base_revision: expected a whole number, not {base!r:.80}")
    if text is not None and not isinstance(text, str):
        raise ValueError(f"text: expected the text of a fleet file, not {text!r:.80}")
    try:
        flags = tuple(wire.from_plain(flag, Flag) for flag in request.get("flags", ()))
        rollouts = tuple(wire.from_plain(one, Rollout) for one in request.get("rollouts", ()))
    except WireError as error:
        raise ValueError(f"flags, or rollouts: {error}") from error
    return ChangeFleet(
        document=None if text is None else Document(text=Text(text), flags=flags, rollouts=rollouts),
        add_elector=str(request.get("add_elector") or ""),
        disk=str(request.get("disk") or ""),
        remove_elector=str(request.get("remove_elector") or ""),
        base_revision=base,
        reason=str(request.get("reason") or "")[:MAX_REASON],
        asked=_asked_of({"by": request["by"], "reason": request.get("why")}) if "by" in request else None,
    )


def _fleet_of(request: dict[str, Any]) -> ReadFleet:
    return ReadFleet(with_document=request.get("with_document") is not False)


def _strike_of(request: dict[str, Any]) -> Strike:
    return Strike(
        task=str(request["task"]),
        step=Step(str(request["step"])),
        asked=_asked_of(request),
        cut_s=float(request.get("cut_s") or 0.0),
        is_plan=bool(request.get("plan")),
    )


def _keep_of(request: dict[str, Any]) -> KeepRehearsal:
    return KeepRehearsal(
        task=str(request["task"]),
        name=str(request["name"]),
        body=Text(str(request["body"])),
        told=str(request["told"])[:MAX_REASON],
        asked=_asked_of(request),
    )


def _rehearsals_of(request: dict[str, Any]) -> ReadRehearsals:
    return ReadRehearsals(task=str(request.get("task") or ""), name=str(request.get("name") or ""))


COMMANDS: Final[dict[str, Callable[[dict[str, Any]], Command]]] = {
    "move": _move_of,
    "hold": _hold_of,
    "tune": _tune_of,
    "explain": _explain_of,
    "restart": _restart_of,
    "lines": _lines_of,
    "history": _history_of,
    "certificate": _certificate_of,
    "change": _change_of,
    "fleet": _fleet_of,
    "strike": _strike_of,
    "keep": _keep_of,
    "rehearsals": _rehearsals_of,
}


def command_of(request: dict[str, Any]) -> Command:
    """The command of a request of the socket.

    Raises:
        KeyError, TypeError, ValueError, OverflowError: something is missing or wrong.
    """
    return COMMANDS[request["verb"]](request)


def unknown(why: str) -> CommandResult:
    """The answer to an order of which nobody tells what has become."""
    return CommandResult(outcome=CommandOutcome.UNKNOWN, detail=why)


def answer_json(value: object) -> dict[str, Any]:
    """A node's answer as the socket tells it."""
    if isinstance(value, Snapshot):
        return snapshot_json(value)
    if isinstance(value, Explanation):
        return {"explanation": wire.as_plain(value), "sums": _sums(value.decision)}
    if isinstance(value, WorkerLines):
        lines = [{"number": line.number, "age_s": line.age_s, "text": line.text} for line in value.lines]
        body = {"node": value.node, "task": value.task, "lines": lines}
        return {**body, "newest": value.newest, "is_here": value.is_here}
    if isinstance(value, HistoryTold):
        entries = [{**wire.as_plain(line), "task": line.task, "text": line.text} for line in value.lines]
        told = {"node": value.node, "now": value.now, "entries": entries}
        return {**told, "cursor": value.cursor, "more": value.has_more}
    if isinstance(value, FleetTold):
        return _fleet_json(value)
    if isinstance(value, RehearsalsTold):
        promised = {one.step.value: wire.as_plain(one) for one in value.promised}
        kept = {"names": list(value.names), "body": value.body}
        return {"node": value.node, "timing": value.timing, "promised": promised, **kept}
    assert isinstance(value, CommandResult)
    return {"outcome": value.outcome.value, "detail": value.detail, "revision": value.revision}


def _sums(decision: Decision | None) -> dict[str, Any] | None:
    """The sums of a judgement: so the tool that asks need not load the scheduler."""
    from zsched.core.scheduler.explain import explained  # noqa: PLC0415 - only a daemon that is asked pays for it

    return None if decision is None else plain(explained(decision))


def _fleet_json(told: FleetTold) -> dict[str, Any]:
    """By which fleet value a node goes; its revision is ``None`` while it knows none."""
    value, content = told.value, told.content
    body = {"node": told.node, "fleet_file": told.fleet_file, "disk": told.disk}
    if value is None:
        return {**body, "revision": None}
    electors = [{"name": one.name, "disk": one.disk, "joining": one.joining} for one in value.electors]
    flags = [] if content is None else [wire.as_plain(flag) for flag in content.flags]
    rollouts = [] if content is None else [wire.as_plain(one) for one in content.rollouts]
    return {
        **body,
        "fleet": value.fleet,
        "generation_id": value.generation_id,
        "revision": value.revision,
        "number": value.number,
        "settled": value.settled,
        "electors": electors,
        "document": value.document,
        "text": "" if content is None else content.text,
        "flags": flags,
        "rollouts": rollouts,
        "value": wire.as_plain(value),
    }
