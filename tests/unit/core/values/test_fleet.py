from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from support.fleets import tuning_of
from zsched.core.values.fleet import (
    TUNED_LINKS,
    TUNED_RULES,
    Fleet,
    LinkSpec,
    NodeSpec,
    StreamRule,
    TaskSpec,
    Timing,
    electorate_hash,
    fleet_hash,
)
from zsched.core.values.model import NodeKind, Reach
from zsched.core.values.plan import Direction
from zsched.core.values.profile import LinkSource

TUNING = tuning_of()
TASK = TaskSpec(
    name="merge",
    candidates=("edge1", "edge2"),
    tuning=TUNING,
    rules=(StreamRule(direction=Direction.INPUT, from_template="{robot}/map", to_template="{target}/{robot}/map"),),
)
FLEET = Fleet(
    name="lab",
    timing=Timing(),
    nodes=(
        NodeSpec(name="edge1", kind=NodeKind.EDGE, host="192.0.2.11", labels=(("gpu", "no"),)),
        NodeSpec(name="edge2", kind=NodeKind.EDGE),
        NodeSpec(name="robot1", kind=NodeKind.ROBOT, links=(LinkSpec(source=LinkSource.TRACE, value="/a/drive.csv"),)),
        NodeSpec(name="robot2", kind=NodeKind.ROBOT),
    ),
    tasks=(TASK,),
    electors=("robot1", "robot2"),
    zenoh_config="/etc/zsched/zenoh.json5",
)


@pytest.mark.parametrize(("ballot_s", "order_s"), [(0.01, 3.0), (0.3, 4.2), (1.0, 14.0), (3600.0, 60.0)])
def test_an_order_is_waited_for_by_the_fleet_s_timing_within_bounds(ballot_s: float, order_s: float) -> None:
    assert Timing(ballot_s=ballot_s).order_s == pytest.approx(order_s)


def test_node_and_task_are_found_by_name_or_raise() -> None:
    assert FLEET.node("edge2").kind is NodeKind.EDGE
    assert FLEET.task("merge") is TASK
    with pytest.raises(KeyError):
        FLEET.node("edge9")
    with pytest.raises(KeyError):
        FLEET.task("other")


def test_fleet_hash_ignores_where_the_files_lie() -> None:
    robot = replace(FLEET.nodes[2], links=(LinkSpec(source=LinkSource.TRACE, value="/else/where/drive.csv"),))
    moved = replace(FLEET, nodes=(*FLEET.nodes[:2], robot, FLEET.nodes[3]), zenoh_config="zenoh.json5")

    assert fleet_hash(moved) == fleet_hash(FLEET)
    assert len(fleet_hash(FLEET)) == 16
    assert int(fleet_hash(FLEET), 16) > 0


def test_fleet_hash_takes_two_and_two_point_zero_for_one_setting() -> None:
    """YAML gives an int where an operator writes 2."""
    whole = replace(FLEET, tasks=(replace(TASK, drain_s=2),))

    assert fleet_hash(whole) == fleet_hash(FLEET)


def test_electorate_hash_depends_on_fleet_and_electors_only() -> None:
    base = electorate_hash(FLEET)

    assert electorate_hash(replace(FLEET, tasks=(), seeds=("edge1",))) == base
    assert electorate_hash(replace(FLEET, name="lab2")) != base
    assert electorate_hash(replace(FLEET, electors=("robot1",))) != base
    assert electorate_hash(replace(FLEET, electors=("robot1robot2",))) != base


# --- tuned by operators ----------------------------------------------------------------------------------------------

OWN: dict[str, Any] = {
    "price_s": 0.7,
    "reach": Reach.ALL,
    "nu_dbm": -70.0,
    "rho_dbm": -30.0,
}


def test_a_tuning_sets_what_it_names_and_leaves_the_rest_to_the_file() -> None:
    assert set(OWN) == {*TUNED_RULES, *TUNED_LINKS}
    assert TASK.under(TUNING) == TASK
    for key, value in OWN.items():
        tuned = replace(TUNING, **{key: value})
        nothing: dict[str, Any] = {key: None}
        told, file = TASK.in_force(tuned), TASK.in_force(TUNING)
        assert getattr(told, key) == value != getattr(file, key)
        assert replace(told, **nothing) == replace(file, **nothing)
        spec = TASK.under(tuned)
        assert getattr(spec if key in TUNED_RULES else spec.limits, key) == value


def test_ranges_are_those_of_the_file_and_a_signal_that_does_not_fit_the_file_is_left_out() -> None:
    wrong: dict[str, Any] = {"price_s": -1.0, "nu_dbm": 1.0}
    for key, value in wrong.items():
        with pytest.raises(ValueError, match=key):
            replace(TUNING, **{key: value})
    for crossed in (replace(TUNING, nu_dbm=-30.0), replace(TUNING, nu_dbm=-50.0, rho_dbm=-50.0)):
        limits = TASK.under(crossed).limits
        assert (limits.nu_dbm, limits.rho_dbm) == (-80.0, -40.0)
