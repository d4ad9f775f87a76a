"""The worker: a plain rclpy node in the namespace of its machine, which answers topics, a service and an action.

It knows nothing of zsched but `ZSCHED_NODE`, as any stock node that is started with ``-r __ns:=/$ZSCHED_NODE/app``.
"""

from __future__ import annotations

import os
import sys
import threading
import zlib
from typing import Any

import rclpy
from nav_msgs.msg import OccupancyGrid
from rclpy.action import ActionServer
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.qos import QoSPresetProfiles, QoSProfile
from sensor_msgs.msg import Image, LaserScan
from std_msgs.msg import String
from std_srvs.srv import Trigger
from test_msgs.action import Fibonacci

NODE = os.environ["ZSCHED_NODE"]
STEP_S = 0.1
LATCHED: Any = QoSPresetProfiles.ACTION_STATUS_DEFAULT.value
SENSOR: Any = QoSPresetProfiles.SENSOR_DATA.value


def main() -> None:
    rclpy.init(domain_id=int(os.environ[f"DOMAIN_OF_{NODE}"]))
    node = rclpy.create_node("app", namespace=f"/{NODE}/app")
    answers = node.create_publisher(String, "answers", QoSProfile(depth=1000))
    seen = {
        name: node.create_publisher(String, f"{name}_seen", qos)
        for name, qos in (("map", LATCHED), ("scan", SENSOR), ("image", QoSProfile(depth=10)))
    }

    def see(name: str, text: str) -> None:
        seen[name].publish(String(data=f"{NODE} {text}"))

    def on_image(image: Any) -> None:
        see("image", f"{image.header.frame_id} {len(image.data)} {zlib.crc32(bytes(image.data))}")

    node.create_subscription(
        String, "chatter", lambda one: answers.publish(String(data=f"{NODE} {one.data}")), QoSProfile(depth=1000)
    )
    node.create_subscription(OccupancyGrid, "map", lambda one: see("map", f"{one.info.width} {sum(one.data)}"), LATCHED)
    node.create_subscription(
        LaserScan, "scan", lambda one: see("scan", f"{one.header.frame_id} {len(one.ranges)}"), SENSOR
    )
    node.create_subscription(Image, "image", on_image, QoSProfile(depth=10))

    def serve(_request: Any, response: Any) -> Any:
        response.success, response.message = True, NODE
        return response

    node.create_service(Trigger, "now", serve)
    group = ReentrantCallbackGroup()

    def work(goal: Any) -> Any:
        feedback = Fibonacci.Feedback(sequence=[0, 1])
        for _ in range(goal.request.order):
            feedback.sequence.append(feedback.sequence[-1] + feedback.sequence[-2])
            goal.publish_feedback(feedback)
            pause.wait(STEP_S)
        goal.succeed()
        return Fibonacci.Result(sequence=feedback.sequence)

    pause = threading.Event()
    server = ActionServer(node, Fibonacci, "fibonacci", work, callback_group=group)
    executor = MultiThreadedExecutor(num_threads=3)
    executor.add_node(node)
    print(f"{NODE}: up", file=sys.stderr, flush=True)
    executor.spin()
    del server


main()
