"""Shows ROS 2 nodes the endpoints that they really talk to: watches graph tokens, declares the mirrored ones.

Knows: liveliness tokens of both sides, which of them are ours. Does not know: which endpoints to mirror
(`zsched.core.route.ros_mirror` decides), slots, samples.

Nothing is watched, and no thread runs, before the first stream of a ROS graph.
"""

from __future__ import annotations

import logging
import queue
import threading
from functools import partial
from typing import Any, Final

import zenoh
from zenoh import Sample, SampleKind, Session

from zsched.core.route.ros2 import Endpoint, endpoint_token, node_token, parse_token, ros_node_name, token_selector
from zsched.core.route.ros_mirror import Sides, mirrored
from zsched.core.values.model import NodeId, TaskId
from zsched.core.values.plan import RosGraph, Route
from zsched.core.values.struct import Struct, field
from zsched.host.guard import guarded, tolerant
from zsched.relay.streams.receive import undeclare

MAX_TOKENS: Final = 20_000
"""Foreign tokens remembered per side; those of a larger graph are not mirrored."""

_log = logging.getLogger("zsched.relay")

_Item = tuple[TaskId, tuple[Route, ...]] | tuple["_Side", Sample] | tuple[None, Session]
_Wanted = dict[tuple[RosGraph, Endpoint | str], None]


class _Side(Struct, eq=False):
    """One session's part of the graph: what others announce there, and what we do."""

    session: Session
    zid: str
    seen: dict[str, Endpoint] = field(default_factory=dict)
    declared: dict[tuple[RosGraph, Endpoint | str], zenoh.LivelinessToken] = field(default_factory=dict)
    watches: dict[RosGraph, Any] = field(default_factory=dict)
    number: int = 0

    def note(self, key: str, *, is_present: bool, own_ids: frozenset[str]) -> None:
        """A token came or went."""
        if not is_present:
            self.seen.pop(key, None)
            return
        parsed = parse_token(key)
        if parsed is not None and parsed[0] not in own_ids and len(self.seen) < MAX_TOKENS:
            self.seen[key] = parsed[1]

    def declare(self, wanted: _Wanted, node: str) -> None:
        """Announce what is wanted and is not announced yet; take the rest back."""
        for known in tuple(self.declared):
            if known not in wanted:
                undeclare(self.declared.pop(known))
        for name in wanted:
            if name in self.declared:
                continue
            graph, what = name
            key = self._key(graph, what, node)
            if key is None:
                continue
            try:
                self.declared[name] = self.session.liveliness().declare_token(key)
            except zenoh.ZError as error:
                _log.warning("the endpoint %s cannot be announced (%s)", key, error)

    def _key(self, graph: RosGraph, what: Endpoint | str, node: str) -> str | None:
        if isinstance(what, str):
            return node_token(graph, domain=what, zid=self.zid, node=node)
        self.number += 1
        return endpoint_token(graph, what, zid=self.zid, node=node, number=self.number)


class GraphMirror:
    """One relay's part in the ROS graph. `set_routes` may be called from any thread and never blocks."""

    def __init__(self, fleet: Session, local: Session | None, node: NodeId) -> None:
        """``local`` is `None` when one session serves both sides."""
        self._node = ros_node_name(node)
        self._fleet = _Side(fleet, str(fleet.zid()))
        self._local = self._fleet if local is None else _Side(local, str(local.zid()))
        self._own_ids = frozenset({self._fleet.zid, self._local.zid})
        self._routes: dict[TaskId, tuple[Route, ...]] = {}
        self._queue: queue.SimpleQueue[_Item] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None

    def rejoin(self, fleet: Session) -> None:
        """Another session serves the fleet's side, the one before is closed; the host's own side stays."""
        with self._lock:
            if self._thread is None:
                self._take((None, fleet))
            else:
                self._queue.put((None, fleet))

    def set_routes(self, task: TaskId, routes: tuple[Route, ...]) -> None:
        """Take the routes of all open slots of a task; they replace the ones before."""
        with self._lock:
            if self._thread is None and all(route.settings.graph is RosGraph.NONE for route in routes):
                return
            if self._thread is None:
                thread = guarded(self._run, name="ros graph")
                thread.start()
                self._thread = thread
        self._queue.put((task, routes))

    # --- the thread --------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        while True:
            item = self._queue.get()
            try:
                self._take(item)
                while not self._queue.empty():  # a burst of tokens is one change
                    self._take(self._queue.get())
                self._reconcile()
            except Exception:  # noqa: BLE001 - a token that trips a bug must not end the mirror
                _log.exception("the ROS graph cannot be mirrored")

    def _take(self, item: _Item) -> None:
        first, second = item
        if isinstance(second, Session):
            graphs = tuple(self._fleet.watches)
            self._fleet = _Side(second, str(second.zid()))
            self._own_ids = frozenset({self._fleet.zid, self._local.zid})
            for graph in graphs:
                self._watch(graph)
            return
        if isinstance(first, _Side) and isinstance(second, Sample):
            first.note(str(second.key_expr), is_present=second.kind == SampleKind.PUT, own_ids=self._own_ids)
        elif isinstance(first, str) and isinstance(second, tuple):
            self._routes[first] = tuple(route for route in second if route.settings.graph is not RosGraph.NONE)
            for route in self._routes[first]:
                self._watch(route.settings.graph)

    def _watch(self, graph: RosGraph) -> None:
        for side in {id(side): side for side in (self._local, self._fleet)}.values():
            if graph in side.watches:
                continue
            side.watches[graph] = side.session.liveliness().declare_subscriber(
                token_selector(graph), tolerant(partial(self._enqueue, side), "graph"), history=True
            )

    def _enqueue(self, side: _Side, sample: Sample) -> None:
        self._queue.put((side, sample))

    def _reconcile(self) -> None:
        local: _Wanted = {}
        fleet: _Wanted = local if self._local is self._fleet else {}
        for graph in (RosGraph.RMW_ZENOH, RosGraph.ROS2DDS):
            routes = [route for routes in self._routes.values() for route in routes if route.settings.graph is graph]
            seen = Sides(local=frozenset(self._local.seen.values()), fleet=frozenset(self._fleet.seen.values()))
            wanted = mirrored(routes, seen) if routes else Sides(frozenset(), frozenset())
            for room, endpoints in ((local, wanted.local), (fleet, wanted.fleet)):
                for endpoint in sorted(endpoints, key=lambda one: (one.kind, one.key, one.qos)):
                    room[graph, endpoint.key.partition("/")[0]] = None  # the node itself, once per domain
                    room[graph, endpoint] = None
        for side, room in ((self._local, local), (self._fleet, fleet)):
            side.declare(room, self._node)
