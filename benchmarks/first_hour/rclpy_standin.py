"""Takes the place of rclpy and std_msgs where there is no ROS: the few calls of the ROS 2 example, over zenoh_ros2_sdk.

That library speaks rmw_zenoh's protocol by itself, so keys, attachments, encoding and tokens are a ROS node's.
What ROS itself does with them is not shown by this. The clean machine has it as its module ``rclpy``.
"""

from __future__ import annotations

import importlib
import json
import os
import signal
import sys
import threading
import types
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

STRING = {
    "msg_type": "std_msgs/msg/String",
    "msg_definition": "string data\n",
    "type_hash": "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
}


@dataclass
class String:
    """std_msgs/msg/String."""

    data: str = ""


def _join() -> None:
    """Dial every endpoint of the session file, as rmw_zenoh does.

    A worker dials the relays of all machines; the library would put one address in their place.
    """
    file = os.environ.get("ZENOH_SESSION_CONFIG_URI")
    if file is None:
        return  # ZENOH_CONFIG_OVERRIDE names the endpoint
    endpoints = json.dumps(json.loads(Path(file).read_text())["connect"]["endpoints"])
    session: Any = importlib.import_module("zenoh_ros2_sdk.session")
    zenoh: Any = importlib.import_module("zenoh")

    def open_(config: Any) -> Any:
        config.insert_json5("connect/endpoints", endpoints)
        return zenoh.open(config)

    session.zenoh = types.SimpleNamespace(open=open_, Config=zenoh.Config)


class _Publisher:
    def __init__(self, publisher: Any) -> None:
        self._publisher = publisher

    def publish(self, message: String) -> None:
        self._publisher.publish(data=message.data)


class _Node:
    def __init__(self, name: str, namespace: str) -> None:
        os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")  # the library looks for git, which a clean machine lacks
        self._sdk: Any = importlib.import_module("zenoh_ros2_sdk")
        _join()
        self._name, self._namespace = name, namespace
        self._kept: list[Any] = []
        self.timers: list[tuple[float, Callable[[], object]]] = []

    def create_publisher(self, _kind: type, topic: str, _depth: int) -> _Publisher:
        name = f"{self._namespace}/{topic}"
        return _Publisher(self._sdk.ROS2Publisher(name, node_name=self._name, **STRING))

    def create_subscription(self, _kind: type, topic: str, act: Callable[[String], object], _depth: int) -> None:
        def on_message(message: Any) -> None:
            act(String(message.data))

        name = f"{self._namespace}/{topic}"
        self._kept.append(self._sdk.ROS2Subscriber(name, callback=on_message, node_name=self._name, **STRING))

    def create_timer(self, period_s: float, act: Callable[[], object]) -> None:
        self.timers.append((period_s, act))


def init() -> None:
    """Nothing to do: a node joins when it makes its first end."""


def create_node(name: str, namespace: str = "") -> _Node:
    """A node."""
    return _Node(name, namespace)


def spin(node: _Node) -> None:
    """Serve the node until a signal ends the process."""
    end = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: end.set())
    period_s, act = node.timers[0] if node.timers else (1.0, None)
    while not end.wait(period_s):
        if act is not None:
            act()
    sys.stdout.flush()
    os._exit(0)  # the library's session has callbacks, and would hold the interpreter


_package, _messages = types.ModuleType("std_msgs"), types.ModuleType("std_msgs.msg")
_messages.String = String  # type: ignore[attr-defined]
sys.modules.update({"std_msgs": _package, "std_msgs.msg": _messages})
