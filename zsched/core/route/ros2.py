"""ROS 2 over zenoh: which keys a topic or service has, what its graph tokens and attachments say.

Knows: the key, token and attachment formats of rmw_zenoh and of the ros2dds bridge. Does not know: zenoh, streams,
messages (payloads stay CDR bytes), where in a file a name stands.

rmw_zenoh:  data ``<domain>/<name>/<type>/<hash>``; token ``@ros2_lv/<domain>/<zid>/<node id>/<entity id>/<kind>/
<enclave>/<namespace>/<node>[/<name>/<type>/<hash>/<qos>[/backends:<list>]]``, every ``/`` inside a field written
``%``. Of topics with buffer fields (images, point clouds) tokens name the backends that their node takes (0.10.5, so
Lyrical and Rolling). A publisher puts beside the key then: to ``<key>/_buf_cpu`` for all who take ``cpu`` alone, to
``<key>/_buf/<gid>`` what one other one shares its memory for. Subscriptions take the key itself, too.
ros2dds:    data ``<name>``; token ``@/<zid>/@ros2_lv/<kind>/<name>/<type>[/<qos>]``, every ``/`` inside written ``§``.

Sources: rmw_zenoh's design document (key expressions, graph cache, publishers), its publisher, subscription and buffer
endpoint sources; the liveliness module of zenoh-plugin-ros2dds 1.x; REP 2016 for type hashes. Read, not copied.
"""

from __future__ import annotations

import re
from enum import StrEnum
from typing import Final

from zsched.core.route import keyexpr
from zsched.core.values.plan import RosGraph
from zsched.core.values.struct import Struct

ANY: Final = "any"
"""In a fleet file: whatever type or hash the nodes use."""
GID_BYTES: Final = 16
DOMAIN: Final = "ROS_DOMAIN_ID"
"""The environment variable by which a ROS 2 node chooses its domain."""
MAX_DOMAIN: Final = 232
"""Largest ROS_DOMAIN_ID that ROS 2 allows anywhere."""
BUFFERS: Final = "/_buf_cpu"
TRANSIENT_LOCAL: Final = 1
"""rmw's number of that durability in a token's QoS."""

_BACKENDS: Final = "backends:"
_BY_CPU: Final = f"/{_BACKENDS}cpu:"
_PLACEHOLDER: Final = re.compile(r"\{[a-z]+\}")
_TOKEN: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_TYPE: Final = re.compile(
    r"(?P<package>[a-z][a-z0-9_]*)/(?:(?P<kind>msg|srv)/(?P<name>[A-Z][A-Za-z0-9]*)"
    r"|action/(?P<action>[A-Z][A-Za-z0-9]*_(?P<part>SendGoal|GetResult|FeedbackMessage)))"
)
"""An action brings three types of its own (its cancel service and status topic have types of `action_msgs`)."""
_FEEDBACK: Final = "FeedbackMessage"
_ACTION_TYPE: Final = re.compile(r"[a-z][a-z0-9_]*/action/[A-Z][A-Za-z0-9]*")
_HASH: Final = re.compile(r"RIHS[0-9]{2}_[0-9a-f]{64}|TypeHashNotSupported")
_RMW_KEY: Final = re.compile(
    r"[0-9]+/.+/([A-Za-z0-9_]+(::[A-Za-z0-9_]+)+|\*\*?)/(RIHS[^/]*|TypeHashNotSupported|\*\*?)"
)


class EndpointKind(StrEnum):
    """What a graph token announces; the values are the words inside it."""

    PUBLISHER = "MP"
    SUBSCRIPTION = "MS"
    SERVICE = "SS"
    CLIENT = "SC"


class ActionPart(Struct, frozen=True, kw_only=True):
    """One of the three services and two topics that a ROS action is made of."""

    word: str
    """Behind ``NAME/_action/``."""
    is_service: bool
    type_end: str = ""
    """Behind the action's own type; empty: the type is ``common_type``."""
    common_type: str = ""

    def type_name(self, action_type: str) -> str:
        """Its type, of an action of the type ``action_type`` (or ``any``).

        >>> ACTION_PARTS[0].type_name("nav2_msgs/action/Spin")
        'nav2_msgs/action/Spin_FeedbackMessage'
        """
        return self.common_type or (ANY if action_type == ANY else f"{action_type}_{self.type_end}")


ACTION_PARTS: Final = (
    ActionPart(word="feedback", is_service=False, type_end=_FEEDBACK),
    ActionPart(word="status", is_service=False, common_type="action_msgs/msg/GoalStatusArray"),
    ActionPart(word="send_goal", is_service=True, type_end="SendGoal"),
    ActionPart(word="get_result", is_service=True, type_end="GetResult"),
    ActionPart(word="cancel_goal", is_service=True, common_type="action_msgs/srv/CancelGoal"),
)
"""Topics first, which are the worker's outputs. Source: the design article "Actions" of ROS 2 (names, types)."""


class Endpoint(Struct, frozen=True, kw_only=True):
    """One endpoint of the ROS graph, without the node it belongs to."""

    kind: EndpointKind
    key: str
    """The key of its data."""
    type_name: str = ""
    """ros2dds only (rmw_zenoh has it in the key)."""
    qos: str = ""
    """As the token writes it; empty: the token has none (services of ros2dds). With `_BY_CPU` where it names backends:
    memory is not shared with another machine."""


# --- names ----------------------------------------------------------------------------------------------------------


def name_fault(name: str) -> str | None:
    """Why ``name`` (with placeholders and wildcards) is no fully qualified ROS name; ``None`` when it is one.

    >>> name_fault("map"), name_fault("/{robot}/map")
    ("it must begin with '/': say the name with its namespace", None)
    """
    if not name.startswith("/"):
        return "it must begin with '/': say the name with its namespace"
    for chunk in name[1:].split("/"):
        if chunk in ("*", "**"):
            continue
        plain = _PLACEHOLDER.sub("x", chunk)
        if _TOKEN.fullmatch(plain) is None:
            return f"{chunk!r} is no part of a ROS name: letters, digits and '_', and no digit first"
        if "__" in plain:
            return f"{chunk!r} holds '__', which ROS names may not"
    return None


def node_name_fault(node: str) -> str | None:
    """Why a node's name of the fleet file may not stand in a ROS name; ``None`` when it may."""
    if _TOKEN.fullmatch(node) is not None and "__" not in node:
        return None
    return "letters, digits and single '_', and no digit first"


_OTHERWISE: Final = re.compile(r"([a-z][a-z0-9_]*)(?:/|::(?:msg|srv)::(?:dds_::)?)([A-Z][A-Za-z0-9]*)_?")
"""As ROS 1 names a type, C++ or DDS."""


def type_fault(type_name: str, *, is_service: bool) -> str | None:
    """Why ``type_name`` is neither ``any`` nor the type of a service (or topic); ``None`` when it is.

    >>> type_fault("nav_msgs/msg/OccupancyGrid", is_service=False)
    >>> type_fault("nav2_msgs/action/Spin_SendGoal", is_service=True)
    >>> type_fault("nav_msgs/Path", is_service=False), type_fault("std_srvs::srv::dds_::Empty_", is_service=True)
    ('a type is PACKAGE/msg/NAME, so nav_msgs/msg/Path', 'a type is PACKAGE/srv/NAME, so std_srvs/srv/Empty')
    """
    match = _TYPE.fullmatch(type_name)
    if type_name == ANY:
        return None
    if match is None:
        if "/action/" in type_name:
            return "an action goes under `actions:`; its parts are NAME_SendGoal, NAME_GetResult, NAME_FeedbackMessage"
        kind = "srv" if is_service else "msg"
        named = _OTHERWISE.fullmatch(type_name)
        return f"a type is PACKAGE/{kind}/NAME" + ("" if named is None else f", so {named[1]}/{kind}/{named[2]}")
    is_of_service = match["kind"] == "srv" or (match["part"] is not None and match["part"] != _FEEDBACK)
    if is_of_service == is_service:
        return None
    ours, theirs = ("service", "topic") if is_service else ("topic", "service")
    return f"it is the type of a {theirs}, this is a {ours}"


def action_type_fault(type_name: str) -> str | None:
    """Why ``type_name`` is neither ``any`` nor the type of an action; ``None`` when it is.

    >>> action_type_fault("nav2_msgs/action/Spin")
    >>> action_type_fault("nav2_msgs/action/Spin_SendGoal")
    'the type of an action is PACKAGE/action/NAME'
    """
    if type_name == ANY or _ACTION_TYPE.fullmatch(type_name) is not None:
        return None
    return "the type of an action is PACKAGE/action/NAME"


def hash_fault(type_hash: str) -> str | None:
    """Why ``type_hash`` is neither ``any`` nor a type hash (REP 2016); ``None`` when it is."""
    if type_hash == ANY or _HASH.fullmatch(type_hash) is not None:
        return None
    return "a type hash is RIHS01_ and 64 hex digits"


def ros_key(graph: RosGraph, name: str, *, domain: int, type_name: str = ANY, type_hash: str = ANY) -> str:
    """The key (or template) of a topic or service; all four parts valid by themselves.

    >>> ros_key(RosGraph.RMW_ZENOH, "/{robot}/map", domain=0, type_name="nav_msgs/msg/OccupancyGrid")
    '0/{robot}/map/nav_msgs::msg::dds_::OccupancyGrid_/*'
    """
    bare = name.removeprefix("/")
    if graph is RosGraph.ROS2DDS:
        return bare
    match = _TYPE.fullmatch(type_name)
    written = "*"
    if match is not None:
        kind, end = (match["kind"], match["name"]) if match["kind"] else ("action", match["action"])
        written = f"{match['package']}::{kind}::dds_::{end}_"
    return keyexpr.canonical(f"{domain}/{bare}/{written}/{'*' if type_hash == ANY else type_hash}")


def is_rmw_key(expr: str) -> bool:
    """True when ``expr`` has the shape of an rmw_zenoh data key (wildcards for type and hash included)."""
    return _RMW_KEY.fullmatch(expr) is not None


def has_buffers_beside(graph: RosGraph, expr: str) -> bool:
    """True when samples of ``expr`` may also come under the same key and `BUFFERS` behind it."""
    return graph is RosGraph.RMW_ZENOH and is_rmw_key(expr) and not expr.endswith("**")


# --- graph tokens ---------------------------------------------------------------------------------------------------


def token_selector(graph: RosGraph) -> str:
    """The key expression of every graph token."""
    return "@ros2_lv/*/**" if graph is RosGraph.RMW_ZENOH else "@/*/@ros2_lv/**"


def parse_token(token: str) -> tuple[str, Endpoint] | None:
    """(zenoh id of the announcing session, endpoint) of a graph token; ``None`` for nodes and for anything else."""
    chunks = token.split("/")
    if chunks[0] == "@ros2_lv" and len(chunks) >= 13:
        domain, zid, kind, (name, type_name, type_hash, qos, *more) = chunks[1], chunks[2], chunks[5], chunks[9:]
        topic = name.replace("%", "/").strip("/")
        qos += _BY_CPU if any(one.startswith(_BACKENDS) for one in more) else ""
        key = f"{domain}/{topic}/{type_name.replace('%', '/')}/{type_hash}"
        return (zid, Endpoint(kind=EndpointKind(kind), key=key, qos=qos)) if kind in _KINDS and topic else None
    if len(chunks) >= 6 and chunks[0] == "@" and chunks[2] == "@ros2_lv" and chunks[3] in _KINDS:
        key, type_name = chunks[4].replace("§", "/"), chunks[5].replace("§", "/")
        qos = "".join(chunks[6:7])
        return chunks[1], Endpoint(kind=EndpointKind(chunks[3]), key=key, type_name=type_name, qos=qos)
    return None


def node_token(graph: RosGraph, *, domain: str, zid: str, node: str) -> str | None:
    """The token of the node that our endpoints belong to; ``None``: the format has none."""
    if graph is not RosGraph.RMW_ZENOH:
        return None
    return f"@ros2_lv/{domain}/{zid}/0/0/NN/%/%/{node}"


def endpoint_token(graph: RosGraph, endpoint: Endpoint, *, zid: str, node: str, number: int) -> str:
    """The token by which the session ``zid`` announces ``endpoint`` as its own, under ``node``, id ``number``."""
    if graph is RosGraph.ROS2DDS:
        parts = [endpoint.key, endpoint.type_name, *([endpoint.qos] if endpoint.qos else [])]
        return "/".join(("@", zid, "@ros2_lv", endpoint.kind, *(part.replace("/", "§") for part in parts)))
    domain, *topic, type_name, type_hash = endpoint.key.split("/")
    name = "%" + "%".join(topic)
    return (
        f"@ros2_lv/{domain}/{zid}/0/{number}/{endpoint.kind}/%/%/{node}/{name}/{type_name}/{type_hash}/{endpoint.qos}"
    )


def default_qos(*, is_latched: bool, depth: int) -> str:
    """The QoS field of an rmw_zenoh token: reliable, keep last ``depth``, transient local when ``is_latched``.

    Fields that equal rmw's defaults are empty: reliability, durability, (history, depth), deadline, lifespan,
    (liveliness, its lease).
    """
    return f":{TRANSIENT_LOCAL if is_latched else ''}:,{depth}:,:,:,,"


_KINDS: Final = frozenset(EndpointKind)


def ros_node_name(node: str) -> str:
    """The name under which a node's relay stands in the ROS graph.

    >>> ros_node_name("robot-1")
    'zsched_robot_1'
    """
    return f"zsched_{node.replace('-', '_')}"


# --- attachments ----------------------------------------------------------------------------------------------------

_BYTES: Final = 8 + 8 + 1 + GID_BYTES


class Attachment(Struct, frozen=True, kw_only=True):
    """The attachment of rmw_zenoh (0.2.4 and later) on every message, request and reply."""

    sequence: int
    """From 1, gapless per publisher or client."""
    stamp_ns: int
    """Source time, nanoseconds since the Unix epoch."""
    gid: bytes
    """16 bytes that name the publisher or client."""


def encode_attachment(value: Attachment) -> bytes:
    """33 bytes: sequence and stamp as little-endian int64, the length of the gid, the gid.

    Raises:
        ValueError: the gid has not 16 bytes, or a number does not fit.
    """
    if len(value.gid) != GID_BYTES:
        raise ValueError(f"a gid has {GID_BYTES} bytes, not {len(value.gid)}")
    try:
        numbers = b"".join(number.to_bytes(8, "little", signed=True) for number in (value.sequence, value.stamp_ns))
    except OverflowError as error:
        raise ValueError(f"no attachment: {error}") from error
    return numbers + bytes((GID_BYTES,)) + value.gid


def decode_attachment(raw: bytes) -> Attachment | None:
    """The attachment that ``raw`` is; ``None`` when it is none."""
    if len(raw) < _BYTES or raw[16] != GID_BYTES:
        return None
    sequence, stamp_ns = (int.from_bytes(part, "little", signed=True) for part in (raw[:8], raw[8:16]))
    return Attachment(sequence=sequence, stamp_ns=stamp_ns, gid=raw[17:_BYTES])
