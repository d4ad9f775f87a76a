"""ROUTE: the plan of one task for this robot's relay, and its other duties for the task.

Knows: slots, plans, watches. Does not know: when a handover may go on (`zsched.core.executor.handover`), zenoh,
processes.
"""

from __future__ import annotations

from zsched.core.relay_protocol import WorkerWatch
from zsched.core.route import keyexpr
from zsched.core.route.templates import fill, routes_for, widened
from zsched.core.values.fleet import Fleet, Standby, TaskSpec, runs_worker
from zsched.core.values.model import NodeId, NodeKind
from zsched.core.values.plan import Direction, ReadyWhen, RosGraph, Route, RoutePhase, RoutePlan, Slot

NOBODY = "Nobody"
"""No node has this name (names have no capitals): only a subscriber to everything takes its samples."""


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
        exclusive=spec.exclusive,
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
