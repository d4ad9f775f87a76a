"""What operators ask over the local socket: requests become commands, answers become JSON.

Knows: the words of every request, which answers are awaited. Does not know: what a command leads to
(`zsched.core.handlers`), who is let in (`zsched.adapters.host.operator_socket`).
"""

from __future__ import annotations

import itertools
import queue
import threading
from collections.abc import Callable
from typing import Any

from zsched.adapters.network.control_bus import ControlBus
from zsched.core import events as ev
from zsched.core.report import plain, snapshot_json
from zsched.core.values.decision import Decision, Explanation
from zsched.core.values.document import Document, Flag, Rollout, Text
from zsched.core.values.in_force import InForce
from zsched.core.values.messages import (
    Agreed,
    Asking,
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
    asked_at,
)
from zsched.core.values.model import MAX_REASON, Asked, NodeId, Tuning
from zsched.core.values.rehearsal import KeepRehearsal, ReadRehearsals, RehearsalsTold, Step, Strike
from zsched.core.values.snapshot import Snapshot
from zsched.core.values.words import MAX_ASKER, NAME
from zsched.errors import AdapterError, WireError
from zsched.runtime.inbox import Inbox
from zsched.wire import codec as wire

ANSWER_TIMEOUT_S = 3.0
"""For the answer to a question, and for the end of an order that a node knows at once."""
LOCAL_REQUESTS_FROM = 1 << 40
"""Numbers of questions that came over the operator socket; smaller ones came over the bus."""


class Desk:
    """Operators' questions from the local socket: posted into the loop, awaited in the socket's thread."""

    def __init__(
        self,
        node: NodeId,
        inbox: Inbox,
        bus: ControlBus,
        in_force: InForce,
        access: Callable[[NodeId], dict[str, Any]] | None = None,
        log: Callable[[dict[str, Any]], dict[str, Any]] | None = None,
        leave: Callable[[], None] | None = None,
    ) -> None:
        """``access`` says how a tool on this machine joins a node's data network, ``log`` tells of the decision log.

        ``leave`` ends this daemon for good.
        """
        self._node, self._inbox, self._bus = node, inbox, bus
        self._access, self._log, self._leave = access, log, leave
        self._numbers = itertools.count(LOCAL_REQUESTS_FROM)
        self._waiting: dict[int, queue.SimpleQueue[object]] = {}
        self._lock = threading.Lock()
        self._in_force = in_force

    def answer(self, request: dict[str, Any]) -> dict[str, Any]:
        """Answer one request of the socket (``status``, ``explain``, ``log``, ``move``, ...).

        With ``node``: what another node answers.
        """
        verb, node = request["verb"], request.get("node") or self._node
        if not isinstance(node, str) or not NAME.fullmatch(node):
            return {"error": f"node: {node!r:.80} is not a name"}
        if verb == "status":
            return self._ask(node, None)
        if verb in _COMMANDS:
            try:
                command = command_of(request)
            except KeyError as error:
                return {"error": f"{verb}: {error} is missing"}
            except (TypeError, ValueError, OverflowError) as error:
                return {"error": f"{verb}: {error}"}
            return self._ask(node, asked_at(self._node, command))
        if verb == "access" and self._access is not None:
            return self._access(node)
        if verb == "log" and self._log is not None:
            return self._log(request) if node == self._node else {"error": f"the log of {node} is told on {node} only"}
        if verb == "leave" and self._leave is not None:
            if node != self._node:
                return {"error": f"{node} leaves by a command on its own machine: zsched leave"}
            self._leave()
            return {"outcome": "ok"}
        known = ", ".join(sorted(("access", "leave", "log", "status", *_COMMANDS)))
        return {"error": f"unknown verb {verb!r:.80}; known: {known}"}

    def _ask(self, node: NodeId, command: Command | None) -> dict[str, Any]:
        fleet = self._in_force.fleet
        within_s = fleet.timing.order_s if isinstance(command, Agreed) else ANSWER_TIMEOUT_S
        orders_of = None if fleet.security is None else fleet.security.orders
        is_order = command is not None and not isinstance(command, Asking)
        if is_order and orders_of is not None and self._node not in orders_of:
            others = f"{' and '.join(orders_of) or 'no node'} may (`security: {{orders: [...]}}`)"
            instead = "order there, or by an operator's certificate with --connect"
            return {"error": f"{self._node} gives no orders in this fleet, {others}; {instead}"}
        if node != self._node:
            try:
                return answer_json(self._bus.ask_node(node, command, within_s))
            except AdapterError as error:
                if is_order and isinstance(error.__cause__, TimeoutError):
                    return answer_json(unknown(f"{node} did not answer within {within_s:g} s"))
                return {"error": str(error)}
        number = next(self._numbers)
        slot: queue.SimpleQueue[object] = queue.SimpleQueue()
        with self._lock:
            self._waiting[number] = slot
        self._inbox.post(
            ev.StatusAsked(request=number) if command is None else ev.commanded(number, command, is_near=True)
        )
        try:
            return answer_json(slot.get(timeout=within_s))
        except queue.Empty:
            why = f"the decision loop of {self._node} did not answer within {within_s:g} s"
            return answer_json(unknown(why)) if is_order else {"error": why}
        finally:
            with self._lock:
                self._waiting.pop(number, None)

    def deliver(self, number: int, value: object) -> None:
        """The loop's answer; nobody waiting any more is no error."""
        with self._lock:
            slot = self._waiting.get(number)
        if slot is not None:
            slot.put(value)


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


_COMMANDS: dict[str, Callable[[dict[str, Any]], Command]] = {
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
    return _COMMANDS[request["verb"]](request)


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
