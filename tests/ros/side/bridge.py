"""One machine's bridge between DDS and zenoh, in the key form of zenoh-bridge-ros2dds 1.9: bare names, CDR payloads.

``bridge.py ZENOH_CONFIG [RMW_DOMAIN]``. Whatever local nodes offer or want is bridged, as the plugin does: a route
exists while a local node has the endpoint, with the plugin's token; latched topics are cached and asked for. Requests
pass as CDR without DDS's header, an error reply is no reply. With RMW_DOMAIN the services of managed nodes have keys,
hashes and attachments of rmw_zenoh instead.

Sources: route_publisher.rs, route_subscriber.rs, route_service_srv.rs, route_service_cli.rs, liveliness_mgt.rs of
zenoh-plugin-ros2dds. Read, not copied.
"""

from __future__ import annotations

import importlib
import json
import signal
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import rclpy
import zenoh
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.task import Future
from zenoh import ext

ME = "zenoh_bridge"
LOOK_S = 0.1
CALL_S = 3600.0
PRIVATE = ("/rosout", "/parameter_events")
MANAGED = ("/change_state", "/get_state")
PARAMETERS = ("_parameters", "_parameter_types", "_type_description", "_parameters_atomically")


def kind_of(name: str) -> Any:
    """The class of a type; of an action's parts, too."""
    package, kind, word = name.split("/")
    action, _, part = word.partition("_")
    found = getattr(importlib.import_module(f"{package}.{kind}"), action)
    if not part:
        return found
    return getattr(found.Impl, {"SendGoal": "SendGoalService", "GetResult": "GetResultService"}.get(part, part))


class Bridge:
    """All routes of one machine."""

    def __init__(self, session: zenoh.Session, node: Any, domain: str | None) -> None:
        self._session, self._node, self._domain = session, node, domain
        self._zid = session.zid()
        self._routes: dict[tuple[str, str], Callable[[], None]] = {}
        node.create_timer(LOOK_S, self._look)

    def _look(self) -> None:
        """Make the routes that are missing, end those that nobody here needs."""
        wanted: dict[tuple[str, str], Callable[[], Callable[[], None]]] = {}
        for name, types in self._node.get_topic_names_and_types(no_demangle=False):
            if name in PRIVATE:
                continue
            for kind, found, make in (
                ("MP", self._node.get_publishers_info_by_topic(name), self._from_ros),
                ("MS", self._node.get_subscriptions_info_by_topic(name), self._to_ros),
            ):
                theirs = [one for one in found if one.node_name != ME]
                if theirs:
                    wanted[kind, name] = partial(make, name, types[0], theirs[0].qos_profile)
        for name, types in self._node.get_service_names_and_types():
            if name.endswith(PARAMETERS) or ME in name:
                continue
            own = {kind: (kind, name) in self._routes for kind in ("SS", "SC")}
            if self._node.count_services(name) > own["SC"]:
                wanted["SS", name] = partial(self._serve_zenoh, name, types[0])
            if self._node.count_clients(name) > own["SS"]:
                wanted["SC", name] = partial(self._serve_ros, name, types[0])
        for route in [one for one in self._routes if one not in wanted]:
            self._routes.pop(route)()
        for route, begin in wanted.items():
            if route not in self._routes:
                self._routes[route] = begin()

    def _token(self, kind: str, name: str, type_name: str, qos: str = "") -> Any:
        if "/_action/" in name:
            part, _, is_first = name.partition("/_action/")
            if is_first != "send_goal":
                return None
            kind, name, type_name = kind.replace("S", "A", 1), part, type_name.partition("_SendGoal")[0]
        words = ["@", str(self._zid), "@ros2_lv", kind, name[1:].replace("/", "§"), type_name.replace("/", "§")]
        return self._session.liveliness().declare_token("/".join(words + ([qos] if qos else [])))

    def _end(self, *things: Any) -> None:
        for one in things:
            if one is not None:
                one.undeclare()

    # --- topics ------------------------------------------------------------------------------------------------------

    def _from_ros(self, name: str, type_name: str, theirs: QoSProfile) -> Callable[[], None]:
        is_latched = theirs.durability == DurabilityPolicy.TRANSIENT_LOCAL
        is_reliable = theirs.reliability == ReliabilityPolicy.RELIABLE
        control = zenoh.CongestionControl.BLOCK if is_reliable else zenoh.CongestionControl.DROP
        publisher = ext.declare_advanced_publisher(
            self._session,
            name[1:],
            congestion_control=control,
            cache=ext.CacheConfig(1) if is_latched else None,
            publisher_detection=is_latched,
        )
        token = self._token("MP", name, type_name, written(theirs))
        reader = self._node.create_subscription(
            kind_of(type_name), name, publisher.put, plain(theirs, type_name), raw=True
        )

        def end() -> None:
            self._node.destroy_subscription(reader)
            self._end(token, publisher)

        return end

    def _to_ros(self, name: str, type_name: str, theirs: QoSProfile) -> Callable[[], None]:
        writer = self._node.create_publisher(kind_of(type_name), name, plain(theirs, type_name))

        def on_sample(sample: zenoh.Sample) -> None:
            writer.publish(sample.payload.to_bytes())

        subscriber: Any
        if theirs.durability == DurabilityPolicy.TRANSIENT_LOCAL:
            history = ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
            subscriber = ext.declare_advanced_subscriber(self._session, name[1:], on_sample, history=history)
        else:
            subscriber = self._session.declare_subscriber(name[1:], on_sample)
        token = self._token("MS", name, type_name, written(theirs))

        def end() -> None:
            self._end(token, subscriber)
            self._node.destroy_publisher(writer)

        return end

    # --- services ----------------------------------------------------------------------------------------------------

    def _key(self, name: str, type_name: str) -> str:
        if self._domain is None or not name.endswith(MANAGED):
            return name[1:]
        package, kind, word = type_name.split("/")
        described = json.loads((Path(sys.prefix) / "share" / package / kind / f"{word}.json").read_text())
        return f"{self._domain}{name}/{package}::{kind}::dds_::{word}_/{described['type_hashes'][0]['hash_string']}"

    def _serve_zenoh(self, name: str, type_name: str) -> Callable[[], None]:
        """A local node serves."""
        kind = kind_of(type_name)
        client = self._node.create_client(kind, name)

        def on_query(query: zenoh.Query) -> None:
            payload = query.payload.to_bytes() if query.payload is not None else b"\0\1\0\0\0"
            future = client.call_async(deserialize_message(payload, kind.Request))
            future.add_done_callback(partial(reply, query))

        def reply(query: zenoh.Query, future: Any) -> None:
            with query:
                query.reply(query.key_expr, bytes(serialize_message(future.result())), attachment=query.attachment)

        queryable = self._session.declare_queryable(self._key(name, type_name), on_query, complete=True)
        token = self._token("SS", name, type_name)

        def end() -> None:
            self._end(token, queryable)
            self._node.destroy_client(client)

        return end

    def _serve_ros(self, name: str, type_name: str) -> Callable[[], None]:
        """A local node asks; a request without an answer waits for ever, as with the plugin."""
        kind = kind_of(type_name)
        count = 0

        async def on_request(request: Any, _response: Any) -> Any:
            nonlocal count
            count += 1
            future: Any = Future(executor=self._node.executor)
            self._session.get(
                name[1:],
                partial(on_reply, future),
                payload=bytes(serialize_message(request)),
                attachment=bytes.fromhex(str(self._zid).zfill(32))[:8] + count.to_bytes(8, "little") + b"\1",
                timeout=CALL_S,
            )
            return await future

        def on_reply(future: Any, answer: zenoh.Reply) -> None:
            if answer.ok is not None and not future.done():
                future.set_result(deserialize_message(answer.ok.payload.to_bytes(), kind.Response))
                self._node.executor.wake()

        server = self._node.create_service(kind, name, on_request)
        token = self._token("SC", name, type_name)

        def end() -> None:
            self._end(token)
            self._node.destroy_service(server)

        return end


def plain(theirs: QoSProfile, type_name: str) -> QoSProfile:
    """What a route's own endpoint has; discovery does not tell a depth, and a shallow one loses what a node sends."""
    is_latched = theirs.durability == DurabilityPolicy.TRANSIENT_LOCAL
    depth = 1 if is_latched else 5 if type_name.startswith("sensor_msgs/") else 1000
    return QoSProfile(depth=depth, reliability=theirs.reliability, durability=theirs.durability)


def written(theirs: QoSProfile) -> str:
    """QoS in the plugin's token: DDS's numbers, no key."""
    is_latched = theirs.durability == DurabilityPolicy.TRANSIENT_LOCAL
    return f":{int(theirs.reliability == ReliabilityPolicy.RELIABLE)}:{int(is_latched)}:0,{1 if is_latched else 50}"


def main() -> None:
    """Run until killed."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    session = zenoh.open(zenoh.Config.from_file(sys.argv[1]))
    rclpy.init()
    node = rclpy.create_node(ME, start_parameter_services=False, enable_rosout=False)
    bridge = Bridge(session, node, (*sys.argv, None)[2])
    rclpy.spin(node)
    del bridge


main()
