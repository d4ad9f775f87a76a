"""Runs relays and workers without daemons, on loopback: their moves are driven by hand, as fast as they can go.

Knows: relays' handles, workers' processes, the executor's steps of a handover. Does not know: which streams there are,
what is measured or broken.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

import zenoh

from zsched.core.values.events import RelayChanged, SlotFlipped, SlotReady
from zsched.core.values.fleet import Timing
from zsched.core.values.plan import Role, RoutePhase, RoutePlan, Slot, WorkerRole
from zsched.core.values.relay_protocol import HandleReport, WorkerSeen
from zsched.host.paths import relay_path
from zsched.link.pipe.protocol import RelayHello
from zsched.link.pipe.relay_socket import PROTOCOL
from zsched.link.sessions.config import DEFAULT_TIMING, data_config, worker_config
from zsched.runtime.relay.streams import RelayHandle
from zsched_lab.fleet.loopback import free_endpoint
from zsched_lab.fleet.waiting import DEADLINE_S, until

Kind = TypeVar("Kind")
FLEET, ROBOT, TASK, EDGES = "test", "robot1", "echo", ("edge1", "edge2")
ECHO = ("-m", "zsched.tasks.echo")
KEPT, LOOKED_AT = 20_000, 1_000


def hello_of(fleet: str, node: str, **more: Any) -> RelayHello:
    """What a daemon says first to its relay."""
    said: dict[str, Any] = {"protocol": PROTOCOL, "fleet": fleet, "node": node, "threads": 6}
    return RelayHello(**said | more)


@dataclass
class Reports:
    """What one relay said, in order, with the time: the newest of a long run."""

    items: list[tuple[float, HandleReport]] = field(default_factory=list)

    def add(self, report: HandleReport) -> None:
        """The relay has said it."""
        self.items.append((time.monotonic(), report))
        if len(self.items) > KEPT:
            del self.items[: KEPT // 2]

    def told(self) -> tuple[HandleReport, ...]:
        """All of it."""
        return tuple(report for _, report in tuple(self.items))

    def find(self, kind: type[Kind], **fields: Any) -> Kind | None:
        """The newest report of a kind with these fields, if it is one of the last `LOOKED_AT`."""
        for _, report in reversed(self.items[-LOOKED_AT:]):
            if isinstance(report, kind) and all(getattr(report, name) == value for name, value in fields.items()):
                return report
        return None

    def count(self, kind: type) -> int:
        """How many there are of a kind."""
        return sum(isinstance(report, kind) for report in self.told())


@dataclass
class Relays:
    """One robot's relay, the relays and workers of some edges, and applications beside the robot."""

    folder: Path
    edges: tuple[str, ...] = EDGES
    timing: Timing = DEFAULT_TIMING
    task: str = TASK
    dials_by_gossip: bool = True
    relays: dict[str, RelayHandle] = field(default_factory=dict)
    reports: dict[str, Reports] = field(default_factory=dict)
    workers: dict[str, subprocess.Popen[bytes]] = field(default_factory=dict)
    """The newest of each node."""
    incarnation: int = 0
    dialled: tuple[str, ...] = ()
    """What workers dial beside."""

    def __post_init__(self) -> None:
        self.endpoints = {node: free_endpoint() for node in (ROBOT, *self.edges)}
        self._started: list[subprocess.Popen[bytes]] = []
        self._sessions: list[zenoh.Session] = []

    def __enter__(self) -> Self:
        try:
            self.start()
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def start(self) -> None:
        """Start every relay, and wait until they run."""
        for node, endpoint in self.endpoints.items():
            self.reports[node] = Reports()
            connect = () if node == ROBOT else (self.endpoint(ROBOT),)
            # no shared memory: a stalled target must fill its socket
            text = data_config(
                listen=(endpoint,),
                connect=connect,
                timing=self.timing,
                shared_memory=False,
                dials_by_gossip=self.dials_by_gossip,
            )
            self.relays[node] = self.handle(node, text)
            self.relays[node].start()
        until(lambda: all(r.find(RelayChanged, is_running=True) for r in self.reports.values()), "the relays run")

    def stop(self) -> None:
        """End every process."""
        for session in self._sessions:
            session.close()
        for worker in self._started:
            worker.send_signal(signal.SIGCONT)
            worker.kill()
            worker.wait(DEADLINE_S)
        for relay in self.relays.values():
            relay.stop(2.0)

    def handle(self, node: str, text: str) -> RelayHandle:
        """The daemon's hold on a node's relay, whose data session opens by ``text``."""
        return RelayHandle(
            hello=hello_of(FLEET, node),
            path=relay_path(self.folder, node),
            zenoh_config=text,
            on_report=self.reports[node].add,
        )

    def endpoint(self, node: str) -> str:
        """The data endpoint of a node's relay."""
        return self.endpoints[node]

    def application(self) -> zenoh.Session:
        """A session of the robot's applications; it is closed at the end."""
        self._sessions.append(zenoh.open(zenoh.Config.from_json5(self.application_config())))
        return self._sessions[-1]

    def application_config(self) -> str:
        """What such a session opens by."""
        return worker_config(connect=(self.endpoint(ROBOT),), shared_memory=False)

    def start_worker(
        self,
        node: str,
        *options: str,
        task: str = "",
        operator_json5: str = "",
        program: tuple[str, ...] = ECHO,
    ) -> subprocess.Popen[bytes]:
        """Start a worker, the echo if no other is given to Python, and wait for its token."""
        self.incarnation += 1
        task = task or self.task
        path = self.folder / f"{task}-{node}.json5"
        # its own relay first, then the robot's, as `zsched.link.sessions.endpoints` has it; it is dialled again
        connect = tuple(dict.fromkeys((self.endpoint(node), self.endpoint(ROBOT), *self.dialled)))
        gossip: dict[str, Any] = {} if self.dials_by_gossip else {"listen": (), "dials_by_gossip": False}
        text = worker_config(
            connect=connect, timing=self.timing, shared_memory=False, operator_json5=operator_json5, **gossip
        )
        path.write_text(text)
        env = os.environ | {
            "ZSCHED_FLEET": FLEET,
            "ZSCHED_NODE": node,
            "ZSCHED_TASK": task,
            "ZSCHED_INCARNATION": str(self.incarnation),
            "ZSCHED_ZENOH_CONFIG": str(path),
        }
        worker = self.workers[node] = subprocess.Popen([sys.executable, *program, *options], env=env)
        self._started.append(worker)
        seen = {"node": node, "task": task, "incarnation": str(self.incarnation), "is_present": True}
        until(lambda: self.find(WorkerSeen, **seen), f"{task}'s worker on {node}")
        return worker

    def find(self, kind: type[Kind], **fields: Any) -> Kind | None:
        """The newest report of the robot's relay with these fields."""
        return self.reports[ROBOT].find(kind, **fields)

    def wait(self, kind: type[Kind], deadline_s: float = DEADLINE_S, **fields: Any) -> Kind:
        """The same, once there is one."""
        report: Kind = until(lambda: self.find(kind, **fields), f"{kind.__name__} {fields}", deadline_s)
        return report

    def role(self, node: str, role: WorkerRole, epoch: int = 0, task: str = "") -> None:
        """Tell a node's worker its role."""
        self.relays[node].set_role(Role(task=task or self.task, role=role, epoch=epoch))

    def plan(self, phase: RoutePhase, current: Slot | None, *predecessors: Slot | None, task: str = "") -> None:
        """Give the robot's relay a plan."""
        olds = tuple(slot for slot in predecessors if slot is not None)
        self.relays[ROBOT].apply(RoutePlan(task=task or self.task, phase=phase, current=current, predecessors=olds))

    def prepare(self, new: Slot, old: Slot | None = None, task: str = "", *, is_crash: bool = False) -> None:
        """The executor's table up to where the new slot is ready; nobody tells a dead owner its role."""
        self.role(new.owner, WorkerRole.ACTIVE, new.epoch, task)
        if old is not None and not is_crash and old.owner != new.owner:
            self.role(old.owner, WorkerRole.DRAINING, old.epoch, task)
        self.plan(RoutePhase.PREPARE, new, old, task=task)
        self.wait(SlotReady, task=task or self.task, epoch=new.epoch, is_ready=True)

    def flip(self, new: Slot, old: Slot | None = None, task: str = "") -> float:
        """Its next step: the old slot still drains; answers how long it took."""
        began = time.monotonic()
        self.plan(RoutePhase.FLIP, new, old, task=task)
        self.wait(SlotFlipped, task=task or self.task, epoch=new.epoch)
        return time.monotonic() - began
