"""The robot's application: a plain rclpy node that talks, listens, asks and sends goals, and counts all of it.

A word a line on stdin (``talk``, ``quiet``, ``look``, ``ask``, ``silent``, ``goal N``); five times a second a line of
JSON on stdout with everything that it has counted. It ends when its stdin does.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import zlib
from typing import Any

import rclpy
from nav_msgs.msg import OccupancyGrid
from rclpy.action import ActionClient
from rclpy.qos import QoSPresetProfiles, QoSProfile
from sensor_msgs.msg import Image, LaserScan
from std_msgs.msg import String
from std_srvs.srv import Trigger
from test_msgs.action import Fibonacci

CHATTER_S, SCAN_S, IMAGE_S, ASK_S, TELL_S = 0.02, 0.1, 1.0, 0.1, 0.2
CALL_S = 20.0
"""A call that is not answered by then is lost: longer than the rule's `timeout_s`."""
IMAGE_BYTES = 6_000_000
LATCHED: Any = QoSPresetProfiles.ACTION_STATUS_DEFAULT.value
SENSOR: Any = QoSPresetProfiles.SENSOR_DATA.value


class Robot:
    """One node."""

    def __init__(self, node: Any) -> None:
        self._node = node
        self._words: set[str] = set()
        self._number = self._images = 0
        self.told: dict[str, Any] = {
            "sent": 0,
            "answers": [],
            "maps": [],
            "scans": [],
            "images": [],
            "crc": 0,
            "calls": [],
            "asked": 0,
            "goals": [],
        }
        self._chatter = node.create_publisher(String, "/chatter", QoSProfile(depth=1000))
        self._map = node.create_publisher(OccupancyGrid, "/map", LATCHED)
        self._scan = node.create_publisher(LaserScan, "/scan", SENSOR)
        self._image = node.create_publisher(Image, "/image", QoSProfile(depth=10))
        for topic, into, qos in (
            ("/answers", "answers", QoSProfile(depth=1000)),
            ("/map_seen", "maps", LATCHED),
            ("/scan_seen", "scans", SENSOR),
            ("/image_seen", "images", QoSProfile(depth=10)),
        ):
            node.create_subscription(
                String, topic, lambda one, into=into: self.told[into].append(one.data.split()), qos
            )
        self._client = node.create_client(Trigger, "/now")
        self._action = ActionClient(node, Fibonacci, "/fibonacci")
        self._asked_s: float | None = None
        self._pixels = bytes(range(256)) * (IMAGE_BYTES // 256)
        self.told |= {"size": len(self._pixels), "crc": zlib.crc32(self._pixels)}
        for period_s, act in (
            (CHATTER_S, self._talk),
            (SCAN_S, self._look),
            (IMAGE_S, self._show),
            (ASK_S, self._ask),
            (TELL_S, self._tell),
        ):
            node.create_timer(period_s, act)
        grid = OccupancyGrid()
        grid.info.width, grid.info.height, grid.data = 3, 2, [1, 2, 3, 4, 5, 6]
        self._map.publish(grid)

    def hear(self, word: str) -> None:
        """In the thread that reads stdin."""
        name, _, rest = word.partition(" ")
        opposite = {"quiet": "talk", "silent": "ask"}
        if name in opposite:
            self._words.discard(opposite[name])
        elif name == "goal":
            self._words.add(f"goal {rest}")
        else:
            self._words.add(name)

    def _talk(self) -> None:
        if "talk" in self._words:
            self.told["sent"] += 1
            self._chatter.publish(String(data=str(self.told["sent"])))

    def _look(self) -> None:
        if "look" in self._words:
            self._number += 1
            scan = LaserScan(ranges=[1.5] * 360)
            scan.header.frame_id = str(self._number)
            self._scan.publish(scan)

    def _show(self) -> None:
        if "look" in self._words:
            self._images += 1
            image = Image(height=1, width=IMAGE_BYTES // 3, encoding="rgb8", step=IMAGE_BYTES)
            image.header.frame_id = str(self._images)
            image.data.frombytes(self._pixels)
            self._image.publish(image)

    def _now_s(self) -> float:
        return float(self._node.get_clock().now().nanoseconds) / 1e9

    def _ask(self) -> None:
        goals = [one for one in self._words if one.startswith("goal")]
        for goal in goals:
            self._words.discard(goal)
            self._send(int(goal.split()[1]))
        if self._asked_s is not None and self._now_s() - self._asked_s > CALL_S:
            self.told["calls"].append("lost")
            self._asked_s = None
        if "ask" in self._words and self._asked_s is None and self._client.service_is_ready():
            self._asked_s = self._now_s()
            self.told["asked"] += 1
            self._client.call_async(Trigger.Request()).add_done_callback(self._answered)

    def _answered(self, future: Any) -> None:
        self._asked_s = None
        self.told["calls"].append(future.result().message)

    def _send(self, order: int) -> None:
        goal: dict[str, Any] = {"order": order, "feedback": 0, "status": None, "result": None}
        self.told["goals"].append(goal)

        def on_feedback(message: Any) -> None:
            goal["feedback"] = max(goal["feedback"], len(message.feedback.sequence))

        def on_accepted(future: Any) -> None:
            if future.result().accepted:
                future.result().get_result_async().add_done_callback(on_result)

        def on_result(future: Any) -> None:
            goal["status"], goal["result"] = future.result().status, list(future.result().result.sequence)

        self._action.send_goal_async(Fibonacci.Goal(order=order), on_feedback).add_done_callback(on_accepted)

    def _tell(self) -> None:
        ready = {"now": self._client.service_is_ready(), "fibonacci": self._action.server_is_ready()}
        print(json.dumps({**self.told, "ready": ready}), flush=True)


def main() -> None:
    rclpy.init()
    robot = Robot(node := rclpy.create_node("robot"))

    def read() -> None:
        for line in sys.stdin:
            robot.hear(line.strip())
        os._exit(0)

    threading.Thread(target=read, daemon=True).start()
    rclpy.spin(node)


main()
