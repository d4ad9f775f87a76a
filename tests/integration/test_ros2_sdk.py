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

from support.ros_host import RosHost
from support.waiting import until

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

    def __init__(self, role: str, endpoint: str) -> None:
        command = [sys.executable, str(NODE), role, *endpoint.removeprefix("tcp/").split(":")]
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
            self.process.wait(60)
        self.process.stdout.close()


class Rig(RosHost):
    """A robot's host, and foreign nodes beside it and on the edges."""

    def __init__(self, stack: contextlib.ExitStack) -> None:
        super().__init__(stack, FILE)
        self._stack = stack

    def node(self, role: str, endpoint: str) -> Node:
        made = Node(role, endpoint)
        self._stack.callback(made.stop)
        return made


@pytest.fixture
def rig() -> Iterator[Rig]:
    with contextlib.ExitStack() as stack:
        made = Rig(stack)
        yield made
        made.assert_nothing_is_unaccounted()


def test_a_foreign_node_talks_listens_asks_and_looks_through_a_move(rig: Rig) -> None:
    robot = rig.node("robot", rig.host)
    for owner in ("edge1", "edge2"):
        rig.node(owner, rig.seed)
    rig.move("edge1")
    robot.asks_until("publish one", "heard", ["edge1 one"])
    robot.asks_until("ask", "answer", ["done by edge1"])
    robot.asks_until("graph /chatter", "graph", [["talker"], ["zsched_robot1"]])
    rig.move("edge2")
    robot.asks_until("publish two", "heard", ["edge2 two"])
    robot.asks_until("ask", "answer", ["done by edge2"])
    robot.asks_until("graph /answers", "graph", [["zsched_robot1"], ["listener"]])
