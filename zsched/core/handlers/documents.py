"""The fleet register and its documents at the door: questions, answers, an operator's changes, what was stored.

Knows: which part takes each of them. Does not know: how a change is agreed (`zsched.core.electorate`), what a changed
fleet means to each stage.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

from zsched.core import events as ev
from zsched.core import instructions as do
from zsched.core.stages import Handler, Stages
from zsched.core.todo import ToDo
from zsched.core.values.fleet import Fleet, fleet_hash
from zsched.core.values.messages import FleetTold


def take_effect(node: Stages, fleet: Fleet, todo: ToDo, now: float) -> None:
    """Another fleet is in force: its document is stored, the value with it is learnt, the registers count by it."""
    del todo, now
    has_changed = replace(fleet, electors=node.fleet.electors, timing=node.fleet.timing) != node.fleet
    node.fleet = fleet
    node.agreement.adopt(fleet)
    if has_changed:
        node.set_problem("fleet/restart", "another document is agreed: restart this daemon, and it goes by all of it")
    compare_file(node)


def compare_file(node: Stages) -> None:
    """Show whether this machine's fleet file says something else than the agreed document."""
    agreed = node.agreement.document
    complaint = None
    if agreed is not None and fleet_hash(agreed) != node.by_file:
        complaint = (
            f"the fleet file here differs from the agreed document, by which this node goes; what it would change: "
            f"`zsched apply {node.fleet_path} --plan`; to take the document: `zsched fleet export -o {node.fleet_path}`"
        )
    node.set_problem("fleet/file", complaint)


def _on_asked(node: Stages, event: ev.FleetAsked, todo: ToDo, now: float) -> None:
    node.agreement.on_fleet_asked(event, todo, now)


def _on_answered(node: Stages, event: ev.FleetAnswered, todo: ToDo, now: float) -> None:
    node.agreement.on_fleet_answer(event, todo, now)


def _on_commanded(node: Stages, event: ev.FleetCommanded, todo: ToDo, now: float) -> None:
    node.agreement.orders.take(event, todo, now)


def _on_document_asked(_node: Stages, event: ev.DocumentAsked, todo: ToDo, _now: float) -> None:
    todo.add(do.AnswerDocument(request=event.request, document=event.document))


def _on_stored(node: Stages, event: ev.DocumentStored, todo: ToDo, now: float) -> None:
    node.agreement.on_stored(event, todo, now)


def _on_refused(node: Stages, event: ev.DocumentRefused, todo: ToDo, _now: float) -> None:
    node.agreement.on_refused(event, todo)


def _on_read(node: Stages, event: ev.FleetReadAsked, todo: ToDo, _now: float) -> None:
    agreement = node.agreement
    told = FleetTold(node=node.me, value=agreement.fleet_value, fleet_file=node.fleet_file, disk=agreement.disk)
    wanted = event.command.with_document
    todo.add(do.AnswerFleetRead(request=event.request, told=told, with_document=wanted))


HANDLERS: Final[Mapping[type[Any], Handler]] = {
    ev.FleetAsked: _on_asked,
    ev.FleetAnswered: _on_answered,
    ev.FleetCommanded: _on_commanded,
    ev.DocumentAsked: _on_document_asked,
    ev.DocumentStored: _on_stored,
    ev.DocumentRefused: _on_refused,
    ev.FleetReadAsked: _on_read,
}
