"""A worker that is a managed node: it answers while it is active, and says each of its states on stderr."""

from __future__ import annotations

import os
import sys
from typing import Any

import rclpy
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.qos import QoSProfile
from std_msgs.msg import String

NODE = os.environ["ZSCHED_NODE"]
DONE = TransitionCallbackReturn.SUCCESS
DEEP = QoSProfile(depth=1000)


class Managed(LifecycleNode):  # type: ignore[misc] # no types where ROS is not
    """Subscribes and publishes once it is configured."""

    def __init__(self) -> None:
        super().__init__("slam", namespace=f"/{NODE}")
        self._is_active = False
        self._kept: list[Any] = []

    def _say(self, state: str) -> Any:
        print(f"{NODE}: state {state}", file=sys.stderr, flush=True)
        return DONE

    def on_configure(self, state: Any) -> Any:
        del state
        answers = self.create_publisher(String, f"/{NODE}/answers", DEEP)

        def on_word(word: Any) -> None:
            if self._is_active:
                answers.publish(String(data=f"{NODE} {word.data}"))

        self._kept.append(self.create_subscription(String, f"/{NODE}/chatter", on_word, DEEP))
        return self._say("inactive")

    def on_activate(self, state: Any) -> Any:
        self._is_active = True
        super().on_activate(state)
        return self._say("active")

    def on_deactivate(self, state: Any) -> Any:
        self._is_active = False
        super().on_deactivate(state)
        return self._say("inactive")


rclpy.init(domain_id=int(os.environ[f"DOMAIN_OF_{NODE}"]))
rclpy.spin(Managed())
