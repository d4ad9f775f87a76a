"""Services in the fleet file and in the plans: templates, settings, loops and clashes."""

import pytest

from support.fleets import tuning_of
from zsched.config.load import CheckResult, check_bytes
from zsched.config.rulecheck import rule_conflicts
from zsched.core.route.route import routes_for
from zsched.core.values.fleet import StreamRule, TaskSpec
from zsched.core.values.plan import Direction, ServiceSettings

SERVICE = Direction.SERVICE
ROBOTS = ("robot1", "robot2")

FILE = """\
fleet: f
nodes:
  robot1: {kind: robot}
  robot2: {kind: robot}
  edge1: {kind: edge, host: 127.0.0.1, listen: {control: tcp/127.0.0.1:7457, data: tcp/127.0.0.1:7458}}
tasks:
  merge:
    candidates: [edge1]
    weights: {cpu: 1}
    services:
      - SERVICE
"""


def check(service: str) -> CheckResult:
    return check_bytes(FILE.replace("SERVICE", service).encode())


def task_of(*pairs: tuple[str, str], name: str = "merge", direction: Direction = SERVICE) -> TaskSpec:
    rules = tuple(StreamRule(direction=direction, from_template=a, to_template=b) for a, b in pairs)
    tuning = tuning_of(cpu=1.0, memory=0.0)
    return TaskSpec(name=name, candidates=("edge1", "robot1"), tuning=tuning, rules=rules)


def test_a_service_of_the_file_becomes_a_route_of_its_kind() -> None:
    result = check(
        '{from: "{robot}/now", to: "{target}/merge/{robot}/now", retry: true, timeout_s: 1, hold_s: 0, max_pending: 3}'
    )
    assert result.fleet is not None, result.report()
    (route,) = routes_for(result.fleet.task("merge"), "robot2", "edge1", 4)
    assert (route.stream, route.direction) == ("merge/srv/0", SERVICE)
    assert (route.from_expr, route.to_expr) == ("robot2/now", "edge1/merge/robot2/now")
    assert route.service == ServiceSettings(retry=True, timeout_s=1.0, hold_s=0.0, max_pending=3)


def test_defaults_of_a_service_never_run_it_twice() -> None:
    result = check('{from: "{robot}/now", to: "{target}/now"}')
    assert result.fleet is not None, result.report()
    (route,) = routes_for(result.fleet.task("merge"), "robot1", "edge1", 1)
    assert route.service.retry is False


@pytest.mark.parametrize(
    ("service", "said"),
    [
        ('{from: "merge_now", to: "{target}/now"}', "once for each"),
        ('{from: "{target}/now", to: "{target}/x"}', "may not stand in the 'from' of a service"),
        ('{from: "{robot}/now", to: "merge/now"}', "it lacks {target}"),
        ('{from: "{robot}/now", to: "{target}/{epoch}/now"}', "may not stand in the 'to' of a service"),
        ('{from: "{robot}/now", to: "{target}/now", timeout_s: 0}', "0.05..3600"),
        ('{from: "{robot}/now", to: "{target}/now", hold_s: -1}', "0..3600"),
        ('{from: "{robot}/now", to: "{target}/now", max_pending: 0}', "1..256"),
        ('{from: "{robot}/now", to: "{target}/now", class: latest}', "class"),
        ('{from: "{robot}/now"}', "to"),
    ],
)
def test_a_service_that_cannot_work_is_refused_at_its_place(service: str, said: str) -> None:
    result = check(service)
    assert result.fleet is None
    assert said in result.report()
    assert all(fault.line == 11 for fault in result.faults), result.report()


def test_services_that_ask_each_other_are_a_loop() -> None:
    """robot1 is a candidate: its own service leads back to itself."""
    (conflict, *_) = rule_conflicts([task_of(("{robot}/a", "{target}/a"))], ROBOTS)
    assert conflict.is_fatal
    assert "relays feed each other" in conflict.message
    two = task_of(("{robot}/a", "{target}/b"), ("{robot}/b", "{target}/a"))
    (conflict, *_) = rule_conflicts([two], ROBOTS)
    assert set(conflict.streams) == {"merge/srv/0", "merge/srv/1"}


def test_two_services_on_one_key_clash_and_name_both_rules() -> None:
    tasks = [
        task_of(("{robot}/a", "{target}/x/{robot}")),
        task_of(("{node}/a", "{target}/y/{robot}"), name="other"),
    ]
    (conflict,) = rule_conflicts(tasks, ROBOTS)
    assert conflict.streams == ("merge/srv/0", "other/srv/0")
    assert "two services answer 'robot1/a'" in conflict.message


def test_a_stream_and_a_service_may_share_a_key() -> None:
    """A sample never becomes a request."""
    tasks = [
        task_of(("{robot}/a", "{target}/x/{robot}")),
        task_of(("{robot}/a", "{target}/y/{robot}/a"), name="other", direction=Direction.INPUT),
        task_of(("{target}/x/{robot}", "{robot}/b"), name="third", direction=Direction.OUTPUT),
    ]
    assert rule_conflicts(tasks, ROBOTS) == ()
