"""Chains of tasks: one task's output is another one's input on the same robot, through one relay; either moves."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from zsched.core.events import SlotDrained, SlotFlipped, SlotReady
from zsched.core.plan import (
    Direction,
    HandoverRule,
    ReadyWhen,
    Role,
    Route,
    RoutePhase,
    RoutePlan,
    Slot,
    StreamClass,
    StreamSettings,
    WorkerRole,
)
from zsched.core.relay_protocol import WorkerSeen
from zsched.zenoh_config import worker_config


def _neighbour() -> Any:
    """The rig of the tests beside this one (they are files, not a package)."""
    name = "relay_streams_rig"
    if name not in sys.modules:
        spec = importlib.util.spec_from_file_location(name, Path(__file__).with_name("test_relay_streams.py"))
        assert spec is not None
        assert spec.loader is not None
        sys.modules[name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[name])
    return sys.modules[name]


streams = _neighbour()
until, ROBOT = streams.until, streams.ROBOT


@dataclass
class Task:
    """One task of the chain, driven by hand: an echo worker on each edge, ``source`` in, ``sink`` out."""

    rig: Any
    name: str
    source: str
    sink: str
    stream_class: StreamClass = StreamClass.RELIABLE
    epoch: int = 0
    now: Slot | None = None
    workers: list[subprocess.Popen[bytes]] = field(default_factory=list)

    def start(self, node: str) -> None:
        incarnation = f"{self.name}{node}"
        path = self.rig.folder / f"{incarnation}.json5"
        path.write_text(worker_config(connect=(self.rig.endpoint(node),), shared_memory=False))
        env = os.environ | {
            "ZSCHED_FLEET": streams.FLEET,
            "ZSCHED_NODE": node,
            "ZSCHED_TASK": self.name,
            "ZSCHED_INCARNATION": incarnation,
            "ZSCHED_ZENOH_CONFIG": str(path),
        }
        options = ["--latest"] if self.stream_class is StreamClass.LATEST else []
        self.workers.append(subprocess.Popen([sys.executable, "-m", "zsched.tasks.echo", *options], env=env))
        seen = {"node": node, "task": self.name, "is_present": True}
        until(lambda: self.rig.reports[ROBOT].find(WorkerSeen, **seen), f"{self.name}'s worker on {node}")

    def slot(self, owner: str) -> Slot:
        self.epoch += 1
        settings = StreamSettings(stream_class=self.stream_class, depth=4000, handover=HandoverRule.ALL)
        way_in = Route(
            stream=f"{self.name}/in/0",
            direction=Direction.INPUT,
            from_expr=self.source,
            to_expr=f"{owner}/{self.name}/{ROBOT}/in",
            settings=settings,
        )
        way_out = Route(
            stream=f"{self.name}/out/0",
            direction=Direction.OUTPUT,
            from_expr=f"{owner}/{self.name}/{self.epoch}/{ROBOT}/out",
            to_expr=self.sink,
            settings=settings,
        )
        return Slot(epoch=self.epoch, owner=owner, routes=(way_in, way_out), ready_when=ReadyWhen.TOKEN)

    def move(self, owner: str) -> None:
        new, old = self.slot(owner), self.now
        self._role(owner, WorkerRole.ACTIVE, new.epoch)
        if old is not None:
            self._role(old.owner, WorkerRole.DRAINING, old.epoch)
        self._plan(RoutePhase.PREPARE, new, old)
        self._wait(SlotReady, epoch=new.epoch, is_ready=True)
        self._plan(RoutePhase.FLIP, new, old)
        self._wait(SlotFlipped, epoch=new.epoch)
        if old is not None:
            self._wait(SlotDrained, epoch=old.epoch)
        self._plan(RoutePhase.CLOSE, new, None)
        self.now = new

    def stop(self) -> None:
        for worker in self.workers:
            worker.kill()
            worker.wait(5)

    def _role(self, node: str, role: WorkerRole, epoch: int) -> None:
        self.rig.relays[node].set_role(Role(task=self.name, role=role, epoch=epoch))

    def _plan(self, phase: RoutePhase, current: Slot, predecessor: Slot | None) -> None:
        plan = RoutePlan(task=self.name, phase=phase, current=current, predecessor=predecessor)
        self.rig.relays[ROBOT].apply(plan)

    def _wait(self, kind: type, **fields: Any) -> None:
        until(lambda: self.rig.reports[ROBOT].find(kind, task=self.name, **fields), f"{self.name}: {kind.__name__}")


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Any]:
    made = streams.Rig(folder=tmp_path)
    try:
        made.start()
        yield made
    finally:
        made.stop()


def chain(rig: Any, stream_class: StreamClass) -> tuple[Task, Task]:
    first = Task(rig, "first", f"{ROBOT}/in", f"{ROBOT}/between", stream_class)
    return first, Task(rig, "second", f"{ROBOT}/between", f"{ROBOT}/out", stream_class)


@pytest.mark.parametrize("stream_class", [StreamClass.RELIABLE, StreamClass.LATEST])
def test_a_chain_of_tasks_through_one_relay_survives_the_moves_of_either(rig: Any, stream_class: StreamClass) -> None:
    first, second = tasks = chain(rig, stream_class)
    try:
        for task in tasks:
            for node in ("edge1", "edge2"):
                task.start(node)
            task.move("edge1")
        app = streams.Application(rig.app)
        until(app.connected, "the application sees the relay's subscription")
        thread = app.stream(200)
        until(lambda: len(app.back) > 20, "samples through both tasks")
        for task, owner in ((first, "edge2"), (second, "edge2"), (first, "edge1"), (second, "edge1")):
            before = app.sent
            task.move(owner)
            until(lambda before=before: app.back[-1] > before, "samples behind the move")
        app.halt(thread)
        if stream_class is StreamClass.RELIABLE:
            until(lambda: len(app.back) >= app.sent, f"{app.sent} samples back, {len(app.back)} came")
            assert app.back == list(range(app.sent))
        else:
            until(lambda: app.back[-1] == app.sent - 1, "the newest value")
            assert app.back == sorted(app.back), "an older value behind a newer one"
    finally:
        for task in tasks:
            task.stop()


def test_a_task_that_comes_later_gets_the_last_output_of_the_one_before_it(rig: Any) -> None:
    first, second = tasks = chain(rig, StreamClass.LATEST)
    try:
        for task in tasks:
            task.start("edge1")
        first.move("edge1")
        between: list[str] = []
        kept = rig.app.declare_subscriber(f"{ROBOT}/between", lambda s: between.append(s.payload.to_string()))
        app = streams.Application(rig.app)
        until(app.connected, "the application sees the relay's subscription")
        app.put()
        until(lambda: between, "the first task's output")
        assert not app.back
        second.move("edge1")
        until(lambda: app.back == [0], "the kept output through the second task, with nothing new published")
        kept.undeclare()
    finally:
        for task in tasks:
            task.stop()
