"""Relays and echo workers without daemons: moves driven by hand, as fast as they can go.

Knows: relay handles, workers' processes, an application's session. Does not know: what a benchmark measures.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import psutil
import zenoh

from zsched.adapters.relay.streams import RelayHandle
from zsched.core.events import RelayChanged, SlotDrained, SlotFlipped, SlotReady, StreamsCounted
from zsched.core.hop.books import given_up, unaccounted
from zsched.core.relay_protocol import HandleReport, SlotLost, WorkerSeen
from zsched.core.values.plan import (
    Direction,
    HandoverRule,
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
from zsched.sessions.config import data_config, worker_config
from zsched_lab.fleet.loopback import free_endpoint

FLEET, ROBOT, TASK = "bench", "robot1", "echo"
NUMBER_BYTES = 10


def until(condition: Callable[[], Any], what: str, deadline_s: float = 10.0) -> Any:
    """The condition's first true value; `AssertionError` when there is none in time."""
    end = time.monotonic() + deadline_s
    while time.monotonic() < end:
        value = condition()
        if value:
            return value
        time.sleep(0.002)
    raise AssertionError(f"not within {deadline_s} s: {what}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Load:
    """One stream of the application: its name, rate and payload."""

    name: str
    hz: float
    size: int


def routes(
    owner: str,
    epoch: int,
    loads: tuple[Load, ...],
    stream_class: StreamClass,
    *,
    is_mirrored: bool = False,
    task: str = TASK,
) -> Slot:
    """Both directions of every load, towards one owner; ``task`` is in the streams' names."""
    options: dict[str, Any] = {"mirror": True} if is_mirrored else {}
    rule = HandoverRule.ALL if stream_class is StreamClass.RELIABLE else HandoverRule.LATEST
    settings = StreamSettings(stream_class=stream_class, keep_last=1, depth=4000, handover=rule)
    made = []
    for index, load in enumerate(loads):
        inside = StreamSettings(stream_class=stream_class, keep_last=1, depth=4000, **options)
        made.append(
            Route(
                stream=f"{task}/in/{index}",
                direction=Direction.INPUT,
                from_expr=f"{ROBOT}/{load.name}/in",
                to_expr=f"{owner}/{TASK}/{load.name}/in",
                settings=inside,
            )
        )
        made.append(
            Route(
                stream=f"{task}/out/{index}",
                direction=Direction.OUTPUT,
                from_expr=f"{owner}/{TASK}/{epoch}/{load.name}/out",
                to_expr=f"{ROBOT}/{load.name}/out",
                settings=settings,
            )
        )
    return Slot(epoch=epoch, owner=owner, routes=tuple(made), ready_when=ReadyWhen.TOKEN)


@dataclass
class Rig:
    """One robot's relay and the relays and workers of some edges, on loopback."""

    folder: Path
    edges: tuple[str, ...] = ("edge1", "edge2")
    relays: dict[str, RelayHandle] = field(default_factory=dict)
    workers: dict[str, subprocess.Popen[bytes]] = field(default_factory=dict)
    heard: dict[str, list[tuple[float, HandleReport]]] = field(default_factory=dict)
    incarnation: int = 0
    sessions: list[zenoh.Session] = field(default_factory=list)

    def __enter__(self) -> Self:
        nodes = (ROBOT, *self.edges)
        self.endpoints = {node: free_endpoint() for node in nodes}
        for node in nodes:
            heard: list[tuple[float, HandleReport]] = []
            self.heard[node] = heard
            connect = () if node == ROBOT else (self.endpoint(ROBOT),)
            # one side dials every link, as `zsched.runtime.endpoints` has it
            text = data_config(
                listen=(self.endpoint(node),), connect=connect, shared_memory=False, dials_by_gossip=False
            )
            on_report = _listener(heard)
            self.relays[node] = RelayHandle(fleet=FLEET, node=node, zenoh_config=text, on_report=on_report)
            self.relays[node].start()
        until(lambda: all(self.find(RelayChanged, node, is_running=True) for node in nodes), "the relays run", 60.0)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for session in self.sessions:
            session.close()
        for worker in self.workers.values():
            worker.send_signal(signal.SIGCONT)
            worker.kill()
            worker.wait(5)
        for relay in self.relays.values():
            relay.stop(2.0)

    def endpoint(self, node: str) -> str:
        """The data endpoint of a node's relay."""
        return self.endpoints[node]

    def app(self) -> zenoh.Session:
        """An application's session beside the robot."""
        text = worker_config(connect=(self.endpoint(ROBOT),), shared_memory=False)
        self.sessions.append(zenoh.open(zenoh.Config.from_json5(text)))
        return self.sessions[-1]

    def find(self, kind: type, node: str = ROBOT, **fields: Any) -> HandleReport | None:
        """The newest report of a kind with these fields."""
        for _, report in reversed(self.heard[node][-400:]):
            if isinstance(report, kind) and all(getattr(report, name) == value for name, value in fields.items()):
                return report
        return None

    def start_worker(self, node: str, *options: str) -> None:
        """Start an echo worker and wait for its token."""
        self.incarnation += 1
        path = self.folder / f"{node}.json5"
        connect = tuple(dict.fromkeys((self.endpoint(node), self.endpoint(ROBOT))))  # as `zsched.runtime.endpoints`
        path.write_text(worker_config(connect=connect, listen=(), shared_memory=False, dials_by_gossip=False))
        env = os.environ | {
            "ZSCHED_FLEET": FLEET,
            "ZSCHED_NODE": node,
            "ZSCHED_TASK": TASK,
            "ZSCHED_INCARNATION": str(self.incarnation),
            "ZSCHED_ZENOH_CONFIG": str(path),
        }
        self.workers[node] = subprocess.Popen([sys.executable, "-m", "zsched.tasks.echo", *options], env=env)
        number = str(self.incarnation)
        until(lambda: self.find(WorkerSeen, incarnation=number, is_present=True), f"the worker of {node}", 60.0)

    def role(self, node: str, role: WorkerRole, epoch: int = 0) -> None:
        """Tell a node's worker its role."""
        self.relays[node].set_role(Role(task=TASK, role=role, epoch=epoch))

    def move(self, new: Slot, old: Slot | None = None, *, is_crash: bool = False, drain_s: float = 2.0) -> float:
        """The executor's table; answers the seconds from the first plan to the flip."""
        self.role(new.owner, WorkerRole.ACTIVE, new.epoch)
        if old is not None and not is_crash and old.owner != new.owner:
            self.role(old.owner, WorkerRole.DRAINING, old.epoch)
        began = time.monotonic()
        self.plan(RoutePhase.PREPARE, new, old)
        until(lambda: self.find(SlotReady, epoch=new.epoch, is_ready=True), f"epoch {new.epoch} ready")
        self.plan(RoutePhase.FLIP, new, old)
        until(lambda: self.find(SlotFlipped, epoch=new.epoch), f"epoch {new.epoch} flipped")
        took = time.monotonic() - began
        if old is not None and not is_crash:
            self.wait_drained(drain_s, old)
        self.plan(RoutePhase.CLOSE, new)
        if old is not None and not is_crash and old.owner != new.owner:
            self.role(old.owner, WorkerRole.IDLE)
        return took

    def wait_drained(self, drain_s: float, *olds: Slot) -> None:
        """Wait until the robot's relay has said that these slots are drained, or their drain time is over."""
        end = time.monotonic() + drain_s
        while time.monotonic() < end and not all(self.find(SlotDrained, epoch=old.epoch) for old in olds):
            time.sleep(0.002)

    def plan(self, phase: RoutePhase, current: Slot, *predecessors: Slot | None) -> None:
        """Give the robot's relay a plan."""
        olds = tuple(slot for slot in predecessors if slot is not None)
        self.relays[ROBOT].apply(RoutePlan(task=TASK, phase=phase, current=current, predecessors=olds))

    def counts(self) -> dict[str, StreamCount]:
        """The newest counters of the robot's streams, at most a second old."""
        since = time.monotonic()
        until(lambda: any(at > since and isinstance(r, StreamsCounted) for at, r in self.heard[ROBOT][-50:]), "counts")
        report = self.find(StreamsCounted)
        assert isinstance(report, StreamsCounted)
        return {count.stream: count for count in report.counts}

    def unaccounted(self) -> list[str]:
        """Streams whose counters do not account for every sample (`zsched.core.hop.books`); none, at any time."""
        return [
            f"{missing} unaccounted: {count}" for count in self.counts().values() if (missing := unaccounted(count))
        ]

    def silent_losses(self, traffics: Sequence[Traffic], deadline_s: float = 20.0) -> list[str]:
        """Loads of which more samples have not come back than the robot's counters tell of, once that is final.

        The loads are those of the slot, in its order, and have stopped; what is on its way has ``deadline_s`` to come.
        """
        end = time.monotonic() + deadline_s
        while True:
            counts = self.counts()
            pairs = [(traffic.result()[0], told_of(counts, index)) for index, traffic in enumerate(traffics)]
            if all(lost <= told for lost, told in pairs) or time.monotonic() > end:
                break
        return [
            f"{traffic.load.name}: {lost} lost, {told} told of"
            for traffic, (lost, told) in zip(traffics, pairs, strict=True)
            if lost > told
        ]

    def left_behind(self) -> list[int]:
        """What closed slots reported as "at most so many lost"."""
        return [report.samples for _, report in self.heard[ROBOT] if isinstance(report, SlotLost)]

    def memory(self) -> dict[str, tuple[float, int, int]]:
        """{process: (private MB, descriptors, threads)} of the robot's relay and the workers."""
        pids = {ROBOT: self.relays[ROBOT].pid or 0} | {node: worker.pid for node, worker in self.workers.items()}
        return {name: _footprint(pid) for name, pid in pids.items() if psutil.pid_exists(pid)}


def told_of(counts: Mapping[str, StreamCount], index: int) -> int:
    """How many samples of a slot's load the counters of the robot's relay give up: on the way there and back."""
    return given_up(counts[f"{TASK}/in/{index}"]) + given_up(counts[f"{TASK}/out/{index}"])


def _listener(heard: list[tuple[float, HandleReport]]) -> Callable[[HandleReport], None]:
    def hear(report: HandleReport) -> None:
        heard.append((time.monotonic(), report))
        if len(heard) > 20_000:
            del heard[:10_000]

    return hear


def _footprint(pid: int) -> tuple[float, int, int]:
    process = psutil.Process(pid)
    return process.memory_full_info().uss / 1e6, process.num_fds(), process.num_threads()


class Traffic:
    """One load of the application: numbered samples out, echoes back with their times."""

    def __init__(self, session: zenoh.Session, load: Load) -> None:
        self.load = load
        self.sent: list[float] = []
        self.back: list[tuple[int, float]] = []
        self._padding = bytes(max(0, load.size - NUMBER_BYTES))
        self._subscriber = session.declare_subscriber(f"{ROBOT}/{load.name}/out", self._take)
        block = zenoh.CongestionControl.BLOCK
        self._publisher = session.declare_publisher(f"{ROBOT}/{load.name}/in", congestion_control=block)
        self._halt = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    @property
    def is_connected(self) -> bool:
        """Whether the relay subscribes."""
        status: Any = self._publisher.matching_status
        return bool(status.matching)

    def start(self) -> None:
        """Begin to send."""
        self._thread.start()

    def stop(self) -> None:
        """Send no more."""
        self._halt.set()
        self._thread.join(5)

    def _take(self, sample: zenoh.Sample) -> None:
        self.back.append((int(sample.payload.to_bytes()[:NUMBER_BYTES]), time.monotonic()))

    def _run(self) -> None:
        due = time.monotonic()
        while not self._halt.is_set():
            self.sent.append(time.monotonic())
            self._publisher.put(f"{len(self.sent) - 1:0{NUMBER_BYTES}d}".encode() + self._padding)
            due = max(due + 1 / self.load.hz, time.monotonic() - 0.1)
            time.sleep(max(0.0, due - time.monotonic()))

    def result(self) -> tuple[int, int, int]:
        """(lost, doubled, reordered) at the application."""
        numbers = [number for number, _ in self.back]
        lost = len(self.sent) - len(set(numbers))
        reordered = sum(later < earlier for earlier, later in pairwise(numbers))
        return lost, len(numbers) - len(set(numbers)), reordered

    def gap_after(self, moment: float, window_s: float = 0.6) -> float:
        """The longest silence between two echoes in a window around a moment, milliseconds."""
        begin = bisect_left(self.back, moment - 0.1, key=lambda one: one[1])
        end = bisect_left(self.back, moment + window_s, key=lambda one: one[1])
        times = [at for _, at in self.back[begin:end]]
        return max((later - earlier for earlier, later in pairwise(times)), default=window_s) * 1000
