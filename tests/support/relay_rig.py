"""Three nodes' real relays, real echo workers and an application: what the tests of streams are made of.

Knows: the streams of the echo, the books at the end. Does not know: what a test breaks.
"""

from __future__ import annotations

import queue
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zenoh

from support.books import newest_counts, wait_for_balance
from support.waiting import until
from zsched.core.values.events import SlotDrained
from zsched.core.values.fleet import Timing
from zsched.core.values.plan import (
    Direction,
    HandoverRule,
    OnCrash,
    ReadyWhen,
    Route,
    RoutePhase,
    Slot,
    StreamClass,
    StreamCount,
    StreamSettings,
)
from zsched.link.sessions.config import DEFAULT_TIMING
from zsched_lab.fleet.relays import FLEET, ROBOT, TASK, Relays, Reports

__all__ = ["BESIDE", "FLEET", "ROBOT", "TASK", "Application", "Reports", "Rig", "relay_rig", "slot"]


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
class Rig(Relays):
    """Three nodes' relays, echo workers, one application session beside the robot."""

    def start(self) -> None:
        super().start()
        self.app = self.application()

    def move(self, new: Slot, old: Slot | None = None, *, drains: bool = True, task: str = "") -> float:
        """The executor's table, step by step; answers how long the flip took."""
        self.prepare(new, old, task)
        took = self.flip(new, old, task)
        if old is not None and drains:
            self.wait(SlotDrained, task=task or self.task, epoch=old.epoch)
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


@contextmanager
def relay_rig(folder: Path, timing: Timing = DEFAULT_TIMING) -> Iterator[Rig]:
    """A rig that runs; everything of it is ended afterwards."""
    with Rig(folder, timing=timing) as made:
        yield made
        made.assert_nothing_is_unaccounted()


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
