"""A managed ROS 2 node by somebody else: zenoh_ros2_sdk serves `change_state` and `get_state`, rosbags makes the bytes.

``ros2_lifecycle_node.py NAME LOG [REFUSE]`` joins as rmw_zenoh does (`ZENOH_SESSION_CONFIG_URI`), writes each of its
states into LOG, and refuses the transition with the id REFUSE once the file LOG.refuse is there. It subscribes when it
is configured, and answers while it is active.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import zenoh

ros: Any = importlib.import_module("zenoh_ros2_sdk")
NODE, TASK = os.environ["ZSCHED_NODE"], os.environ["ZSCHED_TASK"]
TRANSITION, STATE = "uint8 id\nstring label\n", "uint8 id\nstring label\n"
NEXT = {(1, 1): 2, (2, 3): 3, (3, 4): 2}


def main() -> None:
    name, log, refused = sys.argv[1], Path(sys.argv[2]), int((*sys.argv, "0")[3])
    text = Path(os.environ["ZENOH_SESSION_CONFIG_URI"]).read_text(encoding="utf-8")
    given = json.loads(zenoh.Config.from_json5(text).get_json("connect/endpoints"))
    endpoints = [one.partition("#")[0].partition("?")[0] for one in given]
    os.environ["ZENOH_CONFIG_OVERRIDE"] = f"connect/endpoints={json.dumps(endpoints)}"  # the library knows one router
    address, _, port = endpoints[0].removeprefix("tcp/").rpartition(":")
    where = {"router_ip": address, "router_port": int(port), "domain_id": 7, "type_hash": "TypeHashNotSupported"}
    session = ros.ZenohSession.get_instance(address, int(port))
    session.register_message_type(TRANSITION, "lifecycle_msgs/msg/Transition")
    session.register_message_type(STATE, "lifecycle_msgs/msg/State")
    state = [1]
    kept: list[Any] = []
    servers: dict[str, Any] = {}

    def note() -> None:
        with log.open("a") as file:
            file.write(f"{time.monotonic_ns()} {NODE} {state[0]}\n")

    def answer(sample: zenoh.Sample) -> None:
        if state[0] == 3:
            robot = str(sample.key_expr).split("/")[2]
            session.session.put(f"{NODE}/{TASK}/1/{robot}/out", sample.payload)

    def change(request: Any) -> Any:
        asked = (state[0], request.transition.id)
        is_done = asked in NEXT and not (asked[1] == refused and log.with_suffix(".refuse").exists())
        if is_done:
            state[0] = NEXT[asked]
            if not kept:
                kept.append(session.session.declare_subscriber(f"{NODE}/{TASK}/*/in", answer))
            note()
        return servers["change"].response_msg_class(success=is_done)

    def tell(_request: Any) -> Any:
        made = servers["get"].response_msg_class
        one = session.store.types["lifecycle_msgs/msg/State"]
        return made(current_state=one(id=state[0], label=""))

    note()
    servers["get"] = ros.ROS2ServiceServer(
        f"{name}/get_state",
        "lifecycle_msgs/srv/GetState",
        callback=tell,
        request_definition="",
        response_definition="lifecycle_msgs/State current_state\n",
        **where,
    )
    servers["change"] = ros.ROS2ServiceServer(
        f"{name}/change_state",
        "lifecycle_msgs/srv/ChangeState",
        callback=change,
        request_definition="lifecycle_msgs/Transition transition\n",
        response_definition="bool success\n",
        **where,
    )
    print("the node is up", flush=True)
    while True:
        time.sleep(60)


main()
