"""shout, as a ROS 2 node: gives every question back in capitals, with the name of the machine that answers."""

import os
import sys
from functools import partial

import rclpy
from std_msgs.msg import String

NODE = os.environ["ZSCHED_NODE"]
ROBOTS = sys.argv[1:] or ["robot1"]


def main() -> None:
    """Answer until the daemon says stop."""
    rclpy.init()
    node = rclpy.create_node("shout", namespace=f"/{NODE}/shout")

    def on_question(answers: object, question: String) -> None:
        answers.publish(String(data=f"{question.data.upper()} (by {NODE})"))  # type: ignore[attr-defined]

    for robot in ROBOTS:
        answers = node.create_publisher(String, f"{robot}/answer", 10)
        node.create_subscription(String, f"{robot}/question", partial(on_question, answers), 10)
    rclpy.spin(node)


if __name__ == "__main__":
    main()
