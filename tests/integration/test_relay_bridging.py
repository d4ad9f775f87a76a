"""A relay between two daemons: what it carries on, what the next daemon's first plans change."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest
import zenoh

from support.books import assert_nothing_is_unaccounted
from support.waiting import free_endpoint, until
from zsched.core.values.events import RelayChanged, SlotFlipped, SlotReady
from zsched.core.values.plan import (
    Direction,
    ReadyWhen,
    Route,
    RoutePhase,
    RoutePlan,
    Slot,
    StreamClass,
    StreamSettings,
)
from zsched.core.values.relay_protocol import HandleReport
from zsched.link.sessions.config import data_config, worker_config
from zsched.runtime.relay.streams import RelayHandle
from zsched_lab.fleet.relays import hello_of

RELIABLE = StreamSettings(stream_class=StreamClass.RELIABLE, depth=500)


def slot(epoch: int) -> Slot:
    """The robot's input and output towards a foreign worker on ``edge<epoch>``."""
    node = f"edge{epoch}"
    routes = (
        Route(
            stream="t/in/0",
            direction=Direction.INPUT,
            from_expr="robot1/in",
            to_expr=f"{node}/t/in",
            settings=RELIABLE,
        ),
        Route(
            stream="t/out/0",
            direction=Direction.OUTPUT,
            from_expr=f"{node}/t/{epoch}/out",
            to_expr="robot1/out",
            settings=RELIABLE,
        ),
    )
    return Slot(epoch=epoch, owner=node, routes=routes, ready_when=ReadyWhen.MATCHING)


@dataclass
class Node:
    """Daemons of one node, one after the other, and an application that is the workers, too."""

    folder: Path
    endpoint: str = field(default_factory=free_endpoint)
    handles: list[RelayHandle] = field(default_factory=list)
    reports: list[HandleReport] = field(default_factory=list)

    def daemon(self) -> RelayHandle:
        self.reports.clear()
        handle = RelayHandle(
            hello=hello_of("test", "robot1"),
            path=self.folder / "robot1.relay",
            zenoh_config=data_config(listen=(self.endpoint,), connect=(), shared_memory=False),
            on_report=self.reports.append,
        )
        self.handles.append(handle)
        handle.start()
        self.wait(RelayChanged, is_running=True)
        return handle

    def wait(self, kind: type, **fields: object) -> None:
        until(lambda: self._has(kind, fields), f"{kind.__name__} {fields}")

    def _has(self, kind: type, fields: dict[str, object]) -> bool:
        return any(
            isinstance(report, kind) and all(getattr(report, name) == value for name, value in fields.items())
            for report in tuple(self.reports)
        )

    def plan(self, phase: RoutePhase, new: Slot, old: Slot | None = None) -> None:
        self.handles[-1].apply(
            RoutePlan(task="t", phase=phase, current=new, predecessors=() if old is None else (old,))
        )

    def settle(self, new: Slot) -> None:
        """What an executor says about a slot when it knows of no other."""
        for phase, report in ((RoutePhase.PREPARE, SlotReady), (RoutePhase.FLIP, SlotFlipped)):
            self.plan(phase, new)
            self.wait(report, epoch=new.epoch)
        self.plan(RoutePhase.CLOSE, new)


@pytest.fixture
def node(tmp_path: Path) -> Iterator[Node]:
    made = Node(tmp_path)
    made.daemon()
    try:
        yield made
        assert_nothing_is_unaccounted(lambda: tuple(made.reports))
    finally:
        made.handles[-1].stop(2.0)
        # its child is reaped, whoever stopped it
        until(lambda: made.handles[0].pid is None, "the end of the first daemon's child")


@pytest.fixture
def app(node: Node) -> Iterator[zenoh.Session]:
    with zenoh.open(zenoh.Config.from_json5(worker_config(connect=(node.endpoint,), shared_memory=False))) as session:
        yield session


def flows(app: zenoh.Session, taken: list[bytes]) -> None:
    """Something that is put now arrives."""
    before = len(taken)
    until(lambda: app.put("robot1/in", b"x") or len(taken) > before, "the input flows")


def test_a_move_that_the_next_daemon_does_not_know_of_leaves_the_stream_whole(node: Node, app: zenoh.Session) -> None:
    """The old daemon ended between PREPARE and FLIP; the new one has learnt the newer epoch, names no predecessor."""
    first: list[bytes] = []
    second: list[bytes] = []
    worker = app.declare_subscriber("edge1/t/in", lambda sample: first.append(sample.payload.to_bytes()))
    node.settle(slot(1))
    flows(app, first)
    node.plan(RoutePhase.PREPARE, slot(2), slot(1))
    flows(app, first)
    node.handles[-1].leave()
    flows(app, first)
    node.daemon()
    node.plan(RoutePhase.PREPARE, slot(2))
    flows(app, first)
    assert not node._has(SlotReady, {"epoch": 2, "is_ready": True})
    other = app.declare_subscriber("edge2/t/in", lambda sample: second.append(sample.payload.to_bytes()))
    node.wait(SlotReady, epoch=2, is_ready=True)
    assert second == []
    node.plan(RoutePhase.FLIP, slot(2))
    node.wait(SlotFlipped, epoch=2)
    flows(app, second)
    node.plan(RoutePhase.CLOSE, slot(2))
    worker.undeclare()
    other.undeclare()
