"""ROS 2 nodes on either side of a relay: keys, attachments, latched values, graph tokens and services through a move.

The nodes are sessions that do on the wire what rmw_zenoh does (its design document); test_ros2_sdk.py has nodes by
somebody else. Routes come from a fleet file.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import pytest
import zenoh
from zenoh import ext

from support.ros_host import RosHost, opened
from support.waiting import until
from zsched.core.route.ros2 import Attachment, decode_attachment, encode_attachment
from zsched.link.sessions.config import client_config, worker_config
from zsched.link.sessions.matching import is_matched

GRID = "nav_msgs::msg::dds_::OccupancyGrid_/RIHS01_8d348150c12913a31ee0ec170fbf25089e4745d17035792a1ba94d6f0bc0cfc7"
TRIGGER = "std_srvs::srv::dds_::Trigger_/RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f"
QOS = ":1:,1:,:,:,,"
FILE = """\
fleet: test
nodes:
  robot1: {kind: robot, wired: true, local: {connect: ["tcp/127.0.0.1:7447"]}, host: h, listen: LISTEN}
  edge1: {kind: edge}
  edge2: {kind: edge}
electorate: [robot1, edge1, edge2]
tasks:
  merge:
    candidates: [edge1, edge2]
    weights: {cpu: 1}
    worker: {ready: matching}
    ros2:
      inputs: [{topic: /map, worker_topic: "/{target}/merge/{robot}/map", class: latest}]
      outputs: [{topic: /merged_map, worker_topic: "/{target}/merge/map", class: latest}]
      services: [{service: /merge_now, type: std_srvs/srv/Trigger, worker_service: "/{target}/merge/now"}]
""".replace("LISTEN", "{control: tcp/127.0.0.1:1, data: tcp/127.0.0.1:2}")


@dataclass(eq=False)
class RosNode:
    """One context of rmw_zenoh: a session with publishers, subscriptions and tokens."""

    session: zenoh.Session
    heard: list[zenoh.Sample] = field(default_factory=list)
    entities: list[Any] = field(default_factory=list)
    sequence: int = 0

    def announce(self, kind: str, topic: str, kind_of_data: str = GRID, qos: str = QOS) -> None:
        """The graph token that goes with an endpoint."""
        number = len(self.entities)
        whose = f"@ros2_lv/0/{self.session.zid()}/0/{number}/{kind}/%/%/node"
        key = f"{whose}/%{topic.replace('/', '%')}/{kind_of_data}/{qos}"
        self.entities.append(self.session.liveliness().declare_token(key))

    def advertise(self, topic: str) -> Callable[[bytes], bytes]:
        """A latched publisher; the function publishes and answers the attachment."""
        publisher = ext.declare_advanced_publisher(
            self.session,
            f"0/{topic}/{GRID}",
            cache=ext.CacheConfig(1),
            sample_miss_detection=ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5),
            publisher_detection=True,
        )
        self.entities.append(publisher)
        self.announce("MP", topic)

        def publish(payload: bytes) -> bytes:
            self.sequence += 1
            value = Attachment(sequence=self.sequence, stamp_ns=time.time_ns(), gid=bytes(range(16)))
            publisher.put(payload, attachment=encode_attachment(value))
            return encode_attachment(value)

        return publish

    def subscribe(self, topic: str) -> None:
        """A latched subscription."""
        subscriber = ext.declare_advanced_subscriber(
            self.session,
            f"0/{topic}/{GRID}",
            self.heard.append,
            history=ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
        )
        self.entities.append(subscriber)
        self.announce("MS", topic)

    def serve(self, service: str, answer: bytes) -> list[str]:
        """A service that answers with the sequence and gid of the request; the list: keys it was asked for."""
        asked: list[str] = []

        def on_query(query: zenoh.Query) -> None:
            with query:
                asked.append(str(query.key_expr))
                query.reply(str(query.key_expr), answer, attachment=query.attachment)

        self.entities.append(self.session.declare_queryable(f"0/{service}/{TRIGGER}", on_query, complete=True))
        self.announce("SS", service, TRIGGER)
        return asked

    def tokens(self) -> list[str]:
        """Every endpoint of others in the graph, as kind and topic."""
        replies = self.session.liveliness().get("@ros2_lv/0/**", timeout=1.0)
        keys = [str(reply.ok.key_expr).split("/") for reply in replies if reply.ok is not None]
        return sorted(f"{key[5]} {key[9]} {key[12]}" for key in keys if len(key) == 13 and key[8] == "zsched_robot1")

    def close(self) -> None:
        for entity in self.entities:
            entity.undeclare()
        self.session.close()


class Rig(RosHost):
    """A robot's host, and nodes beside it and on the edges."""

    def __init__(self, stack: contextlib.ExitStack) -> None:
        super().__init__(stack, FILE)
        self._stack = stack

    def on_robot(self) -> RosNode:
        return self._node(client_config(connect=(self.host,)))

    def on_edge(self) -> RosNode:
        return self._node(worker_config(connect=(self.seed,), shared_memory=False))

    def _node(self, config: str) -> RosNode:
        node = RosNode(opened(config))
        self._stack.callback(node.close)
        return node


@pytest.fixture
def rig() -> Iterator[Rig]:
    with contextlib.ExitStack() as stack:
        made = Rig(stack)
        yield made
        made.assert_nothing_is_unaccounted()


def of(node: RosNode) -> list[tuple[bytes, bytes]]:
    return [
        (sample.payload.to_bytes(), sample.attachment.to_bytes() if sample.attachment is not None else b"")
        for sample in tuple(node.heard)
    ]


def test_latched_topics_and_their_attachments_through_a_move(rig: Rig) -> None:
    robot, workers = rig.on_robot(), {"edge1": rig.on_edge(), "edge2": rig.on_edge()}
    publish = robot.advertise("map")
    sent = publish(b"map 1")
    merged = {}
    for owner, worker in workers.items():
        worker.subscribe(f"{owner}/merge/robot1/map")
        worker.serve(f"{owner}/merge/now", b"")
        merged[owner] = worker.advertise(f"{owner}/merge/map")
    rig.move("edge1")
    until(lambda: (b"map 1", sent) in of(workers["edge1"]), "the latched map, published before there was an owner")
    first = merged["edge1"](b"merged by edge1")
    robot.subscribe("merged_map")
    until(lambda: (b"merged by edge1", first) in of(robot), "the first owner's result")
    rig.move("edge2")
    until(lambda: (b"map 1", sent) in of(workers["edge2"]), "the latched map at the new owner")
    second = merged["edge2"](b"merged by edge2")
    until(lambda: of(robot)[-1] == (b"merged by edge2", second), "the new owner's result")
    late = rig.on_robot()
    late.subscribe("merged_map")
    until(lambda: (b"merged by edge2", second) in of(late), "the newest result for who comes late")
    assert decode_attachment(second) is not None


def test_each_publisher_of_a_latched_topic_is_heard_through_a_move(rig: Rig) -> None:
    """As /tf_static of three drivers: a new owner heard one of three, for ever."""
    sent = [(text, rig.on_robot().advertise("map")(text)) for text in (b"1", b"2", b"3")]
    workers = {"edge1": rig.on_edge(), "edge2": rig.on_edge()}
    for owner, worker in workers.items():
        worker.subscribe(f"{owner}/merge/robot1/map")
        worker.serve(f"{owner}/merge/now", b"")
    for number, (owner, worker) in enumerate(workers.items()):
        beside = [rig.on_edge() for _ in range(2 - number)]
        said = [node.advertise(f"{owner}/merge/map") for node in (worker, *beside)]
        rig.move(owner)
        until(lambda worker=worker: sorted(set(of(worker))) == sent, "all three at the owner")  # type: ignore[misc]
        early, late = rig.on_robot(), rig.on_robot()
        early.subscribe("merged_map")
        answers = sorted((text, say(text)) for say, text in zip(said, (b"a", b"b", b"c"), strict=False))
        until(lambda early=early, answers=answers: set(of(early)) >= set(answers), "they reach the robot")  # type: ignore[misc]
        late.subscribe("merged_map")
        until(lambda late=late, answers=answers: sorted(of(late)) == answers, "those of this owner for who comes late")  # type: ignore[misc]


def test_graph_tools_see_the_endpoints_of_the_other_side(rig: Rig) -> None:
    robot, workers = rig.on_robot(), {"edge1": rig.on_edge(), "edge2": rig.on_edge()}
    robot.advertise("map")
    robot.subscribe("merged_map")
    for owner, worker in workers.items():
        worker.subscribe(f"{owner}/merge/robot1/map")
        worker.advertise(f"{owner}/merge/map")
        worker.serve(f"{owner}/merge/now", b"")
    rig.move("edge1")
    here = [f"MP %merged_map {QOS}", f"MS %map {QOS}", f"SS %merge_now {QOS}"]
    until(lambda: robot.tokens() == here, "the worker's endpoints, under the robot's names")
    far = workers["edge1"]
    until(
        lambda: far.tokens() == [f"MP %edge1%merge%robot1%map {QOS}", f"MS %edge1%merge%map {QOS}"],
        "the robot's endpoints, under the worker's names",
    )
    rig.move("edge2")
    until(
        lambda: far.tokens() == [f"MP %edge2%merge%robot1%map {QOS}", f"MS %edge2%merge%map {QOS}"],
        "the robot's endpoints at the new owner, and there only",
    )
    assert robot.tokens() == here
    workers["edge2"].close()
    until(lambda: robot.tokens() == [], "a worker that ends takes its endpoints along")
    workers["edge2"].entities.clear()
    workers["edge2"].session = rig.on_edge().session


def test_a_service_is_asked_under_the_robots_name(rig: Rig) -> None:
    robot, worker = rig.on_robot(), rig.on_edge()
    worker.subscribe("edge1/merge/robot1/map")
    asked = worker.serve("edge1/merge/now", b"done")
    rig.move("edge1")
    mark = encode_attachment(Attachment(sequence=1, stamp_ns=time.time_ns(), gid=bytes(16)))
    replies = robot.session.get(
        f"0/merge_now/{TRIGGER}",
        target=zenoh.QueryTarget.ALL_COMPLETE,
        consolidation=zenoh.ConsolidationMode.NONE,
        payload=b"please",
        attachment=mark,
        timeout=5.0,
    )
    (reply,) = list(replies)
    assert reply.ok is not None
    assert str(reply.ok.key_expr) == f"0/merge_now/{TRIGGER}"
    assert reply.ok.payload.to_bytes() == b"done"
    assert reply.ok.attachment is not None
    assert reply.ok.attachment.to_bytes() == mark
    assert asked == [f"0/edge1/merge/now/{TRIGGER}"]


def test_a_request_whose_relay_is_killed_ends_without_a_reply_and_the_next_one_is_answered(rig: Rig) -> None:
    """As docs/guide/ros2.md says: the relay that follows knows nothing of it, so a client needs a time of its own."""
    robot, worker = rig.on_robot(), rig.on_edge()
    worker.subscribe("edge1/merge/robot1/map")
    held: list[zenoh.Query] = []
    is_slow = True

    def on_query(query: zenoh.Query) -> None:
        if is_slow:
            held.append(query)
            return
        with query:
            query.reply(str(query.key_expr), b"done", attachment=query.attachment)

    worker.entities.append(worker.session.declare_queryable(f"0/edge1/merge/now/{TRIGGER}", on_query, complete=True))
    rig.move("edge1")

    def ask() -> Any:
        mark = encode_attachment(Attachment(sequence=1, stamp_ns=time.time_ns(), gid=bytes(16)))
        all_complete = zenoh.QueryTarget.ALL_COMPLETE
        return robot.session.get(f"0/merge_now/{TRIGGER}", target=all_complete, attachment=mark, timeout=50.0)

    replies = ask()
    until(lambda: held, "the owner has the request")
    rig.kill_relay()
    assert list(replies) == []
    is_slow = False
    held.clear()
    rig.move("edge1")
    until(lambda: [reply.ok is not None for reply in ask()] == [True], "the next request is answered")


ALL_COMPLETE = zenoh.QueryTarget.ALL_COMPLETE
ACTION_FILE = FILE.replace(
    """      inputs: [{topic: /map, worker_topic: "/{target}/merge/{robot}/map", class: latest}]
      outputs: [{topic: /merged_map, worker_topic: "/{target}/merge/map", class: latest}]
      services: [{service: /merge_now, type: std_srvs/srv/Trigger, worker_service: "/{target}/merge/now"}]
""",
    """      actions: [{action: /spin, type: nav2_msgs/action/Spin, worker_action: "/{target}/spin"}]
""",
)
PARTS = {
    "send_goal": "nav2_msgs::action::dds_::Spin_SendGoal_/TypeHashNotSupported",
    "get_result": "nav2_msgs::action::dds_::Spin_GetResult_/TypeHashNotSupported",
    "cancel_goal": "action_msgs::srv::dds_::CancelGoal_/TypeHashNotSupported",
}


def test_a_goals_result_is_asked_of_the_next_owner_when_the_first_one_goes() -> None:
    """A ROS client would wait for ever: an error reply is no response. The next owner does not know the goal."""
    with contextlib.ExitStack() as stack:
        host = RosHost(stack, ACTION_FILE)
        asked: dict[str, list[str]] = {"edge1": [], "edge2": []}
        held: list[zenoh.Query] = []

        def answer(owner: str, query: zenoh.Query) -> None:
            asked[owner].append(str(query.key_expr).split("/")[4])
            if owner == "edge1" and "/get_result/" in str(query.key_expr):
                held.append(query)  # the goal is being worked at
                return
            with query:
                query.reply(str(query.key_expr), owner.encode(), attachment=query.attachment)

        for owner in asked:
            session = opened(worker_config(connect=(host.seed,), shared_memory=False))
            stack.callback(session.close)
            for part, kind in PARTS.items():
                key = f"0/{owner}/spin/_action/{part}/{kind}"
                session.declare_queryable(key, partial(answer, owner), complete=True)
        robot = opened(client_config(connect=(host.host,)))
        stack.callback(robot.close)
        host.move("edge1")

        def ask(part: str) -> Any:
            mark = encode_attachment(Attachment(sequence=1, stamp_ns=time.time_ns(), gid=bytes(16)))
            key = f"0/spin/_action/{part}/{PARTS[part]}"
            return robot.get(key, target=ALL_COMPLETE, payload=b"goal", attachment=mark, timeout=20.0)

        for part in ("send_goal", "get_result"):
            querier = robot.declare_querier(f"0/spin/_action/{part}/{PARTS[part]}", target=ALL_COMPLETE)
            until(lambda querier=querier: is_matched(querier), f"the robot's session knows {part}")  # type: ignore[misc]
        (sent,) = list(ask("send_goal"))
        assert sent.ok is not None
        assert sent.ok.payload.to_bytes() == b"edge1"
        result = ask("get_result")
        until(lambda: held, "the first owner has been asked for the result")
        host.move("edge2")
        (reply,) = list(result)
        held.clear()
        assert reply.ok is not None, reply.err
        assert reply.ok.payload.to_bytes() == b"edge2"
        assert asked == {"edge1": ["send_goal", "get_result"], "edge2": ["get_result"]}
