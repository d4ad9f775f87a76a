"""Numbers of both hops run across 2^32, where zenoh's source number begins again: there, back, again, and to the end.

Relays and workers run in one process of the test's own, so that their counters can start shortly before. Everything
else is real.
"""

from __future__ import annotations

import multiprocessing
import os
import time
import traceback
from collections import Counter
from contextlib import ExitStack
from functools import partial
from itertools import count
from typing import Any

import zenoh

from support.relay_rig import FLEET, ROBOT, TASK, Application, slot
from support.waiting import free_endpoint, until
from zsched.core.hop.books import unaccounted
from zsched.core.hop.serial import SPAN
from zsched.core.hop.shared import SharedSender
from zsched.core.values.events import SlotDrained, SlotFlipped, SlotReady
from zsched.core.values.plan import Role, RoutePhase, RoutePlan, Slot, StreamClass, StreamCount, WorkerRole
from zsched.link.sessions.config import data_config, worker_config
from zsched.relay.process import RelayProcess
from zsched.relay.streams import outlet
from zsched.relay.streams.lanes import Lane
from zsched.relay.streams.outputs import OutputStream
from zsched.tasks.echo import Echo
from zsched.worker import Worker
from zsched.worker import keep as worker_keep
from zsched.worker.inputs import Dispatcher

BEFORE = 60
START = SPAN - BEFORE


class Heard:
    """Stands where the pipe to the daemon is."""

    def __init__(self) -> None:
        self.reports: list[Any] = []

    def report(self, value: Any) -> None:
        self.reports.append(value)

    def has(self, kind: type, **fields: Any) -> bool:
        return any(
            isinstance(one, kind) and all(getattr(one, key) == value for key, value in fields.items())
            for one in tuple(self.reports)
        )


class Fleet:
    """A robot's relay, two edges' relays and echo workers."""

    def __init__(self, stack: ExitStack) -> None:
        endpoints = {node: free_endpoint() for node in (ROBOT, "edge1", "edge2")}
        self.heard = {node: Heard() for node in endpoints}
        self.relays: dict[str, RelayProcess] = {}
        for node, endpoint in endpoints.items():
            connect = () if node == ROBOT else (endpoints[ROBOT],)
            text = data_config(listen=(endpoint,), connect=connect, shared_memory=False)
            session = zenoh.open(zenoh.Config.from_json5(text))
            stack.callback(session.close)
            self.relays[node] = RelayProcess(session, FLEET, node, self.heard[node])  # type: ignore[arg-type]
        number = count(1)
        for node in ("edge1", "edge2"):
            text = worker_config(connect=(endpoints[node], endpoints[ROBOT]), shared_memory=False)
            worker = Worker(fleet=FLEET, node=node, task=TASK, incarnation=str(next(number)), zenoh_config=text)
            stack.callback(worker.close)
            echo = Echo(worker, latest=False, delay_s=0)
            worker.subscribe("{prefix}/*/in", echo.on_sample, keep_last=None, depth=100_000)
            worker.ready()
        text = worker_config(connect=(endpoints[ROBOT],), shared_memory=False)
        session = zenoh.open(zenoh.Config.from_json5(text))
        stack.callback(session.close)
        self.app = Application(session)

    def plan(self, phase: RoutePhase, new: Slot, old: Slot | None = None) -> None:
        self.relays[ROBOT]._do(
            RoutePlan(task=TASK, phase=phase, current=new, predecessors=() if old is None else (old,))
        )

    def move(self, new: Slot, old: Slot | None = None) -> None:
        heard = self.heard[ROBOT]
        self.relays[new.owner]._do(Role(task=TASK, role=WorkerRole.ACTIVE, epoch=new.epoch))
        if old is not None:
            self.relays[old.owner]._do(Role(task=TASK, role=WorkerRole.DRAINING, epoch=old.epoch))
        # not PREPARE: an epoch's first answer would have to be number 0
        self.plan(RoutePhase.FLIP, new, old)
        until(lambda: heard.has(SlotReady, epoch=new.epoch, is_ready=True), "the new owner is ready")
        until(lambda: heard.has(SlotFlipped, epoch=new.epoch), "the flip")
        if old is not None:
            until(lambda: heard.has(SlotDrained, epoch=old.epoch), "the old owner's end")
        self.plan(RoutePhase.CLOSE, new)

    def counts(self) -> dict[str, StreamCount]:
        return {one.stream: one for one in self.relays[ROBOT]._tasks[TASK].counts()}


def losing(cls: type, method: str, serials: set[int]) -> Counter[int]:
    """Let a receiver miss these numbers the first time that they come, as a broken link does."""
    seen: Counter[int] = Counter()
    original = getattr(cls, method)

    def missing(self: Any, where: Any, sample: zenoh.Sample) -> None:
        info: Any = sample.source_info
        serial = -1 if info is None else info.source_sn
        if serial in serials:
            seen[serial] += 1
            if seen[serial] == 1:
                return
        original(self, where, sample)

    setattr(cls, method, missing)
    return seen


def across() -> None:
    """Gaps on both sides and across, resends both ways, end markers behind and before it."""
    vars(outlet)["Lane"] = partial(Lane, count=START, base=START)
    vars(worker_keep)["SharedSender"] = partial(SharedSender, count=START)
    gaps = {SPAN - 20, SPAN - 2, SPAN - 1, 0, 1, 30}
    there = losing(Dispatcher, "put", gaps)
    back = losing(OutputStream, "_carry", {serial + 3 for serial in gaps if serial < SPAN - 3})
    sessions = ExitStack()  # who holds them, holds them open
    fleet = Fleet(sessions)
    app = fleet.app
    first, second = slot(1, "edge1", StreamClass.RELIABLE, 1), slot(2, "edge2", StreamClass.RELIABLE, 1)
    fleet.move(first)
    until(app.connected, "the application sees the relay's subscription")
    for _ in range(2 * BEFORE):
        app.put()
        time.sleep(0.002)
    until(lambda: len(app.back) == app.sent, "every answer across 2^32")
    fleet.move(second, first)  # the old slot ends behind 2^32, in both directions
    for _ in range(BEFORE // 2):
        app.put()
    until(lambda: len(app.back) == app.sent, "every answer of the second owner")
    third = slot(3, "edge1", StreamClass.RELIABLE, 1)
    fleet.move(third, second)  # and this one before it
    for _ in range(2 * BEFORE):
        app.put()
    until(lambda: len(app.back) == app.sent, "every answer of the third")
    assert app.back == list(range(app.sent))
    assert set(there) == gaps
    assert back
    until(lambda: fleet.counts()["echo/in/0"].in_flight == 0, "every acknowledgement")
    inward, outward = fleet.counts()["echo/in/0"], fleet.counts()["echo/out/0"]
    assert (inward.acknowledged, inward.lost, inward.at_most_lost, unaccounted(inward)) == (app.sent, 0, 0, 0)
    assert (outward.lost, outward.reordered, outward.drops) == (0, 0, ())


def child() -> None:
    """A process that ends at once: threads that wait in zenoh do not survive the interpreter's own end."""
    try:
        across()
    except BaseException:  # noqa: BLE001 - whatever it is, the parent is to hear of it
        traceback.print_exc()
        os._exit(1)
    os._exit(0)


def test_a_stream_goes_on_across_the_end_of_its_numbers() -> None:
    process = multiprocessing.get_context("spawn").Process(target=child)
    process.start()
    try:
        process.join(150)
        assert process.exitcode == 0
    finally:
        process.kill()
        process.join(60)
