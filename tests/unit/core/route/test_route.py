"""ROUTE: slots with every placeholder filled in, plans by phase."""

from __future__ import annotations

from dataclasses import replace

import pytest

from support.fleets import fleet_of, task_of
from zsched.core.route.route import slot_for, watch_for
from zsched.core.values.fleet import Fleet, Standby, StreamRule, TaskSpec, WorkerSpec
from zsched.core.values.plan import (
    Direction,
    HandoverRule,
    ReadyWhen,
    RosGraph,
    StreamClass,
    StreamSettings,
)
from zsched.core.values.relay_protocol import WorkerWatch

SETTINGS = StreamSettings(stream_class=StreamClass.RELIABLE, depth=7, handover=HandoverRule.ALL)
SPEC = task_of(
    worker=WorkerSpec(ready_when=ReadyWhen.MATCHING),
    rules=(
        StreamRule(
            direction=Direction.INPUT,
            from_template="{robot}/map",
            to_template="{target}/{task}/{robot}/map",
            settings=SETTINGS,
        ),
        StreamRule(
            direction=Direction.OUTPUT, from_template="{target}/{task}/{epoch}/all", to_template="{robot}/global"
        ),
    ),
)


def test_slot_holds_every_rule_of_the_task_for_one_robot_owner_and_epoch() -> None:
    slot = slot_for(SPEC, "robot1", "edge2", 7)

    assert (slot.epoch, slot.owner, slot.ready_when) == (7, "edge2", ReadyWhen.MATCHING)
    assert [(route.direction, route.from_expr, route.to_expr) for route in slot.routes] == [
        (Direction.INPUT, "robot1/map", "edge2/merge/robot1/map"),
        (Direction.OUTPUT, "edge2/merge/7/all", "robot1/global"),
    ]
    assert slot.routes[0].settings == SETTINGS


def test_stream_names_outlive_owners_and_epochs() -> None:
    """Counters and kept values hang on the name."""
    one, other = slot_for(SPEC, "robot1", "edge1", 1), slot_for(SPEC, "robot1", "edge2", 2)
    names = [route.stream for route in one.routes]
    assert names == [route.stream for route in other.routes]
    assert len(set(names)) == len(names)
    assert all(name.startswith("merge/") for name in names)


# --- what the relay looks after, whoever owns the task ---------------------------------------------------------------


def fleet(spec: TaskSpec) -> Fleet:
    return fleet_of(spec, of=("edge1", "edge2", "robot1", "robot2"))


def test_a_worker_without_a_token_is_watched_where_it_may_run_over_all_robots() -> None:
    ask = StreamRule(
        direction=Direction.SERVICE, from_template="{robot}/now", to_template="{target}/{task}/{robot}/now"
    )
    wild = StreamRule(direction=Direction.SERVICE, from_template="{robot}/x/*", to_template="{target}/{robot}/x/*")
    spec = replace(SPEC, rules=(*SPEC.rules, ask, wild))
    assert watch_for(fleet(spec), spec, "edge2") == WorkerWatch(
        task="merge",
        inputs=("edge2/merge/*/map",),
        strangers=("Nobody/merge/*/map",),
        services=(("edge2/merge/robot1/now", "edge2/merge/robot2/now"),),
    )
    robot = watch_for(fleet(spec), spec, "robot1")
    assert robot is not None
    assert (robot.inputs, robot.services) == ((), ()), "no candidate"


@pytest.mark.parametrize("ready", ReadyWhen)
def test_a_robot_takes_its_own_inputs_before_there_is_an_owner(ready: ReadyWhen) -> None:
    """What nobody subscribes to is lost without a count."""
    spec = replace(SPEC, worker=WorkerSpec(ready_when=ready))
    taken = {}
    for node in ("robot1", "robot2", "edge1"):
        watch = watch_for(fleet(spec), spec, node)
        taken[node] = () if watch is None else watch.unowned
    of_a_slot = slot_for(spec, "robot1", "edge1", 1).routes[0]
    assert [(one.stream, one.from_expr) for one in taken["robot1"]] == [(of_a_slot.stream, "robot1/map")]
    assert taken["robot1"][0].settings == of_a_slot.settings
    assert [one.from_expr for one in taken["robot2"]] == ["robot2/map"]
    assert taken["edge1"] == ()
    without = replace(spec, rules=spec.rules[1:])
    robot = watch_for(fleet(without), without, "robot1")
    assert robot is None or robot.unowned == ()


@pytest.mark.parametrize("standby", Standby)
def test_robots_announce_a_ros_node_s_inputs_at_every_candidate_that_runs_one(standby: Standby) -> None:
    """A stock node subscribes to what the graph shows: a standby that was shown nothing would never be ready."""
    rules = tuple(replace(rule, settings=replace(SETTINGS, graph=RosGraph.RMW_ZENOH)) for rule in SPEC.rules)
    worker = replace(SPEC.worker, command=("node",), standby=standby)
    spec = replace(SPEC, rules=rules, worker=worker)
    watch = watch_for(fleet(spec), spec, "robot1")
    shown = [] if watch is None else [route.to_expr for route in watch.standbys]
    assert shown == (["edge1/merge/robot1/map", "edge2/merge/robot1/map"] if standby is Standby.WARM else [])
