"""`ros2:` sections become ordinary rules, `local:` sides make room for equal keys; faults stand where they belong."""

from __future__ import annotations

from pathlib import Path

import pytest
from rosbags.typesys import Stores, get_typestore

from zsched.config.load import CheckResult, check_bytes
from zsched.core.route.route import routes_for
from zsched.core.route.wildcards import rewriter
from zsched.core.values.fleet import Fleet, LocalMode, LocalSide
from zsched.core.values.plan import Direction, RosGraph, StreamClass

HASH = "RIHS01_8d348150c12913a31ee0ec170fbf25089e4745d17035792a1ba94d6f0bc0cfc7"
GRID = "nav_msgs::msg::dds_::OccupancyGrid_"
FILE = """\
fleet: f
nodes:
  robot1: {kind: robot, wired: true, host: 192.0.2.1LOCAL, listen: {control: tcp/0.0.0.0:7457, data: tcp/0.0.0.0:7458}}
  robot2: {kind: robot, wired: trueLOCAL}
  robot3: {kind: robot, wired: trueLOCAL}
  edge1: {kind: edge}
tasks:
  merge:
    candidates: {kind: edge}
    weights: {cpu: 1}
    RULES
"""
SIDE = ', local: {connect: ["tcp/127.0.0.1:7447"]}'


def check(rules: str, local: str = "") -> CheckResult:
    return check_bytes(FILE.replace("LOCAL", local).replace("RULES", rules).encode())


def fleet_of(rules: str, local: str = "") -> Fleet:
    result = check(rules, local)
    assert result.fleet is not None, result.report()
    return result.fleet


def faults(rules: str, local: str = "") -> str:
    result = check(rules, local)
    assert result.fleet is None
    return result.report()


TOPICS = """ros2:
      inputs: [{topic: "/{robot}/map", type: nav_msgs/msg/OccupancyGrid, worker_key: "{target}/merge/{robot}/map", class: latest}]
      outputs: [{topic: "/{robot}/merged", worker_topic: "/{target}/merge/map", class: latest, keep_last: 2}]
      services: [{service: "/{robot}/merge_now", worker_service: "/{target}/merge/now", type: std_srvs/srv/Trigger, timeout_s: 3}]
"""  # noqa: E501 - one line per entry, as operators write it


def test_names_become_rules_with_every_setting() -> None:
    task = fleet_of(TOPICS).tasks[0]
    routes = routes_for(task, "robot1", "edge1", 7)
    assert [(route.stream, route.from_expr, route.to_expr) for route in routes] == [
        ("merge/in/0", f"0/robot1/map/{GRID}/*", "edge1/merge/robot1/map"),
        ("merge/out/0", "0/edge1/merge/map/*/*", "0/robot1/merged/*/*"),
        (
            "merge/srv/0",
            "0/robot1/merge_now/std_srvs::srv::dds_::Trigger_/*",
            "0/edge1/merge/now/std_srvs::srv::dds_::Trigger_/*",
        ),
    ]
    assert all(route.settings.graph is RosGraph.RMW_ZENOH for route in routes)
    assert routes[0].settings.stream_class is StreamClass.LATEST
    assert routes[1].settings.keep_last == 2
    assert routes[2].service.timeout_s == 3


def test_domain_and_bridge_shape_the_keys() -> None:
    entry = '[{topic: "/{robot}/map", worker_topic: "/{target}/merge/{robot}/map"}]'
    (rmw,) = fleet_of(f"ros2: {{domain: 5, inputs: {entry}}}").tasks[0].rules
    assert rmw.from_template == "5/{robot}/map/*/*"
    (dds,) = fleet_of(f"ros2: {{bridge: ros2dds, inputs: {entry}}}").tasks[0].rules
    assert (dds.from_template, dds.to_template) == ("{robot}/map", "{target}/merge/{robot}/map")
    assert dds.settings.graph is RosGraph.ROS2DDS


def test_robots_that_all_publish_map_need_their_local_sides() -> None:
    rules = """ros2:
      inputs: [{topic: /map, worker_key: "{target}/merge/{robot}/map"}]
      outputs: [{topic: /merged, type: nav_msgs/msg/OccupancyGrid, hash: HASH, worker_key: "{target}/m/{epoch}/map"}]
""".replace("HASH", HASH)
    fleet = fleet_of(rules, SIDE)
    assert fleet.node("robot2").local == LocalSide(mode=LocalMode.CLIENT, connect=("tcp/127.0.0.1:7447",))
    assert fleet.tasks[0].rules[1].to_template == f"0/merged/{GRID}/{HASH}"
    report = faults(rules)
    assert "it lacks {robot}: every robot would publish its copy under one key" in report
    assert "robot1, robot2, robot3 has none" in report


@pytest.mark.parametrize(
    ("entry", "said", "line_col"),
    [
        ('{topic: "map", worker_key: "{target}/x"}', "it must begin with '/'", "11:29"),
        ('{topic: "/{robot}/7up", worker_key: "{target}/x"}', "'7up' is no part of a ROS name", "11:29"),
        ('{topic: "/{robot}/map"}', "say one of worker_topic and worker_key", "11:21"),
        ('{topic: "/{robot}/m", worker_key: "{target}/x", worker_topic: "/{target}/x"}', "say one of", "11:21"),
        ('{topic: "/{robot}/m", worker_key: "{target}/{robot}", type: nav_msgs/Odometry}', "PACKAGE/msg/NAME", ""),
        (
            '{topic: "/{robot}/m", worker_key: "{target}/{robot}", type: a/action/B}',
            "an action goes under `actions:`",
            "",
        ),
        ('{topic: "/{robot}/m", worker_key: "{target}/{robot}", type: a/srv/B}', "the type of a service, this is", ""),
        (
            '{topic: "/{robot}/**", worker_key: "{target}/{robot}/**"}',
            "say the type, or worker_topic",
            "11:29",
        ),
        ('{topic: "/{robot}/m", worker_key: "{target}/{robot}", hash: abc}', "64 hex digits", ""),
        ('{topic: "/{robt}/m", worker_key: "{target}/{robot}"}', "no placeholder {robt}", "11:29"),
        ('{topic: "/{robot}/m", worker_key: "x/{robot}"}', "lacks {target}", "11:55"),
        ('{topic: "/{robot}/m", worker_topic: "/{target}/{epoch}/m"}', "an epoch is a number", "11:57"),
    ],
)
def test_a_fault_stands_at_the_name(entry: str, said: str, line_col: str) -> None:
    report = faults(f"ros2: {{inputs: [{entry}]}}")
    assert said in report
    assert line_col in report


def test_all_topics_below_a_name_pass_whatever_their_types() -> None:
    """What the fault's advice says: with the worker's topic, or with the type."""
    entries = """ros2:
      inputs: [{topic: "/{robot}/a/**", worker_topic: "/{target}/m/{robot}/**"},
               {topic: "/{robot}/b/**", worker_key: "{target}/n/{robot}/**", type: nav_msgs/msg/OccupancyGrid},
               {topic: "/{robot}/c/**", worker_key: "{target}/o/{robot}"}]
"""
    routes = routes_for(fleet_of(entries).tasks[0], "robot1", "edge1", 7)
    assert [(route.from_expr, route.to_expr) for route in routes] == [
        ("0/robot1/a/*/*/**", "0/edge1/m/robot1/*/*/**"),
        (f"0/robot1/b/**/{GRID}/*", "edge1/n/robot1/**"),
        ("0/robot1/c/*/*/**", "edge1/o/robot1"),
    ]
    rewrite = rewriter(routes[0].from_expr, routes[0].to_expr)
    assert rewrite(f"0/robot1/a/front/scan/{GRID}/{HASH}") == f"0/edge1/m/robot1/front/scan/{GRID}/{HASH}"


ACTION = '{action: "/{robot}/spin", worker_action: "/{target}/spin", type: nav2_msgs/action/Spin}'


def test_an_action_is_its_three_services_and_two_topics() -> None:
    """The entry says what five entries say, by the names that ROS gives them."""
    entries = """ros2:
      inputs: []
      outputs:
        - {topic: "/{robot}/spin/_action/feedback", worker_topic: "/{target}/spin/_action/feedback", type: nav2_msgs/action/Spin_FeedbackMessage}
        - {topic: "/{robot}/spin/_action/status", worker_topic: "/{target}/spin/_action/status", type: action_msgs/msg/GoalStatusArray}
      services:
        - {service: "/{robot}/spin/_action/send_goal", worker_service: "/{target}/spin/_action/send_goal", type: nav2_msgs/action/Spin_SendGoal}
        - {service: "/{robot}/spin/_action/get_result", worker_service: "/{target}/spin/_action/get_result", type: nav2_msgs/action/Spin_GetResult}
        - {service: "/{robot}/spin/_action/cancel_goal", worker_service: "/{target}/spin/_action/cancel_goal", type: action_msgs/srv/CancelGoal}
"""  # noqa: E501 - one line per entry, as operators write it
    long = fleet_of(entries).tasks[0].rules
    short = fleet_of(f"ros2: {{actions: [{ACTION}]}}").tasks[0].rules
    keys = [(rule.direction, rule.from_template, rule.to_template, rule.settings.graph) for rule in short]
    assert keys == [(rule.direction, rule.from_template, rule.to_template, rule.settings.graph) for rule in long]


def test_an_actions_settings_go_to_the_parts_that_want_them() -> None:
    entry = f"{ACTION[:-1]}, timeout_s: 2, hold_s: 1, result_timeout_s: 60}}"
    feedback, status, send, result, cancel = fleet_of(f"ros2: {{actions: [{entry}]}}").tasks[0].rules
    assert (feedback.settings.stream_class, status.settings.stream_class) == (
        StreamClass.BEST_EFFORT,
        StreamClass.LATEST,
    )
    assert [(one.service.timeout_s, one.service.retry) for one in (send, result, cancel)] == [
        (2, False),
        (60, True),
        (2, True),
    ]
    assert {one.service.hold_s for one in (send, result, cancel)} == {1}


def test_an_action_of_any_type_and_one_of_a_bridge_have_keys() -> None:
    entry = ACTION.replace(", type: nav2_msgs/action/Spin", "")
    keys = [rule.to_template for rule in fleet_of(f"ros2: {{actions: [{entry}]}}").tasks[0].rules]
    assert keys[0] == "0/{robot}/spin/_action/feedback/*/*"
    assert keys[1] == "0/{robot}/spin/_action/status/action_msgs::msg::dds_::GoalStatusArray_/*"
    bridged = fleet_of(f"ros2: {{bridge: ros2dds, actions: [{entry}]}}").tasks[0].rules
    assert bridged[2].to_template == "{target}/spin/_action/send_goal"
    assert "the bridge's keys have none" in faults(f"ros2: {{bridge: ros2dds, actions: [{ACTION}]}}")


def test_node_names_must_be_fit_for_ros_names() -> None:
    text = FILE.replace("LOCAL", "").replace("robot2", "robot-2")
    entry = 'ros2: {inputs: [{topic: "/{robot}/m", worker_key: "{target}/{robot}"}]}'
    result = check_bytes(text.replace("RULES", entry).encode())
    assert "the node 'robot-2' would stand in a ROS name" in result.report()


def test_wildcards_are_captured_loops_with_them_refused() -> None:
    rule = 'inputs: [{from: "{robot}/sensors/**", to: "{target}/merge/{robot}/sensors/**"}]'
    assert [one.direction for one in fleet_of(rule).tasks[0].rules] == [Direction.INPUT]
    assert "wildcard 1 of 'to' is '*'" in faults('inputs: [{from: "{robot}/**", to: "{target}/{robot}/*"}]')
    assert "more wildcards" in faults('inputs: [{from: "{robot}/x", to: "{target}/{robot}/*"}]')
    loop = 'inputs: [{from: "{robot}/**", to: "{target}/{robot}/**"}]'
    text = FILE.replace("LOCAL", "").replace("RULES", loop).replace("{kind: edge}\n    w", "[robot1]\n    w")
    assert "loop, relays feed each other: robot1/** -> robot1/robot1/**" in check_bytes(text.encode()).report()


def test_keys_that_become_one_are_warned_of() -> None:
    result = check('inputs: [{from: "{robot}/*", to: "{target}/{robot}/all"}]')
    assert result.fleet is not None
    assert "several keys become one" in result.report()
    assert check(TOPICS).report() == ""


def test_type_hashes_in_the_shipped_files_are_what_rosbags_computes() -> None:
    types = get_typestore(Stores.ROS2_JAZZY)
    text = (Path(__file__).parents[3] / "configs" / "ros2.yaml").read_text()
    for name in ("nav_msgs/msg/OccupancyGrid", "tf2_msgs/msg/TFMessage"):
        assert f"type: {name}\n          hash: {types.hash_rihs01(name)}\n" in text


@pytest.mark.parametrize(
    ("domain", "env", "is_told"),
    [
        ("domain: 7", '{ROS_DOMAIN_ID: "7"}', False),
        ("domain: 0", '{ROS_DOMAIN_ID: "7"}', True),
        ("bridge: rmw_zenoh", '{ROS_DOMAIN_ID: "7"}', True),
        ("bridge: ros2dds", '{ROS_DOMAIN_ID: "7"}', False),
        ("domain: 7", "{}", False),
        ("domain: 7", '{ROS_DOMAIN_ID: "07"}', False),
    ],
)
def test_a_worker_of_another_domain_than_its_streams_is_a_warning(domain: str, env: str, *, is_told: bool) -> None:
    entry = "{topic: /map, type: nav_msgs/msg/OccupancyGrid, worker_topic: '/{target}/map/{robot}'}"
    rules = f"worker: {{command: [x], env: {env}}}\n    ros2: {{{domain}, inputs: [{entry}]}}"
    found = [one for one in check(rules).warnings if "ROS_DOMAIN_ID is 7" in one.message]
    assert [one.line for one in found] == [FILE.splitlines().index("    RULES") + 1] * is_told
