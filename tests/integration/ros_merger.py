"""A worker as a stock ROS 2 node on rmw_zenoh is one: it knows nothing of zsched, and finds its inputs in the graph.

As multirobot_map_merge does, it subscribes to every map that the graph shows under its own namespace; it answers each
with a merged map. Its only ties to zsched are what the fleet file and the environment give any command.
"""

from __future__ import annotations

import os
import queue
import sys
from typing import Any

import zenoh

from zsched.core.route.ros2 import Endpoint, EndpointKind, default_qos, endpoint_token, parse_token
from zsched.core.values.plan import RosGraph

NODE = os.environ["ZSCHED_NODE"]
MAPS = f"0/{NODE}/map_merge/*/map/**"
LATCHED = default_qos(is_latched=True, depth=1)


def main() -> None:
    """Run until killed."""
    session = zenoh.open(zenoh.Config.from_file(os.environ["ZENOH_SESSION_CONFIG_URI"]))
    zid = str(session.zid())
    tokens: queue.SimpleQueue[str] = queue.SimpleQueue()
    graph = session.liveliness().declare_subscriber(
        "@ros2_lv/**",
        lambda sample: tokens.put(str(sample.key_expr)) if sample.kind == zenoh.SampleKind.PUT else None,
        history=True,
    )
    kept: list[Any] = [graph]
    subscribed: set[str] = set()

    def announce(kind: EndpointKind, key: str) -> None:
        endpoint = Endpoint(kind=kind, key=key, qos=LATCHED)
        token = endpoint_token(RosGraph.RMW_ZENOH, endpoint, zid=zid, node="merger", number=len(kept))
        kept.append(session.liveliness().declare_token(token))

    def answer(sample: zenoh.Sample) -> None:
        merged = str(sample.key_expr).replace(
            f"/map_merge/{str(sample.key_expr).split('/')[3]}/map/", "/map_merge/map/"
        )
        session.put(merged, NODE.encode() + b" merged " + sample.payload.to_bytes(), attachment=sample.attachment)

    while True:
        parsed = parse_token(tokens.get())
        if parsed is None or parsed[0] == zid or parsed[1].kind is not EndpointKind.PUBLISHER:
            continue
        key = parsed[1].key
        if not zenoh.KeyExpr(MAPS).includes(zenoh.KeyExpr(key)) or key in subscribed:
            continue
        subscribed.add(key)
        kept.append(session.declare_subscriber(key, answer))
        announce(EndpointKind.SUBSCRIPTION, key)
        announce(EndpointKind.PUBLISHER, key.replace(f"/{key.split('/')[3]}/map/", "/map/"))
        print(f"subscribed to {key}", file=sys.stderr, flush=True)


main()
