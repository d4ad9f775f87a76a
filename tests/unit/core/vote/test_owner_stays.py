"""The owner stays and only the terms change: its worker stops and waits for a lease, or needs none any more."""

from __future__ import annotations

from dataclasses import replace

from support.allocations import allocation_of
from support.fleets import task_of, tuning_of
from support.todos import done
from zsched.core.executor.handover import Executor
from zsched.core.values.fleet import OnIsolation, WorkerSpec
from zsched.core.values.instructions import ApplyRoutes, SetRole, StartWorker
from zsched.core.values.plan import Role, WorkerRole

TUNING = tuning_of(cpu=1.0, memory=0.0)
SPEC = task_of("guard", tuning=TUNING, worker=WorkerSpec(command=("work",)))
FIRST = allocation_of(task="guard", tuning=TUNING)


def roles(instructions: tuple[object, ...]) -> list[Role]:
    return [one.role for one in instructions if isinstance(one, SetRole)]


def test_an_owner_s_worker_stops_for_its_first_lease_and_works_without_one_afterwards() -> None:
    owner = Executor(spec=SPEC, me="edge1", has_streams=False)
    (role,) = roles(done(owner.execute, FIRST, 10.0))
    assert (role.role, role.lease_until_s) == (WorkerRole.ACTIVE, None)
    (role,) = roles(done(owner.execute, replace(FIRST, revision=2, leased=True), 11.0))
    assert role.role is WorkerRole.IDLE
    (role,) = roles(done(owner.set_lease, 13.0, 12.0))
    assert (role.role, role.epoch, role.lease_until_s) == (WorkerRole.ACTIVE, 1, 13.0)
    again = done(owner.execute, replace(FIRST, revision=3), 12.5)
    (role,) = roles(again)
    assert (role.role, role.epoch, role.lease_until_s) == (WorkerRole.ACTIVE, 1, None)
    assert StartWorker(task="guard") in again
    assert done(owner.execute, replace(FIRST, revision=4), 13.0) == (), "nothing has changed"


def test_who_does_not_own_it_does_nothing() -> None:
    other = Executor(spec=SPEC, me="edge2", has_streams=False)
    done(other.execute, FIRST, 10.0)
    assert done(other.execute, replace(FIRST, revision=2, leased=True), 11.0) == ()


def test_a_robot_that_works_alone_stops_and_goes_back_when_the_task_is_leased() -> None:
    """What it has begun without a lease would else go on beside the owner's lease."""
    spec = replace(SPEC, candidates=("edge1", "robot1"), on_isolation=OnIsolation.LOCAL)
    robot = Executor(spec=spec, me="robot1", has_streams=True)
    done(robot.execute, FIRST, 10.0)
    (role,) = roles(done(robot.isolate, 10.5))
    assert (role.role, role.lease_until_s) == (WorkerRole.ACTIVE, None)
    back = done(robot.execute, replace(FIRST, revision=2, leased=True), 11.0)
    (role,) = roles(back)
    assert role.role is WorkerRole.IDLE
    (plan,) = [one.plan for one in back if isinstance(one, ApplyRoutes)]
    assert plan.current is not None
    assert plan.current.owner == "edge1"
    assert done(robot.isolate, 11.5) == (), "from now on it needs a lease, and alone it gets none"
