"""Reads and writes messages with `rclpy.serialization`, and tells rmw's numbers of QoS. JSON on both ends.

A question is a list of [type, payload as hex]; the answer has for each the fields, and the bytes that ROS writes.
"""

from __future__ import annotations

import importlib
import json
import sys
from typing import Any

from rclpy.qos import QoSPresetProfiles
from rclpy.serialization import deserialize_message, serialize_message

SCALARS = (bool, int, float, str)


def kind_of(name: str) -> Any:
    """The class of ``nav_msgs/msg/OccupancyGrid`` or ``lifecycle_msgs/srv/GetState.Request``."""
    package, kind, word = name.split("/")
    found: Any = importlib.import_module(f"{package}.{kind}")
    for part in word.split("."):
        found = getattr(found, part)
    return found


def told(value: Any) -> Any:
    """A message as plain data."""
    if isinstance(value, SCALARS):
        return value
    if hasattr(value, "get_fields_and_field_types"):
        return {name: told(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if isinstance(value, bytes):
        return value.hex()
    return [told(one) for one in value]


def main() -> None:
    answers: list[Any] = []
    for name, payload in json.load(sys.stdin):
        if name == "qos":
            found = QoSPresetProfiles.get_from_short_key(payload)
            numbers = (found.history, found.depth, found.reliability, found.durability)
            answers.append([int(number) for number in numbers])
            continue
        message = deserialize_message(bytes.fromhex(payload), kind_of(name))
        written = bytes(serialize_message(message))
        assert told(deserialize_message(written, kind_of(name))) == told(message), name
        answers.append([told(message), written.hex()])
    json.dump(answers, sys.stdout)


main()
