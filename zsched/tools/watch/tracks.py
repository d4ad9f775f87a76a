"""The topics of a recording: what a status and a log become as messages, with the schema of each (pure).

Knows: names, JSON schemas, Foxglove's log message, ROS 2 definitions of maps and frames. Does not know: files, MCAP.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any, Final

from zsched.commands.base.common import SCHEMAS, Json
from zsched.commands.base.report import degradations
from zsched.commands.look.history import is_move
from zsched.core.values.struct import Struct

NANO: Final = 1_000_000_000
INFO, WARNING, ERROR = 2, 3, 4
"""Levels of `foxglove.Log`."""


def _object(title: str, **properties: Json) -> str:
    return json.dumps({"title": title, "type": "object", "properties": properties})


_TIME: Final = {
    "type": "object",
    "title": "time",
    "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
}
_WORD: Final = {"type": "string"}
_NUMBER: Final = {"type": "number"}
_WHOLE: Final = {"type": "integer"}
_SHARES: Final = {"type": "object", "additionalProperties": _NUMBER}

JSON_SCHEMAS: Final = {
    "foxglove.Log": _object(
        "foxglove.Log", timestamp=_TIME, level=_WHOLE, message=_WORD, name=_WORD, file=_WORD, line=_WHOLE
    ),
    "zsched.Task": _object(
        "zsched.Task",
        owner=_WORD,
        owner_state=_WORD,
        epoch=_WHOLE,
        revision=_WHOLE,
        phase=_WORD,
        utilities=_SHARES,
    ),
    "zsched.Move": _object(
        "zsched.Move",
        task=_WORD,
        epoch=_WHOLE,
        revision=_WHOLE,
        left=_WORD,
        owner=_WORD,
        reason=_WORD,
        votes={"type": "object", "additionalProperties": _WORD},
    ),
    "zsched.Stream": _object(
        "zsched.Stream",
        hz=_NUMBER,
        bytes_per_s=_NUMBER,
        messages=_WHOLE,
        dropped=_WHOLE,
        in_flight=_WHOLE,
        answer_s=_NUMBER,
    ),
    "zsched.Node": _object(
        "zsched.Node",
        state=_WORD,
        cpu_ratio=_NUMBER,
        memory_ratio=_NUMBER,
        rssi_dbm=_NUMBER,
        links_dbm=_SHARES,
        owns=_WHOLE,
    ),
}
"""{name: JSON schema}; a value that was not measured is left out of a message."""
STATUS: Final = "zsched.status.1"
GRID: Final = "nav_msgs/msg/OccupancyGrid"
FRAMES: Final = "tf2_msgs/msg/TFMessage"
_RULE: Final = "=" * 80 + "\nMSG: "
_HEADER: Final = f"{_RULE}std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
_TIME_OF_ROS: Final = f"{_RULE}builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
_TURN: Final = f"{_RULE}geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"
ROS_DEFINITIONS: Final = {
    GRID: "std_msgs/Header header\nnav_msgs/MapMetaData info\nint8[] data\n"
    f"{_HEADER}"
    f"{_RULE}nav_msgs/MapMetaData\nbuiltin_interfaces/Time map_load_time\nfloat32 resolution\n"
    "uint32 width\nuint32 height\ngeometry_msgs/Pose origin\n"
    f"{_RULE}geometry_msgs/Pose\ngeometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n"
    f"{_RULE}geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n"
    f"{_TURN}{_TIME_OF_ROS}",
    FRAMES: "geometry_msgs/TransformStamped[] transforms\n"
    f"{_RULE}geometry_msgs/TransformStamped\nstd_msgs/Header header\nstring child_frame_id\n"
    "geometry_msgs/Transform transform\n"
    f"{_HEADER}"
    f"{_RULE}geometry_msgs/Transform\ngeometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n"
    f"{_RULE}geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n"
    f"{_TURN}{_TIME_OF_ROS}",
}
"""{ROS 2 type: its definition as ros2msg}: what is recorded as it was published."""
_IN_KEYS: Final = {"nav_msgs::msg::dds_::OccupancyGrid_": GRID, "tf2_msgs::msg::dds_::TFMessage_": FRAMES}


class Message(Struct, frozen=True, kw_only=True):
    """One message of a topic."""

    topic: str
    schema: str
    at_ns: int
    """Since 1970."""
    body: Json


def nanoseconds(at: float) -> int:
    """Of seconds since 1970, to the microsecond: a float has no more.

    >>> nanoseconds(1_790_000_000.25)
    1790000000250000000
    """
    return round(at * 1e6) * 1000


def status_schema() -> str:
    """The schema that is shipped for the status."""
    return (SCHEMAS / f"{STATUS}.json").read_text(encoding="utf-8")


def of_status(status: Json, at: float) -> Iterator[Message]:
    """What a status tells, topic by topic; ``at``: seconds since 1970."""
    at_ns = nanoseconds(at)
    yield Message(
        topic="/zsched/status", schema=STATUS, at_ns=at_ns, body={**status, "degraded": list(degradations(status))}
    )
    for node in status["nodes"]:
        owns = sum(task["owner"] == node["name"] for task in status["tasks"])
        yield Message(topic=f"/zsched/nodes/{node['name']}", schema="zsched.Node", at_ns=at_ns, body=_node(node, owns))
    for task in status["tasks"]:
        name, decision = task["name"], task["decision"]
        body = {key: task[key] for key in ("owner", "owner_state", "epoch", "revision", "phase")}
        body["utilities"] = None if decision is None else decision["aggregates"]
        yield Message(topic=f"/zsched/tasks/{name}", schema="zsched.Task", at_ns=at_ns, body=_measured(body))
        for stream in task["streams"]:
            body = {key: stream.get(key) for key in ("hz", "bytes_per_s", "messages", "in_flight", "answer_s")}
            body["dropped"] = sum(stream["drops"].values())
            yield Message(
                topic=f"/zsched/streams/{stream['stream']}", schema="zsched.Stream", at_ns=at_ns, body=_measured(body)
            )


def _node(node: Json, owns: int) -> Json:
    signals = {link["peer"]: link["rssi_dbm"] for link in node["links"] if link["rssi_dbm"] is not None}
    body = {key: node[key] for key in ("state", "cpu_ratio", "memory_ratio")}
    to_all = signals.pop(None, None)
    return _measured({**body, "rssi_dbm": to_all, "links_dbm": signals or None, "owns": owns})


def _measured(body: Json) -> Json:
    return {key: value for key, value in body.items() if value is not None}


def of_entry(entry: Json) -> Iterator[Message]:
    """What a line of the decision log tells: a line of Foxglove's log, and of a move its figures."""
    at_ns = nanoseconds(entry["at"])
    task = str(entry.get("task", ""))
    move: Any = entry["move"] if is_move(entry) else None
    stamp = {"sec": at_ns // NANO, "nsec": at_ns % NANO}
    where = f"{entry['node']}/{entry['stage']}"
    text = f"{task}: {entry['text']}" if task else str(entry["text"])
    body = {"timestamp": stamp, "level": INFO if move is None else WARNING, "message": text, "name": where}
    yield Message(topic="/zsched/log", schema="foxglove.Log", at_ns=at_ns, body={**body, "file": "", "line": 0})
    if move is not None:
        told = {"task": task, **move, "votes": dict(move.get("votes", ()))}
        yield Message(topic="/zsched/moves", schema="zsched.Move", at_ns=at_ns, body=_measured(told))


# --- maps and frames -------------------------------------------------------------------------------------------------


def ros_keys(status: Json) -> dict[str, str]:
    """{key expression: ROS 2 type} of streams whose keys say that they carry maps or frames."""
    ends = (
        stream.get(end, "")
        for task in status["tasks"]
        for stream in task["streams"]
        for end in ("from_expr", "to_expr")
    )
    return {end: kind for end in ends if (kind := _type_in(end)) is not None}


def _type_in(key: str) -> str | None:
    return next((_IN_KEYS[chunk] for chunk in key.split("/") if chunk in _IN_KEYS), None)


def topic_of(key: str) -> str:
    """The topic under which a key's samples are recorded: a ROS topic by its name, another key as it is.

    >>> topic_of("0/robot1/map/nav_msgs::msg::dds_::OccupancyGrid_/RIHS01_8d"), topic_of("robot1/map")
    ('/robot1/map', '/robot1/map')
    """
    chunks = key.split("/")
    at = next((number for number, chunk in enumerate(chunks) if chunk in _IN_KEYS), None)
    return f"/{key}" if at is None else "/" + "/".join(chunks[1:at])
