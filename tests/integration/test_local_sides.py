"""Robots whose applications all publish `/map` beside routers of their own: each hears its own results only.

Real relays, a real worker's session, and a zenoh router per robot, as `rmw_zenohd` is one.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import zenoh

from support.books import assert_nothing_is_unaccounted
from support.sessions import opened
from support.waiting import free_endpoint, until
from zsched.core.values.events import ProblemReported, RelayChanged, SlotFlipped, SlotReady
from zsched.core.values.fleet import LocalMode, LocalSide
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
from zsched.link.sessions.config import client_config, data_config, local_config, worker_config
from zsched.runtime.relay.streams import RelayHandle
from zsched_lab.fleet.relays import hello_of

ROBOTS = ("robot1", "robot2", "robot3")
TASK = "merge"


def router(endpoint: str) -> zenoh.Session:
    """What a host's `rmw_zenohd` is: a router that nobody else is joined to."""
    config = zenoh.Config.from_json5(client_config(connect=()))
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", f'["{endpoint}"]')
    return zenoh.open(config)


@dataclass
class Robot:
    """One host: its router, its application and its relay."""

    folder: Path
    name: str
    seed: str
    mode: LocalMode = LocalMode.CLIENT
    endpoint: str = field(default_factory=free_endpoint)
    reports: list[HandleReport] = field(default_factory=list)
    heard: list[bytes] = field(default_factory=list)
    sessions: list[zenoh.Session] = field(default_factory=list)
    relay: RelayHandle | None = None

    def start_relay(self) -> None:
        side = LocalSide(mode=self.mode, connect=(self.endpoint,))
        self.relay = RelayHandle(
            hello=hello_of("test", self.name),
            path=self.folder / f"{self.name}.relay",
            zenoh_config=data_config(listen=("tcp/127.0.0.1:0",), connect=(self.seed,), shared_memory=False),
            on_report=self.reports.append,
            local_config=local_config(side),
        )
        self.relay.start()
        until(lambda: any(isinstance(one, RelayChanged) for one in tuple(self.reports)), "the relay runs")

    def start_host(self) -> None:
        self.sessions.append(router(self.endpoint))
        app = opened(client_config(connect=(self.endpoint,)))
        self.sessions.append(app)
        app.declare_subscriber("global_map", lambda sample: self.heard.append(sample.payload.to_bytes()))
        self.publisher = app.declare_publisher("map")

    def plan(self, *phases: RoutePhase) -> None:
        assert self.relay is not None
        for phase in phases:
            self.relay.apply(RoutePlan(task=TASK, phase=phase, current=self.slot()))
            self.wait(SlotFlipped if phase is RoutePhase.FLIP else SlotReady)

    def slot(self) -> Slot:
        settings = StreamSettings(stream_class=StreamClass.RELIABLE, depth=100)
        pairs = {
            Direction.INPUT: ("map", f"edge1/{TASK}/{self.name}/map"),
            Direction.OUTPUT: (f"edge1/{TASK}/1/{self.name}/global_map", "global_map"),
        }
        routes = tuple(
            Route(stream=f"{TASK}/{way}/0", direction=way, from_expr=one, to_expr=two, settings=settings)
            for way, (one, two) in pairs.items()
        )
        return Slot(epoch=1, owner="edge1", routes=routes, ready_when=ReadyWhen.MATCHING)

    def wait(self, kind: type) -> None:
        until(lambda: any(isinstance(one, kind) for one in tuple(self.reports)), f"{kind.__name__} of {self.name}")

    def problems(self) -> list[str | None]:
        return [one.problem for one in tuple(self.reports) if isinstance(one, ProblemReported)]

    def put(self, text: str) -> bool:
        """Publish a map; `False`, so that conditions can be joined with ``or``."""
        self.publisher.put(text)
        return False

    def is_connected(self) -> bool:
        status: Any = self.publisher.matching_status
        return bool(status.matching)

    def stop(self) -> None:
        if self.relay is not None:
            self.relay.stop(2.0)
        for session in reversed(self.sessions):
            session.close()


class Edge:
    """A worker on the fleet's side: answers each robot's map under the robot's name, and hears everything."""

    def __init__(self, seed: str) -> None:
        self.session = opened(worker_config(connect=(), listen=(seed,), shared_memory=False))
        self.everything: list[str] = []
        self.session.declare_subscriber("**", lambda sample: self.everything.append(str(sample.key_expr)))
        maps: zenoh.handlers.FifoChannel[zenoh.Sample] = zenoh.handlers.FifoChannel(1000)
        self._maps = self.session.declare_subscriber(f"edge1/{TASK}/*/map", maps)

    def answer(self) -> bool:
        """Answer what is there; `False`, so that conditions can be joined with ``or``."""
        while (sample := self._maps.handler.try_recv()) is not None:
            robot = str(sample.key_expr).split("/")[2]
            self.session.put(f"edge1/{TASK}/1/{robot}/global_map", b"merged " + sample.payload.to_bytes())
        return False


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[tuple[Edge, dict[str, Robot]]]:
    seed = free_endpoint()
    with contextlib.ExitStack() as stack:
        edge = Edge(seed)
        stack.callback(edge.session.close)
        robots = {name: Robot(folder=tmp_path, name=name, seed=seed) for name in ROBOTS}
        for robot in robots.values():
            stack.callback(robot.stop)
        yield edge, robots
        for robot in robots.values():
            if robot.relay is not None:
                assert_nothing_is_unaccounted(lambda robot=robot: tuple(robot.reports))  # type: ignore[misc] # at once


def test_three_robots_publish_map_and_each_hears_its_own_result(rig: tuple[Edge, dict[str, Robot]]) -> None:
    edge, robots = rig
    for robot in robots.values():
        robot.start_host()
        robot.start_relay()
        robot.plan(RoutePhase.PREPARE, RoutePhase.FLIP)
        until(robot.is_connected, f"the relay of {robot.name} subscribes on its local side")
    for count in range(20):
        for robot in robots.values():
            robot.put(f"{robot.name} {count}")
    for robot in robots.values():
        until(partial(lambda one: edge.answer() or len(one.heard) >= 20, robot), f"the answers for {robot.name}")
    for robot in robots.values():
        assert robot.heard == [f"merged {robot.name} {count}".encode() for count in range(20)]
    assert {"map", "global_map"}.isdisjoint(edge.everything), "the hosts' keys stay on the hosts"


def test_a_router_that_comes_late_or_again_is_joined(rig: tuple[Edge, dict[str, Robot]]) -> None:
    edge, robots = rig
    robot = robots["robot1"]
    robot.start_relay()
    assert robot.relay is not None
    until(lambda: any(robot.problems()), "the relay says that the router is missing")
    robot.relay.apply(RoutePlan(task=TASK, phase=RoutePhase.FLIP, current=robot.slot()))
    robot.start_host()
    until(lambda: robot.problems()[-1:] == [None], "the router is joined")
    robot.wait(SlotFlipped)
    until(lambda: robot.put("first") or edge.answer() or robot.heard, "the stream flows")
    for session in reversed(robot.sessions):
        session.close()
    robot.sessions.clear()
    robot.heard.clear()
    robot.start_host()
    until(lambda: robot.put("again") or edge.answer() or b"merged again" in robot.heard, "it flows again")


def test_peers_of_the_host_are_met_without_a_router(rig: tuple[Edge, dict[str, Robot]]) -> None:
    edge, robots = rig
    robot = robots["robot2"]
    robot.mode = LocalMode.PEER
    app = opened(worker_config(connect=(), listen=(robot.endpoint,), shared_memory=False))
    robot.sessions.append(app)
    app.declare_subscriber("global_map", lambda sample: robot.heard.append(sample.payload.to_bytes()))
    robot.publisher = app.declare_publisher("map")
    robot.start_relay()
    robot.plan(RoutePhase.PREPARE, RoutePhase.FLIP)
    until(robot.is_connected, "the relay subscribes on its local side")
    until(lambda: robot.put("map") or edge.answer() or robot.heard, "the stream flows")
    assert set(robot.heard) == {b"merged map"}
