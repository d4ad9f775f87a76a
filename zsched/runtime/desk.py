"""Operators' questions over the local socket: each is posted into the loop or sent to another node, and awaited.

Knows: which answers are awaited, who may give orders. Does not know: the words (`zsched.link.requests`), what a command
leads to (`zsched.core.node`), who is let in (`zsched.host.operator_socket`).
"""

from __future__ import annotations

import itertools
import queue
import threading
from collections.abc import Callable
from typing import Any

from zsched.core.values import events as ev
from zsched.core.values.errors import AdapterError
from zsched.core.values.in_force import InForce
from zsched.core.values.messages import Agreed, Asking, Command, asked_at
from zsched.core.values.model import NodeId
from zsched.core.values.words import NAME
from zsched.link.bus.control_bus import ControlBus
from zsched.link.requests import COMMANDS, answer_json, command_of, unknown
from zsched.runtime.inbox import Inbox

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
        if verb in COMMANDS:
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
        known = ", ".join(sorted(("access", "leave", "log", "status", *COMMANDS)))
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
