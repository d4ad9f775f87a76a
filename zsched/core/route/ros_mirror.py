"""Decides which endpoints a relay announces in the ROS graph, so that graph tools see the real ends of a stream.

Knows: routes, endpoints seen on either side, capture. Does not know: tokens' spelling, zenoh, when routes change.

A stream joins publishers on its ``from`` side with subscriptions on its ``to`` side. ROS nodes count these: some
publish only while a subscription matches, and a client waits for its service. So each side is shown the other side's
endpoints under its own names: publishers forwards, subscriptions backwards, servers backwards, clients forwards. Where
the far end is no ROS node (a plain key), the relay stands in for it: it subscribes to every publisher that it forwards,
and publishes (or serves) as soon as the route exists.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Final

from zsched.core.route import keyexpr
from zsched.core.route.ros2 import Endpoint, EndpointKind, default_qos, is_rmw_key
from zsched.core.route.wildcards import Rewriter, rewriter, wildcards
from zsched.core.values.plan import Direction, RosGraph, Route, StreamClass
from zsched.core.values.struct import Struct

MAX_ENDPOINTS: Final = 2000
"""Endpoints announced per side; a graph with more is shown in part."""

_FORWARDS: Final = {EndpointKind.PUBLISHER, EndpointKind.CLIENT}
_BACKWARDS: Final = {EndpointKind.SUBSCRIPTION, EndpointKind.SERVICE}
_STREAM_KINDS: Final = {EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION}


class Sides(Struct, frozen=True):
    """Endpoints by side; both fields hold the same when one session serves both."""

    local: frozenset[Endpoint]
    fleet: frozenset[Endpoint]


def mirrored(routes: Iterable[Route], seen: Sides) -> Sides:
    """The endpoints to announce on each side for ``routes``, given the others' endpoints there (``seen``)."""
    local: dict[Endpoint, None] = {}
    fleet: dict[Endpoint, None] = {}
    for route in routes:
        is_output = route.direction is Direction.OUTPUT
        near, far = (seen.fleet, seen.local) if is_output else (seen.local, seen.fleet)
        at_from, at_to = _of_route(route, near, far)
        (fleet if is_output else local).update(dict.fromkeys(at_from))
        (local if is_output else fleet).update(dict.fromkeys(at_to))
    return Sides(frozenset(list(local)[:MAX_ENDPOINTS]), frozenset(list(fleet)[:MAX_ENDPOINTS]))


def _of_route(
    route: Route, near: frozenset[Endpoint], far: frozenset[Endpoint]
) -> tuple[list[Endpoint], list[Endpoint]]:
    """(announced where ``from`` is, announced where ``to`` is)."""
    kinds = set(EndpointKind) - _STREAM_KINDS if route.direction is Direction.SERVICE else _STREAM_KINDS
    before = sorted((one for one in near if one.kind in kinds & _FORWARDS), key=_order)
    behind = sorted((one for one in far if one.kind in kinds & _BACKWARDS), key=_order)
    if route.settings.graph is RosGraph.ROS2DDS:
        return list(_backwards(route, behind)), list(_moved(before, rewriter(route.from_expr, route.to_expr)))
    is_ros_from, is_ros_to = is_rmw_key(route.from_expr), is_rmw_key(route.to_expr)
    at_from: list[Endpoint] = []
    at_to: list[Endpoint] = []
    if is_ros_from and is_ros_to:
        at_from += _backwards(route, behind)
        at_to += _moved(before, rewriter(route.from_expr, route.to_expr))
    elif is_ros_from:
        at_from += _stand_in_for_reader(route, before)
    elif is_ros_to and not keyexpr.is_wild(route.to_expr):
        at_to.append(_announced(route, EndpointKind.PUBLISHER, route.to_expr))
    return at_from, at_to


def _stand_in_for_reader(route: Route, before: list[Endpoint]) -> Iterator[Endpoint]:
    """The far end takes plain keys: our relay subscribes to every publisher here and serves every client."""
    if route.direction is Direction.SERVICE:
        if not keyexpr.is_wild(route.from_expr):
            yield _announced(route, EndpointKind.SERVICE, route.from_expr)
            return
        for one in before:
            if keyexpr.matches(route.from_expr, one.key):
                yield Endpoint(kind=EndpointKind.SERVICE, key=one.key, qos=one.qos)
        return
    for one in before:
        if keyexpr.matches(route.from_expr, one.key):
            yield Endpoint(kind=EndpointKind.SUBSCRIPTION, key=one.key, type_name=one.type_name, qos=one.qos)


def _announced(route: Route, kind: EndpointKind, key: str) -> Endpoint:
    is_latched = route.settings.stream_class is StreamClass.LATEST and route.direction is not Direction.SERVICE
    depth = max(1, route.settings.keep_last) if is_latched else 10
    return Endpoint(kind=kind, key=key, qos=default_qos(is_latched=is_latched, depth=depth))


def _backwards(route: Route, endpoints: list[Endpoint]) -> Iterator[Endpoint]:
    if len(wildcards(route.from_expr)) != len(wildcards(route.to_expr)):
        return  # a wildcard is dropped on the way: which key it was cannot be told
    yield from _moved(endpoints, rewriter(route.to_expr, route.from_expr))


def _moved(endpoints: list[Endpoint], rewrite: Rewriter) -> Iterator[Endpoint]:
    for one in endpoints:
        key = rewrite(one.key)
        if key is not None:
            yield Endpoint(kind=one.kind, key=key, type_name=one.type_name, qos=one.qos)


def _order(endpoint: Endpoint) -> tuple[str, str, str]:
    return endpoint.kind, endpoint.key, endpoint.qos
