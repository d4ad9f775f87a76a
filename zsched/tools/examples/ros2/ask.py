"""A ROS 2 node on robot1: asks twice a second and prints the answers. It knows nothing of zsched.

``/usr/bin/python3 ask.py [ENDPOINT]``; without one it joins where a robot's relay listens for its own host.
In a secured fleet that is the robot's local side, as ``zsched status -v`` names it (``tcp/127.0.0.1:7460``).
"""

import itertools
import os
import sys

ENDPOINT = sys.argv[1] if len(sys.argv) > 1 else "tcp/127.0.0.1:7458"
os.environ.setdefault("RMW_IMPLEMENTATION", "rmw_zenoh_cpp")
os.environ.setdefault("ZENOH_ROUTER_CHECK_ATTEMPTS", "-1")  # the relay takes the router's place
os.environ.setdefault("ZENOH_CONFIG_OVERRIDE", f'mode="client";connect/endpoints=["{ENDPOINT}"]')

import rclpy  # noqa: E402 - rmw_zenoh reads the settings above
from std_msgs.msg import String  # noqa: E402 - likewise


def main() -> None:
    """Ask until Ctrl-C."""
    rclpy.init()
    node = rclpy.create_node("ask", namespace="/robot1")
    questions = node.create_publisher(String, "question", 10)
    node.create_subscription(String, "answer", lambda answer: print(answer.data, flush=True), 10)
    numbers = itertools.count()
    node.create_timer(0.5, lambda: questions.publish(String(data=f"question {next(numbers)}")))
    rclpy.spin(node)


if __name__ == "__main__":
    main()
