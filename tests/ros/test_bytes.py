"""What zsched writes and reads itself, held to real ROS 2: maps, transforms, managed nodes, QoS."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np

from zsched.core.route.lifecycle import (
    GET_STATE_REQUEST,
    HEADER,
    State,
    Transition,
    change_state_request,
    is_changed,
    state_of,
)
from zsched.core.route.ros2 import default_qos
from zsched.tasks.map_merge.cdr import StampedTransform, decode_grid, encode_grid, encode_transforms
from zsched.tasks.map_merge.geometry import Pose2
from zsched.tasks.map_merge.grid import Grid

WORDS = Path(__file__).parents[1] / "unit" / "core" / "route" / "words" / "kilted-0.6.7.json"
DOUBLES = 7 * 8


def is_same(ours: bytes, theirs: str) -> bool:
    """But for padding, which Fast CDR leaves as its memory was; `codec.py` has held the fields to each other."""
    written = bytes.fromhex(theirs)
    is_long = 0 <= len(written) - len(ours) < 4
    return is_long and all(one in (0, other) for one, other in zip(ours, written, strict=False))


def test_a_merged_map_is_read_by_ros_and_written_again_to_the_byte(ros: Any) -> None:
    data = np.arange(-1, 100, dtype=np.int8)[: 7 * 13].reshape(7, 13)
    grid = Grid(
        data=data, resolution=0.05, origin=Pose2(x=-1.5, y=2.25, yaw=0.5), stamp_ns=7_000_000_009, frame_id="world"
    )
    ours = encode_grid(grid)
    ((fields, theirs),) = ros.ask("codec.py", [["nav_msgs/msg/OccupancyGrid", ours.hex()]])
    assert is_same(ours, theirs)
    assert fields["header"] == {"stamp": {"sec": 7, "nanosec": 9}, "frame_id": "world"}
    assert (fields["info"]["width"], fields["info"]["height"]) == (13, 7)
    assert fields["info"]["origin"]["position"] == {"x": -1.5, "y": 2.25, "z": 0.0}
    assert fields["data"] == data.flatten().tolist()
    again = decode_grid(bytes.fromhex(theirs))
    assert (again.origin.x, again.resolution, again.frame_id) == (-1.5, 0.05, "world")


def test_a_transform_is_read_by_ros(ros: Any) -> None:
    """There is no wheel of tf2_msgs: of its list of one the element is taken, which begins four bytes later there."""
    ours = []
    for parent in ("w", "wo", "wor", "worl", "world", "world/map"):
        one = StampedTransform(
            parent=parent, child="robot1/map", pose=Pose2(x=1.5, y=-2.0, yaw=1.0), stamp_ns=3_000_000_004
        )
        payload = encode_transforms((one,))
        assert payload[:8] == HEADER + b"\x01\0\0\0"
        text = 8 + 4 + len(parent) + 1
        text += -text % 4
        text += 4 + len("robot1/map") + 1
        body = payload[8 : 8 + text]
        assert len(payload) == 8 + text + (-(text + 4) % 8) + DOUBLES
        ours.append(HEADER + body + bytes(-text % 8) + payload[-DOUBLES:])
    answers = ros.ask("codec.py", [["geometry_msgs/msg/TransformStamped", raw.hex()] for raw in ours])
    for (fields, theirs), raw in zip(answers, ours, strict=True):
        assert is_same(raw, theirs)
        assert (fields["child_frame_id"], fields["header"]["stamp"]) == ("robot1/map", {"sec": 3, "nanosec": 4})
        assert fields["transform"]["translation"] == {"x": 1.5, "y": -2.0, "z": 0.0}


def test_what_the_driver_of_managed_nodes_says_and_hears(ros: Any) -> None:
    asked = [change_state_request(one) for one in Transition]
    answers = ros.ask(
        "codec.py",
        [
            *(["lifecycle_msgs/srv/ChangeState.Request", one.hex()] for one in asked),
            ["lifecycle_msgs/srv/GetState.Request", GET_STATE_REQUEST.hex()],
            ["lifecycle_msgs/srv/ChangeState.Response", (HEADER + b"\x01").hex()],
            ["lifecycle_msgs/srv/GetState.Response", (HEADER + bytes((3, 0, 0, 0, 7, 0, 0, 0)) + b"active\0").hex()],
        ],
    )
    for transition, ours, (fields, theirs) in zip(Transition, asked, answers, strict=False):
        assert fields == {"transition": {"id": transition, "label": ""}}
        assert is_same(ours, theirs)
    (_, empty), (done, changed), (state, active) = answers[-3:]
    assert is_same(GET_STATE_REQUEST, empty)
    assert (done, is_changed(bytes.fromhex(changed))) == ({"success": True}, True)
    assert state == {"current_state": {"id": State.ACTIVE, "label": "active"}}
    assert state_of(bytes.fromhex(active)) == State.ACTIVE


def test_the_quality_that_we_announce_is_that_of_rclpy(ros: Any) -> None:
    """A field of a token is empty where it equals rmw's default: reliable, volatile, keep last."""
    names = ("DEFAULT", "SENSOR_DATA", "ACTION_STATUS_DEFAULT")
    default, sensor, latched = ros.ask("codec.py", [["qos", name] for name in names])

    def written(numbers: list[int]) -> str:
        history, depth, reliability, durability = numbers
        fields = [
            "" if one == usual else str(one)
            for one, usual in zip((reliability, durability, history), (1, 2, 1), strict=True)
        ]
        return f"{fields[0]}:{fields[1]}:{fields[2]},{depth}:,:,:,,"

    assert written(default) == default_qos(is_latched=False, depth=10)
    assert written(latched) == default_qos(is_latched=True, depth=1)
    live = {
        match[1]: match[2]
        for token in json.loads(WORDS.read_text())["domain_0"]["tokens"]
        if (match := re.search(r"/MP/%/%/talker/%(chatter|image|map)/[^/]*/[^/]*/([^/]*)", token))
    }
    assert live == {"chatter": written(default), "image": written(sensor), "map": written(latched)}
