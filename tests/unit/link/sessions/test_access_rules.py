"""Who may say what in a secured fleet, by the rules that zenoh gets: held against zenoh's own sense of keys."""

from __future__ import annotations

import json
from typing import Any

import pytest
import zenoh

from zsched.config.load import check_bytes
from zsched.core.values.fleet import Fleet
from zsched.link.keyspace import Keyspace
from zsched.link.sessions.access_rules import Side, access_control

TEXT = """\
fleet: yard
nodes:
  robot1: {kind: robot}
  robot2: {kind: robot}
  edge1: {kind: edge, host: 192.0.2.1, listen: {control: tls/0.0.0.0:7457, data: tls/0.0.0.0:7458}}
  edge2: {kind: edge}
tasks:
  merge:
    candidates: [edge1]
    weights: {cpu: 0.5, memory: 0.5}
    worker: {command: [python]}
    inputs: [{from: "{robot}/map/**", to: "{target}/merge/{robot}/map/**"}]
    outputs: [{from: "{target}/merge/{epoch}/{robot}/out", to: "{robot}/out"}]
    services: [{from: "{robot}/plan", to: "{target}/merge/{robot}/plan"}]
security: {operators: [ana], guests: [screen], revoked: [robot2]}
"""
KEYS = Keyspace("yard")


def fleet(text: str = TEXT) -> Fleet:
    result = check_bytes(text.encode())
    assert result.fleet is not None, result.report()
    return result.fleet


def may(side: Side, who: str, flow: str, message: str, key: str, text: str = TEXT) -> bool:
    """Whether the rules let ``who`` (a common name's first part); a rule must include the key, as zenoh has it."""
    yard = fleet(text)
    assert yard.security is not None
    rules: dict[str, Any] = access_control(yard, yard.security, side)
    assert rules["default_permission"] == "deny"
    name = f"{who}.yard.zsched.internal"
    subjects = {one["id"] for one in rules["subjects"] if name in one["cert_common_names"]}
    named = {rule for one in rules["policies"] if set(one["subjects"]) & subjects for rule in one["rules"]}
    return any(
        rule["id"] in named
        and rule["permission"] == "allow"
        and flow in rule["flows"]
        and message in rule["messages"]
        and any(zenoh.KeyExpr(one).includes(key) for one in rule["key_exprs"])
        for rule in rules["rules"]
    )


@pytest.mark.parametrize("side", Side)
def test_zenoh_takes_the_rules_and_every_name_stands_for_one_holder(side: Side) -> None:
    yard = fleet()
    assert yard.security is not None
    rules = access_control(yard, yard.security, side)
    config = zenoh.Config()
    config.insert_json5("access_control", json.dumps(rules))
    names = [name for one in rules["subjects"] for name in one["cert_common_names"]]
    assert len(set(names)) == len(names)
    assert all(names)
    assert {one["id"] for one in rules["subjects"]} == {
        subject for one in rules["policies"] for subject in one["subjects"]
    }


@pytest.mark.parametrize("key", [KEYS.beat, KEYS.beat_in_turn, KEYS.profile, KEYS.proposal, KEYS.allocation])
def test_a_node_puts_under_its_own_control_keys_only(key: Any) -> None:
    assert may(Side.CONTROL, "robot1", "ingress", "put", key("robot1"))
    assert not may(Side.CONTROL, "robot1", "ingress", "put", key("edge1"))
    assert not may(Side.CONTROL, "robot1", "ingress", "put", key("*"))
    assert not may(Side.CONTROL, "ana.operator", "ingress", "put", key("ana"))


def test_a_node_asks_and_answers_in_its_own_name() -> None:
    for question in (KEYS.register, KEYS.utility, KEYS.learnt, KEYS.document, KEYS.status, KEYS.command):
        assert may(Side.CONTROL, "robot1", "ingress", "query", question("edge1", "robot1"))
        assert may(Side.CONTROL, "robot1", "ingress", "query", question("*", "robot1"))
        assert may(Side.CONTROL, "robot1", "ingress", "reply", question("robot1", "edge1"))
        assert not may(Side.CONTROL, "robot1", "ingress", "reply", question("edge1", "robot1"))
        if question != KEYS.status:  # which a node passes on for those that hang on it
            assert not may(Side.CONTROL, "robot1", "ingress", "query", question("robot1", "edge1"))
    assert may(Side.CONTROL, "robot1", "ingress", "liveliness_token", KEYS.alive("robot1", 7))
    assert not may(Side.CONTROL, "robot1", "ingress", "liveliness_token", KEYS.alive("edge1", 7))


def test_commands_are_for_operators_in_their_own_name_and_status_for_guests() -> None:
    def asks(who: str, key: str) -> bool:
        return may(Side.CONTROL, who, "ingress", "query", key)

    assert asks("ana.operator", KEYS.command("edge1", "ana"))
    assert not asks("ana.operator", KEYS.command("edge1", "robot1"))
    assert asks("ana.operator", KEYS.status("*", "ana"))
    assert asks("screen.guest", KEYS.status("edge1", "screen"))
    assert not asks("screen.guest", KEYS.command("edge1", "screen"))
    assert not asks("screen.guest", KEYS.register("edge1", "screen"))
    assert not asks("screen.operator", KEYS.command("edge1", "screen"))
    assert not asks("robot1", KEYS.command("edge1", "ana"))


def test_revoked_keys_strangers_and_other_fleets_may_nothing() -> None:
    for who in ("robot2", "edge3", "robot1.operator", "ca", "ana"):
        for side in Side:
            assert not may(side, who, "ingress", "put", KEYS.beat(who.partition(".")[0]))
            assert not may(side, who, "ingress", "declare_subscriber", "robot1/map/a")
            assert not may(side, who, "egress", "put", "robot1/map/a")
    assert may(Side.CONTROL, "robot2.k2", "ingress", "put", KEYS.beat("robot2"))
    assert not may(Side.CONTROL, "robot1", "ingress", "put", Keyspace("field").beat("robot1"))


def test_robots_feed_their_own_inputs_and_owners_answer_for_their_own_tasks() -> None:
    def speaks(who: str, key: str, message: str = "put") -> bool:
        return may(Side.DATA, who, "ingress", message, key)

    for suffix in ("", "/@zsched/end", "/@zsched/again/abc", "/@adv/pub/1/2"):
        assert speaks("robot1", f"edge1/merge/robot1/map/a/b{suffix}")
        assert not speaks("robot1", f"edge1/merge/robot2/map/a/b{suffix}")
        assert speaks("edge1", f"edge1/merge/7/robot1/out{suffix}")
        assert not speaks("robot1", f"edge1/merge/7/robot1/out{suffix}")
        assert not speaks("edge2", f"edge2/merge/7/robot1/out{suffix}"), "edge2 is no candidate"
        assert speaks("robot1", f"robot1/out{suffix}")
        assert not speaks("edge1", f"robot1/out{suffix}")
    assert speaks("edge1", "edge1/merge/robot1/plan", "reply")
    assert not speaks("edge2", "edge1/merge/robot1/plan", "reply")
    assert may(Side.DATA, "robot1", "ingress", "query", "edge1/merge/robot1/plan")
    assert not may(Side.DATA, "robot1", "ingress", "query", "edge1/merge/robot2/plan")


def test_what_stays_on_a_robot_s_local_side_gives_it_no_right_among_the_others() -> None:
    """A rule that takes all of a robot's own network would else let it speak under everybody's keys."""
    local = "local: {mode: peer, listen: [tcp/127.0.0.1:7460]}"
    text = TEXT.replace("robot}", f"robot, {local}}}", 2).replace("{robot}/map/**", "**", 1)
    assert text.count(local) == 2
    for message, key in (
        ("put", "robot2/scan"),
        ("put", "edge1/merge/7/robot1/out"),
        ("put", "edge1/merge/robot2/map/a"),
        ("put", KEYS.role("edge1", "merge")),
        ("put", KEYS.ack("edge1", "merge", 1, "abc")),
        ("reply", KEYS.snapshot("edge1", "merge")),
        ("liveliness_token", KEYS.worker("edge2", "merge", 1)),
        ("query", "robot2/plan"),
    ):
        assert not may(Side.DATA, "robot1", "ingress", message, key, text), key
    assert may(Side.DATA, "robot1", "ingress", "put", "edge1/merge/robot1/map/a", text)
    assert may(Side.DATA, "robot1", "ingress", "query", "edge1/merge/robot1/plan", text)
    assert may(Side.DATA, "edge1", "ingress", "put", "edge1/merge/7/robot1/out", text)


def test_a_name_that_begins_like_another_gives_no_right_to_that_ones_keys() -> None:
    """Where a rule joins two names in one chunk, ``robot1_*`` would be robot1_b's key, too."""
    text = TEXT.replace("robot2", "robot1_b").replace("edge2", "edge1_b").replace("[edge1]", "[edge1, edge1_b]")
    for own, joined in (
        ("{target}/merge/{robot}/map/**", "m/{robot}_{target}/**"),
        ("{target}/merge/{epoch}/{robot}/out", "m/{target}_{robot}/{epoch}/out"),
        ("{target}/merge/{robot}/plan", "p/{robot}_{target}"),
    ):
        text = text.replace(own, joined)

    def speaks(who: str, key: str, message: str = "put") -> bool:
        return may(Side.DATA, who, "ingress", message, key, text)

    for robot in ("robot1", "robot1_b.k2"):
        name = robot.partition(".")[0]
        assert speaks(robot, f"m/{name}_edge1/a")
        assert speaks(robot, f"m/{name}_edge1_b/a")
        assert speaks(robot, f"p/{name}_edge1", "query")
    for edge in ("edge1", "edge1_b"):
        assert speaks(edge, f"m/{edge}_robot1/7/out")
        assert speaks(edge, f"m/{edge}_robot1_b/7/out")
        assert speaks(edge, f"p/robot1_b_{edge}", "reply")
    assert not speaks("robot1", "m/robot1_b_edge1/a")
    assert not speaks("robot1", "p/robot1_b_edge1", "query")
    assert not speaks("edge1", "m/edge1_b_robot1/7/out")
    assert not speaks("edge1_b", "p/robot1_edge1", "reply")


def test_a_workers_words_are_of_its_own_node() -> None:
    for message, key in (
        ("liveliness_token", KEYS.worker("edge1", "merge", 1)),
        ("put", KEYS.ack("edge1", "merge", 1, "abc")),
        ("put", KEYS.trouble("edge1", "merge", 1)),
        ("reply", KEYS.snapshot("edge1", "merge")),
        ("reply", KEYS.role("edge1", "merge")),
        ("put", KEYS.received("edge1", "abc", "def")),
        ("liveliness_token", f"{KEYS.role('edge1', 'merge')}/7"),
    ):
        assert may(Side.DATA, "edge1", "ingress", message, key)
        assert not may(Side.DATA, "edge2", "ingress", message, key)
        assert not may(Side.DATA, "ana.operator", "ingress", message, key)


def test_guests_and_operators_read_streams_and_put_nothing() -> None:
    for who in ("screen.guest", "ana.operator"):
        assert may(Side.DATA, who, "ingress", "declare_subscriber", "robot1/out")
        assert may(Side.DATA, who, "ingress", "declare_subscriber", "**")
        assert may(Side.DATA, who, "egress", "put", "robot1/out")
        assert not may(Side.DATA, who, "ingress", "put", "robot1/map/a")
        assert not may(Side.DATA, who, "ingress", "query", "robot1/plan")
        assert not may(Side.DATA, who, "ingress", "query", KEYS.snapshot("edge1", "merge"))
        assert not may(Side.DATA, who, "egress", "put", KEYS.role("edge1", "merge"))


def test_a_visitor_believes_members_only() -> None:
    assert may(Side.VISIT, "edge1", "ingress", "reply", KEYS.status("robot1", "ana"))
    assert not may(Side.VISIT, "screen.guest", "ingress", "reply", KEYS.status("robot1", "ana"))


def test_images_of_a_ros_worker_may_come_beside_their_topics_key() -> None:
    ros = 'ros2: {outputs: [{topic: "/{robot}/seen", worker_topic: "/{target}/seen"}]}'
    text = TEXT.replace("    services:", f"    {ros}\n    services:")
    key = "0/edge1/seen/sensor_msgs::msg::dds_::Image_/RIHS01_x"
    for whose, is_let_in in (("edge1", True), ("edge2", False)):
        assert may(Side.DATA, whose, "ingress", "put", key, text) == is_let_in
        assert may(Side.DATA, whose, "ingress", "put", f"{key}/_buf_cpu", text) == is_let_in
