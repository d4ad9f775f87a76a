"""Lets a running daemon's adapters follow another fleet file; what they cannot follow is reported.

Knows: which adapter is made from which part of the file. Does not know: what the node makes of it
(`zsched.core.node.fleet`).
"""

from __future__ import annotations

import logging
from collections.abc import Callable

from zsched.core.route.route import watch_for
from zsched.core.values import events as ev
from zsched.core.values.endpoint import Endpoint
from zsched.core.values.fleet import Fleet
from zsched.core.values.in_force import InForce
from zsched.core.values.model import NodeId, TaskId
from zsched.core.values.relay_protocol import WorkerWatch
from zsched.core.values.struct import Struct, field
from zsched.host.workers.supervisor import WorkerSupervisor
from zsched.link.bus.control_bus import ControlBus
from zsched.link.bus.limits import limit_for
from zsched.link.bus.sealing import orderers_of
from zsched.link.sessions.access_rules import names_of
from zsched.link.sessions.endpoints import Endpoints, endpoints_for
from zsched.link.sessions.restarts import moved, opens_anew, restarts, waits_for
from zsched.runtime.crew import Crew
from zsched.runtime.recipes import Recipes
from zsched.runtime.relay.streams import RelayHandle
from zsched.runtime.sampler import Sampler

SOURCE = "restart"
"""Of the problem that says what a restart is needed for."""

_log = logging.getLogger("zsched.daemon")


def tell_orders(fleet: Fleet, bus: ControlBus) -> None:
    """Whose orders count from now on."""
    if fleet.security is not None:
        bus.take_orders_of(orderers_of(fleet, fleet.security))


class Adoption(Struct, kw_only=True):
    """The adapters of one daemon that follow the fleet file."""

    me: NodeId
    here: InForce
    """What the desk and the ways to streams go by."""
    started_with: Fleet
    points: Endpoints
    """Where its sessions listen and which nodes they dial, since the start."""
    protocol: str
    recipes: Recipes
    crew: Crew
    supervisor: WorkerSupervisor
    relay: RelayHandle
    bus: ControlBus
    post: Callable[[ev.Event], None]
    sampler: Sampler
    compare_sessions: Callable[[bool, tuple[NodeId, ...]], None]
    """Told whether the open sessions let in others than the file that is gone by says, and whom they dial elsewhere."""
    _watches: dict[TaskId, WorkerWatch | None] = field(default_factory=dict)

    def begin(self) -> None:
        """Tell the relay what it watches, by the file that the daemon starts with."""
        self._tell_watches(self.started_with)

    def follow(self, fleet: Fleet, is_agreed: bool = False) -> None:
        """Follow another file of the same fleet, which names this node with the same kind.

        Args:
            fleet: the file.
            is_agreed: it is an agreed document, with the electors in force.

        Raises:
            AdapterError: a worker's session cannot be written; all adapters stay as they are.
        """
        listen = self.points.data_listen[0]
        points = endpoints_for(
            fleet, fleet.node(self.me), lambda: Endpoint.of(listen).port or 1, protocol=self.protocol
        )
        connect = (self.points.worker_connect[0], *points.worker_connect[1:])
        self.recipes.make(fleet, connect, dials_by_gossip=points.worker_by_gossip)
        _log.info("fleet_file node=%s: adapters follow another one", self.me)
        self.crew.on_fleet(fleet, self.recipes.paths)
        self.supervisor.keep(self.recipes.specs)
        self.crew.keep(self.recipes.specs)
        self.here.take(fleet)
        is_exclusive = any(task.exclusive for task in fleet.tasks)
        self.sampler.measure(fleet.node(self.me), fleet.timing.sample_s, is_watched=is_exclusive)
        self.bus.know(names_of(fleet), limit_for(fleet.timing, len(fleet.tasks)))
        tell_orders(fleet, self.bus)
        if is_exclusive:
            self.bus.hear_all_at_once()
        self._tell_watches(fleet)
        begins_again = opens_anew(self.started_with, fleet)
        self.compare_sessions(begins_again, moved(self.started_with, fleet, self.me))
        needs = restarts(self.started_with, fleet, self.me, is_agreed=is_agreed)
        self.post(ev.ProblemReported(source=SOURCE, problem=waits_for(needs, begins_again)))

    def end(self, task: TaskId) -> None:
        """The relay ends everything of a task, also what it watches, which one of that name that follows needs again.

        A task that was removed and added again, unheard here, is in the fleet before and after.
        """
        self.relay.end(task)
        watch = self._watches.get(task)
        if watch is not None:
            self.relay.watch(watch)

    def _tell_watches(self, fleet: Fleet) -> None:
        found = {task.name: watch_for(fleet, task, self.me) for task in fleet.tasks}
        for task, watch in found.items():
            if watch != self._watches.get(task):
                self.relay.watch(watch or WorkerWatch(task=task))
        self._watches = found
