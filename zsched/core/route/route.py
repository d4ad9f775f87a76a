"""ROUTE: the plan of one task for this robot's relay, and its other duties for the task.

Knows: how a template becomes a key, routes, slots, plans, watches. Does not know: which templates are allowed
(`zsched.core.route.templates`), when a handover may go on (`zsched.core.executor.handover`), zenoh, processes.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Final

from zsched.core.route import keyexpr
from zsched.core.values.fleet import Fleet, Standby, StreamRule, TaskSpec, runs_worker
from zsched.core.values.model import NodeId, NodeKind
from zsched.core.values.plan import Direction, ReadyWhen, RosGraph, Route, RoutePhase, RoutePlan, Slot
from zsched.core.values.relay_protocol import WorkerWatch

PLACEHOLDERS: Final = ("robot", "node", "target", "task", "epoch")
BRACES: Final = re.compile(r"\{([^{}]*)\}")

NOBODY = "Nobody"
"""No node has this name (names have no capitals): only a subscriber to everything takes its samples."""


def placeholders(template: str) -> tuple[str, ...]:
    """The names between braces, in order, known or not.

    >>> placeholders("{target}/map_merge/{robot}/map")
    ('target', 'robot')
    """
    return tuple(BRACES.findall(template))


def fill(template: str, **names: str) -> str:
    """``template`` with every placeholder replaced. Raises `KeyError` for a placeholder without a name.

    >>> fill("{robot}/map", robot="robot1")
    'robot1/map'
    """
    return BRACES.sub(lambda match: names[match.group(1)], template)


def widened(template: str, **names: str) -> str:
    """The key expression of everything that ``template`` may become when the placeholders not in ``names`` vary.

    >>> widened("{target}/map_merge/{epoch}/tf", target="edge1")
    'edge1/map_merge/*/tf'
    """
    chunks = [_widened_chunk(chunk, names) for chunk in template.split("/")]
    return keyexpr.canonical("/".join(chunks))


def _widened_chunk(chunk: str, names: Mapping[str, str]) -> str:
    open_names = dict.fromkeys(PLACEHOLDERS, keyexpr.ANY_RUN)
    wide = fill(chunk, **{**open_names, **names})
    while keyexpr.ANY_RUN * 2 in wide:
        wide = wide.replace(keyexpr.ANY_RUN * 2, keyexpr.ANY_RUN)
    return keyexpr.SINGLE if wide == keyexpr.ANY_RUN else wide


def routes_for(task: TaskSpec, robot: NodeId, owner: NodeId, epoch: int) -> tuple[Route, ...]:
    """The streams of ``robot`` towards ``owner`` in ``epoch``, inputs first, in the order of the fleet file.

    Stream names (``<task>/in/<i>``, ``<task>/out/<i>``, ``<task>/srv/<i>``) depend on the rule's place only: counters
    and kept values that hang on them outlive every move.
    """
    names = {"robot": robot, "node": robot, "target": owner, "task": task.name, "epoch": str(epoch)}
    return tuple(
        Route(
            stream=stream,
            direction=rule.direction,
            from_expr=fill(rule.from_template, **names),
            to_expr=fill(rule.to_template, **names),
            settings=rule.settings,
            service=rule.service,
        )
        for stream, rule in named_rules(task)
    )


def named_rules(task: TaskSpec) -> tuple[tuple[str, StreamRule], ...]:
    """(stream name, rule) of ``task``: inputs, outputs, services, each counted from 0."""
    named: list[tuple[str, StreamRule]] = []
    for direction, word in ((Direction.INPUT, "in"), (Direction.OUTPUT, "out"), (Direction.SERVICE, "srv")):
        rules = [rule for rule in task.rules if rule.direction is direction]
        named.extend((f"{task.name}/{word}/{index}", rule) for index, rule in enumerate(rules))
    return tuple(named)


def slot_for(spec: TaskSpec, robot: NodeId, owner: NodeId, epoch: int) -> Slot:
    """The routes of one task between ``robot`` and ``owner`` in ``epoch``, every placeholder filled in."""
    return Slot(
        epoch=epoch,
        owner=owner,
        routes=routes_for(spec, robot, owner, epoch),
        ready_when=spec.worker.ready_when,
    )


def plan_for(spec: TaskSpec, phase: RoutePhase, current: Slot, predecessors: tuple[Slot, ...]) -> RoutePlan:
    """The plan in one phase; in `CLOSE` there are no predecessors any more."""
    return RoutePlan(
        task=spec.name,
        phase=phase,
        current=current,
        predecessors=() if phase is RoutePhase.CLOSE else predecessors,
    )


def watch_for(fleet: Fleet, spec: TaskSpec, me: NodeId) -> WorkerWatch | None:
    """The relay's duties for the task that do not depend on its owner; ``None``: none."""
    kind = fleet.node(me).kind
    inputs: tuple[str, ...] = ()
    strangers: tuple[str, ...] = ()
    services: tuple[tuple[str, ...], ...] = ()
    is_watched = spec.worker.ready_when is ReadyWhen.MATCHING and runs_worker(spec, me, kind)
    if is_watched:
        inputs, strangers = _taken(spec, me), _taken(spec, NOBODY)
        strangers = tuple(key for key in strangers if key not in inputs)
        services = _served(spec, me, fleet.voters)
    standbys = _standbys(spec, me) if kind is NodeKind.ROBOT else ()
    unowned = _unowned(spec, me) if kind is NodeKind.ROBOT else ()
    if not is_watched and not unowned:
        return None
    return WorkerWatch(
        task=spec.name,
        inputs=inputs,
        strangers=strangers,
        services=services,
        standbys=standbys,
        unowned=unowned,
    )


def _taken(spec: TaskSpec, target: NodeId) -> tuple[str, ...]:
    """The inputs of the worker on ``target``, over all robots, one key expression per rule."""
    rules = (rule for rule in spec.rules if rule.direction is Direction.INPUT)
    return tuple(dict.fromkeys(widened(rule.to_template, target=target, task=spec.name) for rule in rules))


def outputs_of(spec: TaskSpec, target: NodeId) -> tuple[str, ...]:
    """What the task's output rules take of the worker on ``target``, one key expression per rule."""
    rules = (rule for rule in spec.rules if rule.direction is Direction.OUTPUT)
    return tuple(dict.fromkeys(widened(rule.from_template, target=target, task=spec.name) for rule in rules))


def _served(spec: TaskSpec, target: NodeId, robots: tuple[NodeId, ...]) -> tuple[tuple[str, ...], ...]:
    """The services of the worker on ``target``, per rule; zenoh cannot tell who serves a key with wildcards."""
    result = []
    for rule in spec.rules:
        if rule.direction is not Direction.SERVICE:
            continue
        filled = (fill(rule.to_template, robot=one, node=one, target=target, task=spec.name) for one in robots)
        keys = tuple(dict.fromkeys(key for key in filled if not keyexpr.is_wild(key)))
        result += [keys] if keys else []
    return tuple(result)


def _unowned(spec: TaskSpec, me: NodeId) -> tuple[Route, ...]:
    """This robot's inputs while the task has no owner yet."""
    return tuple(route for route in routes_for(spec, me, NOBODY, 0) if route.direction is Direction.INPUT)


def _standbys(spec: TaskSpec, me: NodeId) -> tuple[Route, ...]:
    """This robot's inputs towards every candidate: a warm ROS node subscribes to what the graph shows it."""
    if spec.worker.standby is Standby.COLD and spec.worker.command:
        return ()
    return tuple(
        route
        for candidate in spec.candidates
        for route in routes_for(spec, me, candidate, 0)
        if route.direction is Direction.INPUT and route.settings.graph is not RosGraph.NONE
    )
