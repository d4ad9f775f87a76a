"""Relays and echo workers without daemons: moves driven by hand, as fast as they can go.

Knows: relay handles, workers' processes, an application's session. Does not know: what a benchmark measures.
"""

from __future__ import annotations

import threading
import time
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import psutil
import zenoh

from zsched.core.hop.books import given_up, unaccounted
from zsched.core.values.events import SlotDrained, StreamsCounted
from zsched.core.values.plan import (
    Direction,
    HandoverRule,
    ReadyWhen,
    Route,
    RoutePhase,
    Slot,
    StreamClass,
    StreamCount,
    StreamSettings,
    WorkerRole,
)
from zsched.core.values.relay_protocol import SlotLost
from zsched_lab.fleet.relays import ROBOT, TASK, Relays
from zsched_lab.fleet.waiting import until

NUMBER_BYTES = 10


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
class Rig(Relays):
    """One robot's relay and the relays and workers of some edges; one side dials every link, as in a fleet."""

    dials_by_gossip: bool = False

    def move(self, new: Slot, old: Slot | None = None, *, is_crash: bool = False, drain_s: float = 2.0) -> float:
        """The executor's table; answers the seconds from the first plan to the flip."""
        began = time.monotonic()
        self.prepare(new, old, is_crash=is_crash)
        self.flip(new, old)
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

    def counts(self) -> dict[str, StreamCount]:
        """The newest counters of the robot's streams, at most a second old."""
        since, told = time.monotonic(), self.reports[ROBOT]
        until(lambda: any(at > since and isinstance(r, StreamsCounted) for at, r in told.items[-50:]), "counts")
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
        return [report.samples for _, report in self.reports[ROBOT].items if isinstance(report, SlotLost)]

    def memory(self) -> dict[str, tuple[float, int, int]]:
        """{process: (private MB, descriptors, threads)} of the robot's relay and the workers."""
        pids = {ROBOT: self.relays[ROBOT].pid or 0} | {node: worker.pid for node, worker in self.workers.items()}
        return {name: _footprint(pid) for name, pid in pids.items() if psutil.pid_exists(pid)}


def told_of(counts: Mapping[str, StreamCount], index: int) -> int:
    """How many samples of a slot's load the counters of the robot's relay give up: on the way there and back."""
    return given_up(counts[f"{TASK}/in/{index}"]) + given_up(counts[f"{TASK}/out/{index}"])


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
