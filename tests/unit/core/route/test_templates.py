"""Templates become routes; every placeholder has its place."""

import doctest

import pytest
import zenoh
from hypothesis import given, settings
from hypothesis import strategies as st

from support.fleets import tuning_of
from zsched.core.route import keyexpr
from zsched.core.route import route as made
from zsched.core.route.route import fill, named_rules, routes_for, widened
from zsched.core.route.templates import merges_keys, rule_fault, shared_key_fault, template_fault
from zsched.core.values.fleet import StreamRule, TaskSpec
from zsched.core.values.plan import Direction, StreamClass, StreamSettings

IN, OUT = Direction.INPUT, Direction.OUTPUT


def rule(direction: Direction, source: str, target: str) -> StreamRule:
    return StreamRule(
        direction=direction,
        from_template=source,
        to_template=target,
        settings=StreamSettings(stream_class=StreamClass.LATEST),
    )


def task_of(*rules: StreamRule, name: str = "map_merge", candidates: tuple[str, ...] = ("edge1", "edge2")) -> TaskSpec:
    return TaskSpec(
        name=name,
        candidates=candidates,
        tuning=tuning_of(cpu=1.0, memory=0.0),
        rules=rules,
    )


MAP = rule(IN, "{robot}/map", "{target}/{task}/{robot}/map")
GLOBAL = rule(OUT, "{target}/{task}/{epoch}/global_map", "{robot}/global_map")
STATUS = rule(OUT, "{target}/{task}/{epoch}/status", "{node}/{task}/status")


def test_a_stream_that_feeds_itself_is_refused() -> None:
    same = "{robot}/{target}/map"
    assert "feed itself" in (rule_fault(rule(IN, same, same)) or "")
    assert rule_fault(MAP) is None


def test_routes_for_fills_every_placeholder() -> None:
    routes = routes_for(task_of(GLOBAL, MAP, STATUS), "robot2", "edge1", 7)
    assert [(route.stream, route.from_expr, route.to_expr) for route in routes] == [
        ("map_merge/in/0", "robot2/map", "edge1/map_merge/robot2/map"),
        ("map_merge/out/0", "edge1/map_merge/7/global_map", "robot2/global_map"),
        ("map_merge/out/1", "edge1/map_merge/7/status", "robot2/map_merge/status"),
    ]
    assert all(route.settings.stream_class is StreamClass.LATEST for route in routes)


def test_stream_names_do_not_change_with_owner_and_epoch() -> None:
    task = task_of(MAP, GLOBAL)
    before = [route.stream for route in routes_for(task, "robot1", "edge1", 1)]
    after = [route.stream for route in routes_for(task, "robot1", "edge2", 2)]
    assert before == after == [name for name, _ in named_rules(task)]


def test_output_key_of_a_robot_does_not_change_with_the_owner() -> None:
    keys = {routes_for(task_of(GLOBAL), "robot1", owner, epoch)[0].to_expr for owner in "ab" for epoch in (1, 2)}
    assert keys == {"robot1/global_map"}


names = st.from_regex(r"[a-z0-9][a-z0-9_-]{0,10}", fullmatch=True)


@settings(max_examples=300, deadline=None)
@given(names, names, names, st.integers(min_value=0, max_value=2**53))
def test_filled_rules_are_valid_and_within_what_they_may_become(robot: str, owner: str, name: str, epoch: int) -> None:
    task = task_of(MAP, GLOBAL, STATUS, name=name, candidates=(owner,))
    for route, (_, made_from) in zip(routes_for(task, robot, owner, epoch), named_rules(task), strict=True):
        for expr, template in ((route.from_expr, made_from.from_template), (route.to_expr, made_from.to_template)):
            zenoh.KeyExpr(expr)
            assert not keyexpr.is_wild(expr)
            assert keyexpr.includes(widened(template), expr)
            assert keyexpr.includes(widened(template, robot=robot, node=robot, target=owner, task=name), expr)


BAD = [
    (IN, "from", "{target}/map", "whoever owns"),
    (IN, "from", "{epoch}/map", "only the 'from' of an output"),
    (IN, "to", "x/{robot}/map", "lacks {target}"),
    (IN, "to", "{target}/{epoch}/map", "only the 'from' of an output"),
    (OUT, "from", "global_map", "lacks {target}"),
    (OUT, "from", "{target}/e{epoch}/map", "whole chunk"),
    (OUT, "from", "{target}/{epoch}/{epoch}/map", "whole chunk"),
    (OUT, "to", "{robot}/{target}/map", "keeps its key"),
    (OUT, "to", "{robot}/{}/map", "no placeholder {}"),
    (OUT, "to", "{robt}/map", "no placeholder {robt}"),
    (OUT, "to", "{robot/map", "brace"),
    (OUT, "to", "{robot}}/map", "brace"),
    (IN, "from", "@zsched/x/{robot}", "belong to zsched"),
    (OUT, "to", "{robot}/map/@zsched/end", "belong to zsched"),
    (IN, "from", "/{robot}/map", "empty chunk"),
    (IN, "from", "{robot}/map#1", "'#'"),
    (IN, "from", "{robot}/**/x/**", "more than one '**'"),
    (IN, "to", "{target}/a$*b$*", "more than one '$*'"),
    (IN, "to", "{target}/**/*", "'*/**'"),
    (IN, "from", "", "empty"),
]


@pytest.mark.parametrize(("direction", "side", "template", "said"), BAD)
def test_template_out_of_place_is_refused_with_the_reason(
    direction: Direction, side: str, template: str, said: str
) -> None:
    assert said in (template_fault(template, direction, side) or "")


@settings(max_examples=500, deadline=None)
@given(st.text(alphabet="{}robtagepch/*$@#a", max_size=30), st.sampled_from((IN, OUT)), st.sampled_from(("from", "to")))
def test_any_text_is_fine_or_refused_never_an_exception(template: str, direction: Direction, side: str) -> None:
    if template_fault(template, direction, side) is None:
        zenoh.KeyExpr(fill(template, robot="r", node="r", target="t", task="k", epoch="1"))


def test_wildcards_of_a_rule_must_fit() -> None:
    assert rule_fault(rule(IN, "{robot}/s/**", "{target}/{robot}/**")) is None
    assert "more wildcards" in (rule_fault(rule(IN, "{robot}/s", "{target}/{robot}/*")) or "")
    assert "'**'" in (rule_fault(rule(IN, "{robot}/*", "{target}/{robot}/**")) or "")


def test_a_dropped_wildcard_and_a_missing_robot_are_seen() -> None:
    assert merges_keys(rule(IN, "0/{robot}/map/*/*", "{target}/{robot}/map"))
    assert not merges_keys(rule(IN, "{robot}/*", "{target}/{robot}/*"))
    assert "lacks {robot}" in (shared_key_fault(rule(OUT, "{target}/m/{epoch}/map", "global_map")) or "")
    assert "once for each" in (shared_key_fault(rule(Direction.SERVICE, "merge", "{target}/{robot}/merge")) or "")
    assert shared_key_fault(rule(OUT, "{target}/m/{epoch}/map", "{node}/global_map")) is None
    assert shared_key_fault(rule(IN, "map", "{target}/{robot}/map")) is None


def test_wildcards_stay_in_routes_and_widened_templates_stay_canonical() -> None:
    (route,) = routes_for(task_of(rule(IN, "{robot}/s/**", "{target}/t/{robot}/**")), "robot1", "edge1", 3)
    assert (route.from_expr, route.to_expr) == ("robot1/s/**", "edge1/t/robot1/**")
    assert widened("{target}/**/{robot}", target="edge1") == "edge1/*/**"
    assert widened("in{robot}{target}/map") == "in$*/map", "two open names in one chunk are one wildcard"


def test_examples_in_the_module_hold() -> None:
    assert doctest.testmod(made).failed == 0
