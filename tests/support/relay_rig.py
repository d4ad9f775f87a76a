"""Three nodes' real relays, real echo workers and an application: what the tests of streams are made of.

Knows: the executor's steps of a handover. Does not know: what a test breaks.
"""

from __future__ import annotations

import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import zenoh

from support.books import newest_counts, wait_for_balance
from support.waiting import free_endpoint, until
from zsched.adapters.relay.streams import RelayHandle
from zsched.core.events import RelayChanged, SlotDrained, SlotFlipped, SlotReady
from zsched.core.relay_protocol import HandleReport, WorkerSeen
from zsched.core.values.fleet import Timing
from zsched.core.values.plan import (
    Direction,
    HandoverRule,
    OnCrash,
    ReadyWhen,
    Role,
    Route,
    RoutePhase,
    RoutePlan,
    Slot,
    StreamClass,
    StreamCount,
    StreamSettings,
    WorkerRole,
)
from zsched.sessions.config import DEFAULT_TIMING, data_config, worker_config

Kind = TypeVar("Kind")
FLEET, ROBOT, TASK = "test", "robot1", "echo"


def slot(
    epoch: int,
    owner: str,
    stream_class: StreamClass,
    keep_last: int,
    ready: ReadyWhen = ReadyWhen.TOKEN,
    on_crash: OnCrash = OnCrash.REPORT,
) -> Slot:
    settings = StreamSettings(
        stream_class=stream_class, keep_last=keep_last, depth=4000, handover=HandoverRule.ALL, on_crash=on_crash
    )
    routes = (
        Route(
            stream=f"{TASK}/in/0",
            direction=Direction.INPUT,
            from_expr=f"{ROBOT}/in",
            to_expr=f"{owner}/{TASK}/{ROBOT}/in",
            settings=settings,
        ),
        Route(
            stream=f"{TASK}/out/0",
            direction=Direction.OUTPUT,
            from_expr=f"{owner}/{TASK}/{epoch}/{ROBOT}/out",
            to_expr=f"{ROBOT}/out",
            settings=settings,
        ),
    )
    return Slot(epoch=epoch, owner=owner, routes=routes, ready_when=ready)


@dataclass
class Reports:
    """What one relay said, in order."""

    items: list[tuple[float, HandleReport]] = field(default_factory=list)

    def add(self, report: HandleReport) -> None:
        self.items.append((time.monotonic(), report))

    def told(self) -> tuple[HandleReport, ...]:
        return tuple(report for _, report in tuple(self.items))

    def find(self, kind: type[Kind], **fields: Any) -> Kind | None:
        for _, report in tuple(self.items):
            if isinstance(report, kind) and all(getattr(report, name) == value for name, value in fields.items()):
                return report
        return None

    def count(self, kind: type) -> int:
        return sum(isinstance(report, kind) for _, report in tuple(self.items))


@dataclass
class Rig:
    """Three nodes' relays on loopback, echo workers, one application session beside the robot."""

    folder: Path
    timing: Timing = DEFAULT_TIMING
    endpoints: dict[str, str] = field(default_factory=lambda: {n: free_endpoint() for n in (ROBOT, "edge1", "edge2")})
    relays: dict[str, RelayHandle] = field(default_factory=dict)
    reports: dict[str, Reports] = field(default_factory=dict)
    workers: list[subprocess.Popen[bytes]] = field(default_factory=list)
    incarnation: int = 0
    dialled: tuple[str, ...] = ()
    """What workers dial beside."""

    def start(self) -> None:
        seed = self.endpoint(ROBOT)
        for node in self.endpoints:
            self.reports[node] = Reports()
            connect = () if node == ROBOT else (seed,)
            # no shared memory: a stalled target must fill its socket
            text = data_config(listen=(self.endpoint(node),), connect=connect, timing=self.timing, shared_memory=False)
            self.relays[node] = self.handle(node, text)
            self.relays[node].start()
        until(lambda: all(r.find(RelayChanged, is_running=True) for r in self.reports.values()), "the relays run")
        self.app = self.application()

    def handle(self, node: str, text: str) -> RelayHandle:
        """The daemon's hold on a node's relay, whose data session opens by ``text``."""
        return RelayHandle(fleet=FLEET, node=node, zenoh_config=text, on_report=self.reports[node].add)

    def application(self) -> zenoh.Session:
        """The session of the robot's application."""
        text = worker_config(connect=(self.endpoint(ROBOT),), shared_memory=False)
        return zenoh.open(zenoh.Config.from_json5(text))

    def endpoint(self, node: str) -> str:
        return self.endpoints[node]

    def start_worker(
        self, node: str, *options: str, task: str = TASK, operator_json5: str = "", script: Path | None = None
    ) -> subprocess.Popen[bytes]:
        """The echo worker, or the one that a ``script`` is."""
        self.incarnation += 1
        path = self.folder / f"{task}-{node}.json5"
        # its own relay first, then the robot's, as `zsched.runtime.endpoints` has it: what is dialled is dialled again
        connect = tuple(dict.fromkeys((self.endpoint(node), self.endpoint(ROBOT), *self.dialled)))
        text = worker_config(connect=connect, timing=self.timing, shared_memory=False, operator_json5=operator_json5)
        path.write_text(text)
        env = os.environ | {
            "ZSCHED_FLEET": FLEET,
            "ZSCHED_NODE": node,
            "ZSCHED_TASK": task,
            "ZSCHED_INCARNATION": str(self.incarnation),
            "ZSCHED_ZENOH_CONFIG": str(path),
        }
        program = ("-m", "zsched.tasks.echo") if script is None else (str(script),)
        command = [sys.executable, *program, *options]
        worker = subprocess.Popen(command, env=env)
        self.workers.append(worker)
        seen = {"node": node, "task": task, "incarnation": str(self.incarnation), "is_present": True}
        until(lambda: self.reports[ROBOT].find(WorkerSeen, **seen), f"{task}'s worker on {node}")
        return worker

    def role(self, node: str, role: WorkerRole, epoch: int = 0, task: str = TASK) -> None:
        self.relays[node].set_role(Role(task=task, role=role, epoch=epoch))

    def plan(self, phase: RoutePhase, current: Slot | None, *predecessors: Slot | None, task: str = TASK) -> None:
        olds = tuple(slot for slot in predecessors if slot is not None)
        self.relays[ROBOT].apply(RoutePlan(task=task, phase=phase, current=current, predecessors=olds))

    def wait(self, kind: type[Kind], **fields: Any) -> Kind:
        report: Kind = until(lambda: self.reports[ROBOT].find(kind, **fields), f"{kind.__name__} {fields}")
        return report

    def move(self, new: Slot, old: Slot | None = None, *, drains: bool = True, task: str = TASK) -> float:
        """The executor's table, step by step; answers how long the flip took."""
        self.role(new.owner, WorkerRole.ACTIVE, new.epoch, task)
        if old is not None:
            self.role(old.owner, WorkerRole.DRAINING, old.epoch, task)
        self.plan(RoutePhase.PREPARE, new, old, task=task)
        self.wait(SlotReady, task=task, epoch=new.epoch, is_ready=True)
        started = time.monotonic()
        self.plan(RoutePhase.FLIP, new, old, task=task)
        self.wait(SlotFlipped, task=task, epoch=new.epoch)
        took = time.monotonic() - started
        if old is not None and drains:
            self.wait(SlotDrained, task=task, epoch=old.epoch)
        self.plan(RoutePhase.CLOSE, new, task=task)
        return took

    def counts(self) -> tuple[StreamCount, ...]:
        """The newest counters of the robot's relay."""
        return newest_counts(self.reports[ROBOT].told())

    def told(self, stream: str) -> StreamCount:
        """The newest counters of one stream."""
        return next((count for count in self.counts() if count.stream == stream), StreamCount(stream=stream))

    def assert_nothing_is_unaccounted(self) -> None:
        """Every sample that came in is somewhere in the counters, of every stream (`zsched.core.hop.books`)."""
        wait_for_balance(self.counts)

    def drops(self) -> Counter[str]:
        """The newest drops, summed over all streams."""
        result: Counter[str] = Counter()
        for count in self.counts():
            result.update(dict(count.drops))
        return result

    def stop(self) -> None:
        if hasattr(self, "app"):
            self.app.close()
        for worker in self.workers:
            worker.send_signal(signal.SIGCONT)
            worker.kill()
            worker.wait(30)
        for relay in self.relays.values():
            relay.stop(2.0)


@contextmanager
def relay_rig(folder: Path, timing: Timing = DEFAULT_TIMING) -> Iterator[Rig]:
    """A rig that runs; everything of it is ended afterwards."""
    made = Rig(folder=folder, timing=timing)
    try:
        made.start()
        yield made
        made.assert_nothing_is_unaccounted()
    finally:
        made.stop()


BESIDE = Route(
    stream="beside/in/0",
    direction=Direction.INPUT,
    from_expr=f"{ROBOT}/beside",
    to_expr=f"edge2/beside/{ROBOT}",
    settings=StreamSettings(stream_class=StreamClass.RELIABLE, depth=1000),
)


class Application:
    """Publishes numbers on the robot's own key and collects what comes back; never hears of owners."""

    def __init__(self, session: zenoh.Session) -> None:
        self.back: list[int] = []
        self.nodes: list[str] = []
        self.sent = 0
        self.padding = b""
        self._samples: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
        self._subscriber = session.declare_subscriber(f"{ROBOT}/out", self._take)
        block = zenoh.CongestionControl.BLOCK
        self._publisher = session.declare_publisher(f"{ROBOT}/in", congestion_control=block)
        self._halt = threading.Event()

    def _take(self, sample: zenoh.Sample) -> None:
        self.back.append(int(sample.payload.to_bytes().split(b" ")[0]))
        self.nodes.append(str(sample.encoding).rsplit(";", 1)[-1])
        assert sample.attachment is not None
        assert sample.attachment.to_bytes() == b"attached"

    def put(self) -> bool:
        self._publisher.put(str(self.sent).encode() + b" " + self.padding, attachment=b"attached")
        self.sent += 1
        return False

    def connected(self) -> bool:
        status: Any = self._publisher.matching_status
        return bool(status.matching)

    def stream(self, hz: float) -> threading.Thread:
        thread = threading.Thread(target=self._stream, args=(1 / hz,), daemon=True)
        thread.start()
        return thread

    def flow(self, hz: float, answers: int) -> threading.Thread:
        """Stream as soon as the relay listens; comes back when more than so many answers have."""
        until(self.connected, "the application sees the relay's subscription")
        thread = self.stream(hz)
        until(lambda: len(self.back) > answers, "the stream through the first owner")
        return thread

    def _stream(self, period: float) -> None:
        due = time.monotonic()
        while not self._halt.is_set():
            self.put()
            due += period
            time.sleep(max(0.0, due - time.monotonic()))

    def halt(self, thread: threading.Thread) -> None:
        self._halt.set()
        thread.join(5)
