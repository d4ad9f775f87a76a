"""ROUTE: slots with every placeholder filled in, plans by phase."""

from __future__ import annotations

import pytest

from zsched.core.fleet import StreamRule, TaskSpec, WorkerSpec
from zsched.core.model import Tuning, Weights
from zsched.core.plan import Direction, HandoverRule, ReadyWhen, RoutePhase, StreamClass, StreamSettings
from zsched.core.route import plan_for, slot_for

SETTINGS = StreamSettings(stream_class=StreamClass.RELIABLE, depth=7, handover=HandoverRule.ALL)
SPEC = TaskSpec(
    name="merge",
    candidates=("edge1", "edge2"),
    tuning=Tuning(weights=Weights(cpu=0.5, memory=0.5, network=0.0)),
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


@pytest.mark.parametrize("phase", RoutePhase)
def test_only_a_closing_plan_drops_the_predecessor(phase: RoutePhase) -> None:
    old, new = slot_for(SPEC, "robot1", "edge1", 1), slot_for(SPEC, "robot1", "edge2", 2)
    plan = plan_for(SPEC, phase, new, old)
    assert (plan.task, plan.phase, plan.current) == ("merge", phase, new)
    assert plan.predecessor == (None if phase is RoutePhase.CLOSE else old)
