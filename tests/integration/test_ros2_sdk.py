"""An independent implementation of rmw_zenoh's protocol (zenoh_ros2_sdk) on both sides of a relay notices nothing."""

from __future__ import annotations

import contextlib
import json
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh

from support.waiting import free_port, until
from zsched.adapters.streams import RelayHandle
from zsched.config import check_bytes
from zsched.core.events import RelayChanged, SlotFlipped, SlotReady
from zsched.core.fleet import LocalSide
from zsched.core.plan import RoutePhase
from zsched.core.relay_protocol import HandleReport
from zsched.core.route import plan_for, slot_for
from zsched.zenoh_config import client_config, data_config, local_config

NODE = Path(__file__).with_name("ros2_sdk_node.py")
FILE = """\
fleet: test
nodes:
  robot1: {kind: robot, wired: true, local: {connect: ["tcp/127.0.0.1:7447"]}, host: h, listen: LISTEN}
  edge1: {kind: edge}
  edge2: {kind: edge}
electorate: [robot1, edge1, edge2]
tasks:
  echo:
    candidates: [edge1, edge2]
    weights: {cpu: 1}
    worker: {ready: matching}
    ros2:
      inputs: [{topic: /chatter, type: std_msgs/msg/String, worker_topic: "/{target}/echo/{robot}/chatter"}]
      outputs: [{topic: /answers, type: std_msgs/msg/String, worker_topic: "/{target}/echo/answers"}]
      services: [{service: /merge_now, type: std_srvs/srv/Trigger, worker_service: "/{target}/echo/now"}]
""".replace("LISTEN", "{control: tcp/127.0.0.1:1, data: tcp/127.0.0.1:2}")


class Node:
    """One process with the foreign library."""

    def __init__(self, role: str, port: int) -> None:
        command = [sys.executable, str(NODE), role, str(port)]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self._said: queue.SimpleQueue[list[Any]] = queue.SimpleQueue()
        threading.Thread(target=self._read, daemon=True).start()
        self.expect("ready")

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self._said.put(json.loads(line))

    def tell(self, text: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(text + "\n")
        self.process.stdin.flush()

    def expect(self, word: str, deadline_s: float = 15.0) -> list[Any]:
        """The next thing of that kind that it says."""
        end = time.monotonic() + deadline_s
        while True:
            said = self._said.get(timeout=max(0.01, end - time.monotonic()))
            if said[0] == word:
                return said

    def asks_until(self, question: str, word: str, wanted: list[Any]) -> None:
        """Ask again and again until the answer is the wanted one."""

        def answer() -> bool:
            self.tell(question)
            return self.expect(word)[1:] == wanted

        until(answer, f"{question} -> {wanted}")

    def stop(self) -> None:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        with contextlib.suppress(OSError):
            self.process.stdin.close()
        try:
            self.process.wait(3.0)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait(3.0)
        self.process.stdout.close()


class Rig:
    """A robot's host with a router and a relay; edges whose nodes join the data network."""

    def __init__(self, stack: contextlib.ExitStack) -> None:
        result = check_bytes(FILE.encode())
        assert result.fleet is not None, result.report()
        self.task = result.fleet.tasks[0]
        self.host, self.data = free_port(), free_port()
        router = zenoh.Config.from_json5(client_config(connect=()))
        router.insert_json5("mode", '"router"')
        router.insert_json5("listen/endpoints", f'["tcp/127.0.0.1:{self.host}"]')
        stack.callback(zenoh.open(router).close)
        self.reports: list[HandleReport] = []
        self.relay = RelayHandle(
            fleet="test",
            node="robot1",
            zenoh_config=data_config(listen=(f"tcp/127.0.0.1:{self.data}",), connect=(), shared_memory=False),
            on_report=self.reports.append,
            local_config=local_config(LocalSide(connect=(f"tcp/127.0.0.1:{self.host}",))),
        )
        self.relay.start()
        stack.callback(self.relay.stop, 2.0)
        until(lambda: any(isinstance(report, RelayChanged) for report in tuple(self.reports)), "the relay runs")
        self._stack = stack

    def node(self, role: str, port: int) -> Node:
        made = Node(role, port)
        self._stack.callback(made.stop)
        return made

    def move(self, owner: str, epoch: int) -> None:
        old = slot_for(self.task, "robot1", "edge1", epoch - 1) if epoch > 1 else None
        for phase, kind in ((RoutePhase.PREPARE, SlotReady), (RoutePhase.FLIP, SlotFlipped), (RoutePhase.CLOSE, None)):
            self.relay.apply(plan_for(self.task, phase, slot_for(self.task, "robot1", owner, epoch), old))
            if kind is not None:
                self._wait(kind, epoch)

    def _wait(self, kind: type, epoch: int) -> None:
        def has_said() -> bool:
            return any(isinstance(one, kind) and getattr(one, "epoch", 0) == epoch for one in tuple(self.reports))

        until(has_said, f"{kind.__name__} {epoch}")


@pytest.fixture
def rig() -> Iterator[Rig]:
    with contextlib.ExitStack() as stack:
        yield Rig(stack)


def test_a_foreign_node_talks_listens_asks_and_looks_through_a_move(rig: Rig) -> None:
    robot = rig.node("robot", rig.host)
    for owner in ("edge1", "edge2"):
        rig.node(owner, rig.data)
    rig.move("edge1", 1)
    robot.asks_until("publish one", "heard", ["edge1 one"])
    robot.asks_until("ask", "answer", ["done by edge1"])
    robot.asks_until("graph /chatter", "graph", [["talker"], ["zsched_robot1"]])
    rig.move("edge2", 2)
    robot.asks_until("publish two", "heard", ["edge2 two"])
    robot.asks_until("ask", "answer", ["done by edge2"])
    robot.asks_until("graph /answers", "graph", [["zsched_robot1"], ["listener"]])
