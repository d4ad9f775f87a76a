"""A ROS 2 node by somebody else: zenoh_ros2_sdk speaks rmw_zenoh's protocol from Python. Started by test_ros2_sdk.py.

``ros2_sdk_node.py ROLE PORT``; says on stdout, one JSON value a line, what it hears, and ends when its stdin does.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
from typing import Any

ros: Any = importlib.import_module("zenoh_ros2_sdk")

STRING = {
    "msg_type": "std_msgs/msg/String",
    "msg_definition": "string data\n",
    "type_hash": "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
}
TRIGGER = {
    "srv_type": "std_srvs/srv/Trigger",
    "request_definition": "",
    "response_definition": "bool success\nstring message\n",
    "type_hash": "RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f",
}


def say(value: Any) -> None:
    print(json.dumps(value), flush=True)


def robot(where: dict[str, Any]) -> None:
    """Talks on /chatter, listens to /answers, asks /merge_now, looks at the graph."""
    heard = ros.ROS2Subscriber(
        "/answers", callback=lambda message: say(["heard", message.data]), node_name="listener", **STRING, **where
    )
    talker = ros.ROS2Publisher("/chatter", node_name="talker", **STRING, **where)
    client = ros.ROS2ServiceClient("/merge_now", timeout=3.0, **TRIGGER, **where)
    say(["ready"])
    for line in sys.stdin:
        word, _, rest = line.strip().partition(" ")
        if word == "publish":
            talker.publish(data=rest)
        elif word == "ask":
            answer = client.call()
            say(["answer", None if answer is None else answer.message])
        elif word == "graph":
            info = ros.get_topic_info(rest, verbose=True, **where)
            assert heard is not None  # it must be kept
            say(["graph", *(sorted(one.node_name for one in ends) for ends in (info.publishers, info.subscribers))])


def worker(where: dict[str, Any], owner: str) -> None:
    """Answers what robot1 says, and serves."""
    back = ros.ROS2Publisher(f"/{owner}/echo/answers", **STRING, **where)
    name = f"/{owner}/echo/robot1/chatter"
    heard = ros.ROS2Subscriber(name, callback=lambda one: back.publish(data=f"{owner} {one.data}"), **STRING, **where)
    servers: list[Any] = []

    def serve(_request: Any) -> Any:
        return servers[0].response_msg_class(success=True, message=f"done by {owner}")

    servers.append(ros.ROS2ServiceServer(f"/{owner}/echo/now", callback=serve, **TRIGGER, **where))
    say(["ready"])
    sys.stdin.read()
    assert heard is not None  # it must be kept


def main() -> None:
    role, address, port = sys.argv[1:]
    where = {"router_ip": address, "router_port": int(port), "domain_id": 0}
    if role == "robot":
        robot(where)
    else:
        worker(where, role)
    os._exit(0)  # the library's session has callbacks, and would hold the interpreter


if __name__ == "__main__":
    main()
