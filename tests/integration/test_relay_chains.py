"""Chains of tasks: one task's output is another one's input on the same robot, through one relay; either moves."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from support.relay_rig import ROBOT, Application, Rig, relay_rig
from support.waiting import until
from zsched.core.values.plan import (
    Direction,
    HandoverRule,
    ReadyWhen,
    Route,
    Slot,
    StreamClass,
    StreamSettings,
)


@dataclass
class Task:
    """One task of the chain, driven by hand: an echo worker on each edge, ``source`` in, ``sink`` out."""

    rig: Rig
    name: str
    source: str
    sink: str
    stream_class: StreamClass = StreamClass.RELIABLE
    epoch: int = 0
    now: Slot | None = None

    def start(self, node: str) -> None:
        options = ["--latest"] if self.stream_class is StreamClass.LATEST else []
        self.rig.start_worker(node, *options, task=self.name)

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
        new = self.slot(owner)
        self.rig.move(new, self.now, task=self.name)
        self.now = new


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    with relay_rig(tmp_path) as made:
        yield made


def chain(rig: Rig, stream_class: StreamClass) -> tuple[Task, Task]:
    first = Task(rig, "first", f"{ROBOT}/in", f"{ROBOT}/between", stream_class)
    return first, Task(rig, "second", f"{ROBOT}/between", f"{ROBOT}/out", stream_class)


@pytest.mark.long
@pytest.mark.parametrize("stream_class", [StreamClass.RELIABLE, StreamClass.LATEST])
def test_a_chain_of_tasks_through_one_relay_survives_the_moves_of_either(rig: Rig, stream_class: StreamClass) -> None:
    first, second = tasks = chain(rig, stream_class)
    for task in tasks:
        for node in ("edge1", "edge2"):
            task.start(node)
        task.move("edge1")
    app = Application(rig.app)
    until(app.connected, "the application sees the relay's subscription")
    thread = app.stream(200)
    until(lambda: len(app.back) > 20, "samples through both tasks")
    for task, owner in ((first, "edge2"), (second, "edge2"), (first, "edge1"), (second, "edge1")):
        before = app.sent
        task.move(owner)
        until(lambda before=before: app.back[-1] > before, "samples behind the move")  # type: ignore[misc] # bound at once
    app.halt(thread)
    if stream_class is StreamClass.RELIABLE:
        until(lambda: len(app.back) >= app.sent, f"{app.sent} samples back, {len(app.back)} came")
        assert app.back == list(range(app.sent))
    else:
        until(lambda: app.back[-1] == app.sent - 1, "the newest value")
        assert app.back == sorted(app.back), "an older value behind a newer one"


def test_a_task_that_comes_later_gets_the_last_output_of_the_one_before_it(rig: Rig) -> None:
    first, second = tasks = chain(rig, StreamClass.LATEST)
    for task in tasks:
        task.start("edge1")
    first.move("edge1")
    between: list[str] = []
    kept = rig.app.declare_subscriber(f"{ROBOT}/between", lambda s: between.append(s.payload.to_string()))
    app = Application(rig.app)
    until(app.connected, "the application sees the relay's subscription")
    app.put()
    until(lambda: between, "the first task's output")
    assert not app.back
    second.move("edge1")
    until(lambda: app.back == [0], "the kept output through the second task, with nothing new published")
    kept.undeclare()
