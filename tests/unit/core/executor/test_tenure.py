"""Who works alone, and when to look again (leases: tests/sim/test_lease_rules.py)."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from support.allocations import allocation_of
from support.beats import beat_of
from support.fleets import fleet_of, task_of
from support.todos import done
from zsched.core.executor.handover import Executor
from zsched.core.executor.tenure import ALONE_AFTER_S, Tenure
from zsched.core.membership.peers import Membership
from zsched.core.values.fleet import Fleet, OnIsolation
from zsched.core.values.in_force import InForce
from zsched.core.values.model import NodeId
from zsched.core.values.plan import WorkerRole
from zsched.core.values.todo import ToDo
from zsched.core.vote.lease import Leases

LOCAL = fleet_of(task_of(on_isolation=OnIsolation.LOCAL))
HOLD = fleet_of(task_of(on_isolation=OnIsolation.HOLD))
ENDS_AT = 10.0 + ALONE_AFTER_S


def tenure_of(me: NodeId, *, leased: bool = False, owner: str | None = "edge1", fleet: Fleet = LOCAL) -> Tenure:
    """Of a node that knows the task's owner since 9 s and has heard nobody."""
    (task,) = fleet.tasks
    executor = Executor(spec=task, me=me, has_streams=me.startswith("r"))
    done(executor.execute, replace(allocation_of(1, owner), leased=leased), 9.0)
    leases = Leases(in_force=InForce(fleet), me=me, incarnation=1, standing={}, now=0.0)
    return Tenure(in_force=leases.in_force, me=me, leases=leases, executors={"merge": executor})


def silence(fleet: Fleet = LOCAL, me: NodeId = "robot1") -> Membership:
    return Membership(me, InForce(fleet))


def is_alone(tenure: Tenure) -> bool:
    return tenure.executors["merge"].is_local


def test_a_robot_that_hears_nobody_works_alone_when_its_time_has_come() -> None:
    tenure, membership = tenure_of("robot1"), silence()
    tenure.tend_isolation(membership, ToDo(), 10.0)
    assert tenure.next_deadline(10.0) == ENDS_AT
    tenure.tend_isolation(membership, ToDo(), ENDS_AT - 0.001)
    assert not is_alone(tenure)
    tenure.tend_isolation(membership, ToDo(), ENDS_AT)
    assert is_alone(tenure)
    assert tenure.next_deadline(ENDS_AT) == math.inf
    membership.absorb_beat(beat_of("edge1", 1), 11.0)
    tenure.tend_isolation(membership, ToDo(), 11.0)
    assert not is_alone(tenure)
    assert tenure.next_deadline(11.0) == math.inf


def test_the_only_robot_works_alone_when_it_hears_neither_the_owner_nor_most_electors() -> None:
    """It was its own majority, and waited for an owner that nobody could replace."""
    fleet = fleet_of(*LOCAL.tasks, of=("edge1", "edge2", "robot1"), electors=("edge1", "edge2", "robot1"))
    tenure, membership = tenure_of("robot1", fleet=fleet), silence(fleet)
    tenure.tend_isolation(membership, ToDo(), 10.0)
    tenure.tend_isolation(membership, ToDo(), ENDS_AT)
    assert is_alone(tenure)
    membership.absorb_beat(beat_of("edge2", 1), 11.0)
    tenure.tend_isolation(membership, ToDo(), 11.0)
    assert not is_alone(tenure), "with another elector it can move the task"


@pytest.mark.parametrize("late_s", [0.0, 100.0])
@pytest.mark.parametrize(
    ("me", "leased", "owner"),
    [("edge2", False, "edge1"), ("robot1", True, "edge1"), ("robot1", False, None)],
    ids=["an edge has no streams", "nobody works without a lease", "nobody has the task"],
)
def test_who_may_not_work_alone_waits_for_nothing(me: NodeId, leased: bool, owner: str | None, late_s: float) -> None:
    """Its loop would spin: what is due would stay due."""
    tenure, membership = tenure_of(me, leased=leased, owner=owner), silence(me=me)
    tenure.tend_isolation(membership, ToDo(), 10.0)
    now = ENDS_AT + late_s
    tenure.tend_isolation(membership, ToDo(), now)
    assert not is_alone(tenure)
    assert tenure.next_deadline(now) == math.inf


def test_what_was_counted_before_the_file_forbade_it_does_not_count_when_it_allows_it_again() -> None:
    tenure, membership = tenure_of("robot1"), silence()
    tenure.tend_isolation(membership, ToDo(), 10.0)
    tenure.in_force.take(HOLD)
    tenure.tend_isolation(membership, ToDo(), 10.05)
    assert tenure.next_deadline(10.1) == math.inf
    tenure.in_force.take(LOCAL)
    assert tenure.next_deadline(10.1) == math.inf
    tenure.tend_isolation(membership, ToDo(), 20.0)
    assert tenure.next_deadline(20.0) == 20.0 + ALONE_AFTER_S
    tenure.tend_isolation(membership, ToDo(), 20.0 + ALONE_AFTER_S - 0.001)
    assert not is_alone(tenure)


def test_in_doubt_of_its_clock_a_node_tells_no_worker_to_leave_that_it_holds_no_lease_for() -> None:
    """It owns nothing exclusive: what worked here before the task became exclusive ends with its drain."""
    tenure = tenure_of("edge1")
    executor = tenure.executors["merge"]
    done(executor.execute, allocation_of(2, "edge2"), 10.0)
    taken = allocation_of(3, "edge2", epoch=2, leased=True)
    done(executor.execute, taken, 10.0)
    tenure.hold(taken, next_number=1)
    tenure.leases.doubt({})
    assert tenure.exclusive == ("merge",)
    assert executor.role.role is WorkerRole.DRAINING
    todo = ToDo()
    tenure.tend_leases(1, todo, 10.1)
    assert not todo.apply
    assert executor.role.role is WorkerRole.DRAINING


def test_a_generation_that_begins_gives_nothing_back_for_a_worker_that_still_works() -> None:
    """Electors of the one before would let another owner work beside it, as long as its lease lasts."""
    tenure = tenure_of("edge1", leased=True)
    owned, begins = allocation_of(1, "edge1", leased=True), allocation_of(1 << 32, None, leased=True)
    tenure.hold(owned, next_number=1)
    assert tenure.leases.on_sent(1, 10.0).released == ()
    executor = tenure.executors["merge"]
    done(executor.execute, begins, 10.1)
    tenure.hold(begins, next_number=2)
    assert tenure.leases.on_sent(2, 10.1).released == ()
    assert executor.role.role is WorkerRole.ACTIVE
    taken = allocation_of((1 << 32) + 1, "edge2", leased=True)
    done(executor.execute, taken, 10.2)
    tenure.hold(taken, next_number=3)
    assert [grant.number for grant in tenure.leases.on_sent(3, 10.2).released] == [2]
