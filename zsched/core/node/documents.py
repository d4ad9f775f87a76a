"""The fleet register and its documents at the door: questions, answers, an operator's changes, what was stored.

Knows: which part takes each of them. Does not know: how a change is agreed (`zsched.core.electorate`), what a changed
fleet means to each stage.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from zsched.core.node.fleet import compare_file, follow, go_by
from zsched.core.node.stages import Handler, Stages
from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.fleet import Fleet
from zsched.core.values.messages import FleetTold
from zsched.core.values.todo import ToDo


def take_effect(node: Stages, fleet: Fleet, todo: ToDo, now: float) -> None:
    """Another fleet is in force: its document is stored, the value with it is learnt, the registers count by it."""
    follow(node, fleet, todo, is_agreed=True)
    go_by(node, fleet, todo, now)
    compare_file(node)
    count_voters(node, todo)
    take_flags(node, todo, now)


def take_flags(node: Stages, todo: ToDo, now: float) -> None:
    """Go by the flags of the document in force."""
    for text in node.flags.take(node.agreement.flags, now):
        todo.add(do.RecordStory(stage="membership", text=text))
        todo.must_decide = True


def count_voters(node: Stages, todo: ToDo) -> None:
    """Go by the robots that are not away, and by the electors that are agreed."""
    node.in_force.count(node.agreement.voters, node.agreement.electors)
    todo.must_decide = True


def _on_asked(node: Stages, event: ev.FleetAsked, todo: ToDo, now: float) -> None:
    node.agreement.acceptor.on_fleet_asked(event, todo, now)


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
    told = FleetTold(node=node.me, value=agreement.fleet_value, fleet_file=node.text_hash, disk=agreement.disk)
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
