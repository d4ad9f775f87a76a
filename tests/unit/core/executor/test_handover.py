"""EXECUTOR: the handover's table line by line, what is not in it, and the worker's role."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import pytest

from support.allocations import allocation_of
from support.fleets import task_of
from support.todos import done
from zsched.core.executor.handover import BEGUN_S, HEARS_S, LEAVES_S, MAX_OLD, ROLE_DRAIN_MARGIN_S, Executor, Phase
from zsched.core.values.fleet import OnIsolation, Standby, StreamRule, TaskSpec, WorkerSpec
from zsched.core.values.instructions import ApplyRoutes, Instruction, RecordStory, SetRole, StartWorker, StopWorker
from zsched.core.values.model import Allocation
from zsched.core.values.plan import Direction, DrainingSlot, RoutePlan, WorkerRole
from zsched.core.values.todo import ToDo

T = TypeVar("T")
SPEC = task_of(
    candidates=("edge1", "edge2", "edge3"),
    drain_s=2.0,
    worker=WorkerSpec(command=("merge",), start_deadline_s=20.0),
    rules=(
        StreamRule(direction=Direction.INPUT, from_template="{robot}/map", to_template="{target}/merge/{robot}/map"),
    ),
)
COLD = replace(SPEC, worker=replace(SPEC.worker, standby=Standby.COLD))
FOREIGN = replace(SPEC, worker=WorkerSpec())


def robot() -> Executor:
    return Executor(spec=SPEC, me="robot1", has_streams=True)


def edge(name: str = "edge1", spec: TaskSpec = SPEC) -> Executor:
    return Executor(spec=spec, me=name, has_streams=False)


def plan(out: tuple[Instruction, ...]) -> tuple[str | int | None, ...] | None:
    """(phase, epoch, the predecessors' epochs or ``None``) of the one plan in a batch, or ``None``."""
    plans = [one.plan for one in out if isinstance(one, ApplyRoutes)]
    assert len(plans) <= 1
    return short(plans[0]) if plans else None


def short(plan: RoutePlan) -> tuple[str | int | None, ...]:
    assert plan.current is not None
    epochs: list[int | None] = [slot.epoch for slot in plan.predecessors] or [None]
    return plan.phase.value, plan.current.epoch, *epochs


def roles(out: tuple[Instruction, ...]) -> list[tuple[WorkerRole, int]]:
    return [(one.role.role, one.role.epoch) for one in out if isinstance(one, SetRole)]


def of(out: tuple[Instruction, ...], kind: type[T]) -> list[T]:
    return [one for one in out if isinstance(one, kind)]


def at(phase: Phase) -> Executor:
    """A robot's executor in a phase of its second handover: edge1 (epoch 1) to edge2 (epoch 2), at 10 s."""
    one = robot()
    done(one.execute, allocation_of(1, "edge1"), 0.0)
    done(one.on_ready, 1)
    done(one.on_flipped, 1, 0, 0.0)
    if phase is Phase.SETTLED:
        return one
    done(one.execute, allocation_of(2, "edge2"), 10.0)
    if phase is Phase.PREPARING:
        return one
    done(one.on_ready, 2)
    if phase is Phase.FLIPPING:
        return one
    done(one.on_flipped, 2, 3, 10.0)
    assert one.phase is Phase.DRAINING
    return one


# --- the table, line by line -----------------------------------------------------------------------------------------


def test_move_goes_through_every_phase_and_keeps_the_old_slot_until_it_is_drained() -> None:
    one = at(Phase.SETTLED)
    assert plan(done(one.execute, allocation_of(2, "edge2"), 1.0)) == ("prepare", 2, 1)
    assert plan(done(one.on_ready, 2)) == ("flip", 2, 1)
    assert plan(done(one.on_flipped, 2, 1, 1.1)) is None, "the flip's plan stands while the old slot drains"
    assert (one.phase, one.predecessors) == (Phase.DRAINING, ("edge1",))
    assert plan(done(one.on_drained, 1)) == ("close", 2, None)
    assert (one.phase, one.predecessors) == (Phase.SETTLED, ())


def began_again(left: DrainingSlot) -> tuple[Executor, tuple[Instruction, ...]]:
    """A daemon that restarted during the move to edge2, whose relay still has ``left``; and what it does at 10 s."""
    one = robot()
    assert plan(done(one.execute, allocation_of(2, "edge2"), 9.0)) == ("prepare", 2, None)
    assert plan(done(one.on_ready, 2)) == ("flip", 2, None)
    return one, flipped(one, left)


def flipped(one: Executor, left: DrainingSlot) -> tuple[Instruction, ...]:
    todo = ToDo()
    one.on_flipped(2, 0, todo, 10.0, (left,))
    return tuple(todo.apply)


def test_a_slot_that_drains_goes_on_to_when_the_daemon_restarts() -> None:
    one, out = began_again(DrainingSlot(epoch=1, owner="edge1", since_s=0.5))
    assert plan(out) is None
    assert (one.phase, one.predecessors, one.next_deadline()) == (Phase.DRAINING, ("edge1",), 11.5)
    assert plan(done(one.on_drained, 1)) == ("close", 2, None)
    late, _ = began_again(DrainingSlot(epoch=1, owner="edge1", since_s=0.5))
    assert plan(done(late.tick, 11.4)) is None
    assert plan(done(late.tick, 11.5)) == ("close", 2, None), "its drain time began before the restart"


def test_what_this_daemon_has_dropped_does_not_come_back() -> None:
    one = at(Phase.FLIPPING)
    assert plan(done(one.on_gone, "edge1")) == ("flip", 2, None)
    left = DrainingSlot(epoch=1, owner="edge1")
    assert plan(flipped(one, left)) == ("close", 2, None)


def test_drain_time_closes_the_old_slot() -> None:
    one = at(Phase.DRAINING)
    assert one.next_deadline() == 12.0
    assert done(one.tick, 11.99) == ()
    assert plan(done(one.tick, 12.0)) == ("close", 2, None)
    assert (one.phase, one.next_deadline()) == (Phase.SETTLED, math.inf)


@pytest.mark.parametrize(
    ("phase", "expected", "after"),
    [
        (Phase.PREPARING, ("prepare", 2, None), Phase.PREPARING),
        (Phase.FLIPPING, ("flip", 2, None), Phase.FLIPPING),
        (Phase.DRAINING, ("close", 2, None), Phase.SETTLED),
        (Phase.SETTLED, None, Phase.SETTLED),
    ],
)
def test_gone_predecessor_leaves_the_plan_in_every_phase(
    phase: Phase, expected: tuple[str | int | None, ...] | None, after: Phase
) -> None:
    one = at(phase)
    assert plan(done(one.on_gone, "edge1")) == expected
    assert (one.phase, one.predecessors) == (after, ())


@pytest.mark.parametrize(
    ("phase", "expected", "deadline"),
    [
        (Phase.PREPARING, ("prepare", 3, 1), math.inf),  # edge2 was never flipped to
        (Phase.FLIPPING, ("prepare", 3, 1, 2), math.inf),
        (Phase.DRAINING, ("prepare", 3, 1, 2), 12.0),
        (Phase.SETTLED, ("prepare", 3, 1), math.inf),
    ],
)
def test_newer_epoch_in_any_phase_prepares_and_keeps_the_slots_that_carry_or_drain(
    phase: Phase, expected: tuple[str, int, int], deadline: float
) -> None:
    one = at(phase)
    assert plan(done(one.execute, allocation_of(3, "edge3"), 11.0)) == expected
    assert one.phase is Phase.PREPARING
    assert one.next_deadline() == deadline


def moved_twice() -> Executor:
    """Epoch 1 (edge1) drains since 10 s, epoch 2 (edge2) carries, epoch 3 (edge1) is prepared at 11 s."""
    one = at(Phase.DRAINING)
    done(one.execute, allocation_of(3, "edge1"), 11.0)
    return one


def test_a_slot_that_drains_goes_on_to_when_the_task_moves_again() -> None:
    one = moved_twice()
    assert plan(done(one.on_ready, 3)) == ("flip", 3, 1, 2)
    assert plan(done(one.on_flipped, 3, 0, 11.5)) is None
    assert plan(done(one.on_drained, 1)) is None, "the other one still drains"
    assert one.phase is Phase.DRAINING
    assert one.predecessors == ("edge2",)
    assert one.next_deadline() == 13.5
    assert plan(done(one.on_drained, 2)) == ("close", 3, None)


def test_a_slot_that_has_drained_is_not_in_the_next_plan() -> None:
    one = moved_twice()
    assert plan(done(one.on_drained, 1)) is None
    assert done(one.on_drained, 2) == (), "it still carries"
    assert plan(done(one.on_ready, 3)) == ("flip", 3, 2)


@pytest.mark.parametrize("steps", [0, 1, 2], ids=["preparing", "flipping", "draining"])
def test_each_slot_has_its_own_drain_time(steps: int) -> None:
    one = moved_twice()
    if steps:
        done(one.on_ready, 3)
    if steps == 2:
        done(one.on_flipped, 3, 0, 11.5)
    assert plan(done(one.tick, 11.99)) is None
    assert plan(done(one.tick, 12.0)) == ("flip" if steps else "prepare", 3, 2)
    assert plan(done(one.tick, 13.5)) == (("close", 3, None) if steps == 2 else None), "what carries has none"


def test_every_slot_of_an_owner_that_is_gone_is_dropped() -> None:
    one = moved_twice()
    assert plan(done(one.on_gone, "edge1")) == ("prepare", 3, 2)
    two = moved_twice()
    assert plan(done(two.on_gone, "edge2")) == ("prepare", 3, 1)
    assert plan(done(two.on_ready, 3)) == ("flip", 3, 1)
    done(two.on_flipped, 3, 0, 11.5)
    assert two.next_deadline() == 12.0, "the older one's time goes on"
    assert plan(done(two.on_gone, "edge1")) == ("close", 3, None)


def test_only_so_many_slots_drain_at_once() -> None:
    one = at(Phase.SETTLED)
    for epoch in range(2, 9):
        done(one.execute, allocation_of(epoch, f"edge{1 + epoch % 2}"), 0.0)
        done(one.on_ready, epoch)
        assert plan(done(one.on_flipped, epoch, 0, 0.0)) is None
    assert plan(done(one.execute, allocation_of(9, "edge2"), 0.0)) == ("prepare", 9, *range(9 - MAX_OLD, 9))


def test_there_and_back_ends_on_the_first_owner_with_its_own_old_slot_to_drain() -> None:
    """A -> B -> A before B was ready: the old slot of A stays open beside A's new one."""
    one = at(Phase.PREPARING)
    assert plan(done(one.execute, allocation_of(3, "edge1"), 11.0)) == ("prepare", 3, 1)
    assert (one.predecessors, one.owner) == (("edge1",), "edge1")
    assert plan(done(one.on_ready, 3)) == ("flip", 3, 1)
    done(one.on_flipped, 3, 0, 11.1)
    assert plan(done(one.on_drained, 1)) == ("close", 3, None)


# --- what is not in the table ----------------------------------------------------------------------------------------

EVENTS: dict[str, Callable[[Executor, int], tuple[Instruction, ...]]] = {
    "ready": lambda one, epoch: done(one.on_ready, epoch),
    "flipped": lambda one, epoch: done(one.on_flipped, epoch, 0, 10.5),
    "drained": lambda one, epoch: done(one.on_drained, epoch),
}
LEGAL = {("ready", Phase.PREPARING, 2), ("flipped", Phase.FLIPPING, 2), ("drained", Phase.DRAINING, 1)}


@pytest.mark.parametrize("phase", [Phase.PREPARING, Phase.FLIPPING, Phase.DRAINING, Phase.SETTLED])
@pytest.mark.parametrize("name", EVENTS)
@pytest.mark.parametrize("epoch", [0, 1, 2, 3])
def test_every_other_report_is_ignored(name: str, phase: Phase, epoch: int) -> None:
    one, twin = at(phase), at(phase)
    out = EVENTS[name](one, epoch)
    if (name, phase, epoch) in LEGAL:
        assert out != ()
    else:
        assert out == ()
        assert one == twin


@pytest.mark.parametrize("late", [allocation_of(1, "edge3"), allocation_of(2, "edge3"), allocation_of(3, None)])
def test_older_equal_and_empty_allocations_are_not_carried_out(late: Allocation) -> None:
    one = at(Phase.DRAINING)
    assert done(one.execute, late, 11.0) == ()
    assert one.phase is Phase.DRAINING


@pytest.mark.parametrize(
    ("phase", "expected"),
    [
        (Phase.PREPARING, ("prepare", 2, 1)),
        (Phase.FLIPPING, ("flip", 2, 1)),
        (Phase.DRAINING, ("flip", 2, 1)),
        (Phase.SETTLED, ("close", 1, None)),
    ],
)
def test_a_changed_file_gives_the_plan_that_stands_with_its_streams(
    phase: Phase, expected: tuple[str, int, int | None]
) -> None:
    one = at(phase)
    later = replace(SPEC, rules=(replace(SPEC.rules[0], from_template="{robot}/scan"),))
    assert plan(tuple(adopted(one, later))) == expected
    assert one.phase is phase


def test_every_step_says_what_it_did() -> None:
    one = at(Phase.SETTLED)
    steps = (
        done(one.execute, allocation_of(2, "edge2"), 10.0),
        done(one.on_ready, 2),
        done(one.on_flipped, 2, 7, 10.25),
        done(one.on_drained, 1),
    )
    told = [story.text for out in steps for story in of(out, RecordStory)]
    assert told == [
        "prepares edge2",
        "flips to edge2",
        "flipped to edge2 in 250 ms, 7 kept values replayed; edge1 drains",
        "settled on edge2: edge1 drained",
    ]
    assert {(story.task, story.epoch) for out in steps for story in of(out, RecordStory)} == {("merge", 2)}


def test_a_way_out_of_a_cut_and_back_is_timed_from_its_own_beginning_and_is_no_move() -> None:
    """A day later: `zsched history` and the trace took a day for what the move to edge1 had cost."""
    one = Executor(spec=replace(SPEC, on_isolation=OnIsolation.LOCAL), me="robot1", has_streams=True)
    done(one.execute, allocation_of(1, "edge1"), 0.0)
    done(one.on_ready, 1)
    told = [*of(done(one.on_flipped, 1, 0, 0.25), RecordStory)]
    for start, way in ((86400.0, one.isolate), (90000.0, one.rejoin)):
        told += of(done(way, start), RecordStory)
        assert one.started_at == start
        told += of(done(one.on_ready, 1), RecordStory)
        told += of(done(one.on_flipped, 1, 0, start + 0.5), RecordStory)
    assert [story.text for story in told] == [
        "flipped to edge1 in 250 ms, 0 kept values replayed",
        "cut off from edge1: works alone (degraded)",
        "flips to robot1",
        "flipped to robot1 in 500 ms, 0 kept values replayed",
        "back to edge1",
        "flips to edge1",
        "flipped to edge1 in 500 ms, 0 kept values replayed",
    ]
    assert [story.took_s for story in told if story.took_s is not None] == [0.25]
    assert one.switched_s == 0.25
    done(one.execute, allocation_of(2, "edge2"), 91000.0)
    done(one.on_ready, 2)
    assert of(done(one.on_flipped, 2, 0, 91000.125), RecordStory)[0].took_s == one.switched_s == 0.125


# --- the worker ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("one", "expected"),
    [
        (edge(), (StartWorker(task="merge"),)),
        (edge(spec=COLD), ()),
        (edge(spec=FOREIGN), ()),
        (edge("edge9"), ()),
        (robot(), ()),
    ],
    ids=["warm", "cold", "foreign", "no candidate", "robot"],
)
def test_only_warm_candidates_with_a_command_start_their_worker_at_once(
    one: Executor, expected: tuple[Instruction, ...]
) -> None:
    assert done(one.start) == expected


def test_role_goes_from_idle_over_active_and_draining_to_idle() -> None:
    one = edge()
    assert one.role.role is WorkerRole.IDLE
    assert roles(done(one.execute, allocation_of(1, "edge1"), 0.0)) == [(WorkerRole.ACTIVE, 1)]
    assert roles(done(one.execute, allocation_of(2, "edge2"), 10.0)) == [(WorkerRole.DRAINING, 1)]
    assert one.next_deadline() == 10.0 + SPEC.drain_s + ROLE_DRAIN_MARGIN_S
    out = done(one.tick, one.next_deadline())
    assert roles(out) == [(WorkerRole.IDLE, 0)]
    assert not of(out, StopWorker), "a warm standby keeps running"
    assert one.next_deadline() == math.inf


def test_owner_that_is_chosen_again_while_it_drains_stays_active() -> None:
    one = edge()
    done(one.execute, allocation_of(1, "edge1"), 0.0)
    done(one.execute, allocation_of(2, "edge2"), 1.0)
    assert roles(done(one.execute, allocation_of(3, "edge1"), 1.5)) == [(WorkerRole.ACTIVE, 3)]
    assert one.next_deadline() == math.inf
    assert done(one.tick, 100.0) == ()


def test_cold_standby_is_started_by_its_allocation_and_stopped_after_its_drain() -> None:
    one = edge(spec=COLD)
    assert of(done(one.execute, allocation_of(1, "edge1"), 0.0), StartWorker)
    assert not of(done(one.execute, allocation_of(2, "edge2"), 10.0), StopWorker)
    out = done(one.tick, one.next_deadline())
    assert out[-1] == StopWorker(task="merge")
    assert roles(out) == [(WorkerRole.IDLE, 0)]


def test_cold_standbys_old_owner_works_until_the_new_one_can_have_started() -> None:
    """Make before break: the robots stay with the old owner while the new one's worker starts."""
    one = edge(spec=COLD)
    done(one.execute, allocation_of(1, "edge1"), 0.0)
    done(one.execute, allocation_of(2, "edge2"), 10.0)
    assert done(one.tick, 10.0 + COLD.worker.start_deadline_s + COLD.drain_s) == ()
    assert one.role.role is WorkerRole.DRAINING


def cold_that_left() -> Executor:
    """Of an exclusive task: it stopped before the commit of edge2 (epoch 2, at 10 s), as the electors asked."""
    one = edge(spec=replace(COLD, exclusive=True))
    done(one.execute, replace(allocation_of(1, "edge1"), leased=True), 0.0)
    done(one.set_lease, 12.0, 9.0)
    done(one.leave)
    assert not of(done(one.execute, replace(allocation_of(2, "edge2"), leased=True), 10.0), StopWorker)
    return one


@pytest.mark.parametrize("has_left", [True, False], ids=["asked before", "hears of it late"])
def test_a_cold_worker_that_left_at_once_is_stopped_when_the_next_one_can_have_asked_for_its_state(
    has_left: bool,
) -> None:
    one = cold_that_left()
    if not has_left:
        one = edge(spec=replace(COLD, exclusive=True))
        done(one.execute, replace(allocation_of(1, "edge1"), leased=True), 0.0)
        done(one.set_lease, 12.0, 9.0)
        done(one.execute, replace(allocation_of(2, "edge2"), leased=True), 10.0)
    assert one.role.role is WorkerRole.IDLE
    ends_at = 10.0 + COLD.worker.start_deadline_s + COLD.drain_s + ROLE_DRAIN_MARGIN_S
    assert one.next_deadline() == ends_at
    assert done(one.tick, ends_at)[-1] == StopWorker(task="merge")
    assert one.next_deadline() == math.inf


def test_a_cold_worker_that_left_runs_on_when_it_is_chosen_again_or_the_task_moves_between_others() -> None:
    again, others = cold_that_left(), cold_that_left()
    assert not of(done(again.execute, replace(allocation_of(3, "edge1"), leased=True), 11.0), StopWorker)
    assert again.next_deadline() == math.inf
    ends_at = others.next_deadline()
    done(others.execute, replace(allocation_of(3, "edge3"), leased=True), 11.0)
    assert others.next_deadline() == ends_at


def test_a_cold_owner_that_had_to_leave_and_stays_the_owner_keeps_its_process() -> None:
    """Its clock is in doubt, or it works again with its next lease."""
    one = edge(spec=replace(COLD, exclusive=True))
    done(one.execute, replace(allocation_of(1, "edge1"), leased=True), 0.0)
    done(one.set_lease, 12.0, 9.0)
    assert not of(done(one.leave), StopWorker)
    assert one.next_deadline() == math.inf


@pytest.mark.parametrize("standby", Standby)
def test_who_works_alone_with_a_cold_worker_stops_it_behind_that(standby: Standby) -> None:
    spec = replace(SPEC, on_isolation=OnIsolation.LOCAL, worker=replace(SPEC.worker, standby=standby))
    spec = replace(spec, candidates=(*SPEC.candidates, "robot1"))
    for way in ("rejoin", "another", "itself"):
        one = Executor(spec=spec, me="robot1", has_streams=True)
        done(one.execute, allocation_of(1, "edge1"), 0.0)
        done(one.isolate, 5.0)
        if way == "rejoin":
            out = done(one.rejoin, 10.0)
        else:
            out = done(one.execute, allocation_of(2, "edge2" if way == "another" else "robot1"), 10.0)
        out += done(one.tick, 10.0) if one.next_deadline() <= 10.0 else ()
        is_over = standby is Standby.COLD and way != "itself"
        assert of(out, StopWorker) == ([StopWorker(task="merge")] if is_over else [])
        assert one.next_deadline() == math.inf


def test_foreign_worker_is_told_its_role_and_never_started() -> None:
    one = edge(spec=FOREIGN)
    out = done(one.execute, allocation_of(1, "edge1"), 0.0)
    assert roles(out) == [(WorkerRole.ACTIVE, 1)]
    assert not of(out, StartWorker)


def test_an_owner_that_went_stays_gone_whoever_goes_next() -> None:
    """Its worker's state is not asked for by the next owner."""
    for gone in ((), ("edge1",), ("edge1", "edge3"), ("edge3",)):
        one = edge("edge2")
        done(one.execute, allocation_of(1, "edge1"), 0.0)
        for node in gone:
            done(one.on_gone, node)
        (told,) = [out.role for out in done(one.execute, allocation_of(2, "edge2"), 1.0) if isinstance(out, SetRole)]
        assert told.predecessor == (None if "edge1" in gone else "edge1")


# --- who may be working without a lease ------------------------------------------------------------------------------


def test_a_worker_may_work_without_a_lease_until_it_has_said_that_it_has_stopped() -> None:
    one = edge()
    assert not one.may_work_unleased(0.0)
    done(one.execute, allocation_of(1, "edge1"), 0.0)
    done(one.on_role_ended, 1)
    assert one.may_work_unleased(0.0), "nobody told it to stop"
    done(one.execute, replace(allocation_of(1, "edge1"), leased=True), 1.0)
    assert one.role.role is WorkerRole.IDLE
    assert one.may_work_unleased(100.0), "it has not said that it has"
    done(one.on_role_ended, 0)
    assert one.may_work_unleased(100.0), "that was of another epoch"
    done(one.on_role_ended, 1)
    assert not one.may_work_unleased(100.0)


def test_a_worker_whose_process_ended_works_no_more_unless_the_next_one_may() -> None:
    one = edge()
    done(one.execute, allocation_of(1, "edge1"), 0.0)
    one.on_worker_ended(ToDo(), 0.0)
    assert one.may_work_unleased(0.0), "the next process may work at once"
    done(one.execute, replace(allocation_of(1, "edge1"), leased=True), 1.0)
    one.on_worker_ended(ToDo(), 1.0)
    assert not one.may_work_unleased(1.0)


@pytest.mark.parametrize(
    ("was_ready", "at", "asks"), [(True, 1.0 + BEGUN_S, False), (True, 0.9 + BEGUN_S, True), (False, 90.0, True)]
)
def test_the_next_process_does_not_get_the_state_that_the_one_before_began_with(
    was_ready: bool, at: float, asks: bool
) -> None:
    """While no relay runs nobody tells that it had worked: what it did since would be undone by the older state."""
    one = edge()
    done(one.execute, allocation_of(1, "edge2"), 0.0)
    done(one.execute, allocation_of(2, "edge1"), 1.0)
    assert one.role.predecessor == "edge2"
    todo = ToDo()
    one.on_worker_ended(todo, at, was_ready=was_ready)
    assert (one.role.role, one.role.predecessor == "edge2") == (WorkerRole.ACTIVE, asks)
    assert bool(todo.apply) is not asks


def test_a_worker_that_is_ready_only_when_it_was_told_to_stop_has_nothing_to_confirm() -> None:
    """It has shown no epoch, so it never says that it has left one."""
    one = edge()
    done(one.execute, allocation_of(1, "edge1"), 0.0)
    one.on_worker_ready(0.0)
    assert one.may_work_unleased(0.0), "ready, and the owner's"
    done(one.execute, replace(allocation_of(1, "edge1"), leased=True), 1.0)
    assert one.may_work_unleased(1.0)
    one.on_worker_ready(2.0)
    assert one.may_work_unleased(2.0 + 0.9 * LEAVES_S), "it may have begun by what it was told before"
    assert not one.may_work_unleased(2.0 + LEAVES_S)


def test_an_owner_that_was_chosen_again_before_its_worker_has_confirmed_hears_it_then() -> None:
    one = edge()
    done(one.execute, allocation_of(1, "edge1"), 0.0)
    done(one.execute, replace(allocation_of(3, "edge1"), leased=True), 1.0)
    assert one.role.role is WorkerRole.ACTIVE
    assert one.may_work_unleased(1.0)
    done(one.on_role_ended, 1)
    assert not one.may_work_unleased(1.0)


def test_an_end_that_was_told_to_a_relay_that_died_is_not_waited_for_for_ever() -> None:
    """The worker says it once: its node never seemed to be free of work without a lease."""
    one = edge()
    done(one.execute, allocation_of(1, "edge1"), 0.0)
    one.on_worker_seen(0.5)
    assert one.may_work_unleased(0.5 + HEARS_S), "it works"
    done(one.execute, replace(allocation_of(1, "edge1"), leased=True), 1.0)
    assert one.may_work_unleased(100.0), "it has not said that it does not, to the relay that has told it"
    one.on_worker_seen(100.0)
    assert one.may_work_unleased(100.0 + HEARS_S - 0.1), "it may hear it only now"
    assert not one.may_work_unleased(100.0 + HEARS_S)


def test_a_worker_that_drains_while_its_relay_dies_is_waited_for_until_it_is_idle() -> None:
    one = edge()
    done(one.execute, allocation_of(1, "edge1"), 0.0)
    done(one.execute, allocation_of(2, "edge2"), 1.0)
    one.on_worker_seen(1.1)
    ends_at = one.next_deadline()
    assert one.is_finishing
    assert one.may_work_unleased(ends_at)
    done(one.tick, ends_at)
    assert one.may_work_unleased(ends_at + HEARS_S - 0.1)
    assert not one.may_work_unleased(ends_at + HEARS_S)


def test_a_worker_that_has_drained_hears_of_its_end_a_little_later() -> None:
    one = edge()
    done(one.execute, allocation_of(1, "edge1"), 0.0)
    done(one.execute, allocation_of(2, "edge2"), 1.0)
    assert one.role.role is WorkerRole.DRAINING
    ends_at = one.next_deadline()
    (told,) = [out.role.role for out in done(one.tick, ends_at) if isinstance(out, SetRole)]
    assert told is WorkerRole.IDLE
    done(one.on_role_ended, 1)
    assert one.may_work_unleased(ends_at + LEAVES_S - 0.001)
    assert not one.may_work_unleased(ends_at + LEAVES_S)


def test_an_old_owner_s_worker_finishes_until_it_says_so_or_its_time_is_over() -> None:
    one, other, seen = edge(), edge(), list[bool]()
    done(one.execute, allocation_of(1, "edge1"), 0.0)
    seen.append(one.is_finishing)
    done(one.execute, allocation_of(2, "edge2"), 1.0)
    seen.append(one.is_finishing)
    done(one.on_role_ended, 1)
    seen.append(one.is_finishing)
    assert seen == [False, True, False]
    done(other.execute, allocation_of(1, "edge1"), 0.0)
    done(other.execute, allocation_of(2, "edge2"), 1.0)
    done(other.tick, other.next_deadline())
    assert not other.is_finishing, "it is idle"


def test_a_worker_that_was_told_to_stop_at_once_has_nothing_to_hear() -> None:
    one = edge(spec=replace(SPEC, exclusive=True))
    done(one.execute, replace(allocation_of(1, "edge1"), leased=True), 0.0)
    done(one.set_lease, 2.0, 0.0)
    done(one.execute, replace(allocation_of(2, "edge2"), leased=True), 1.0)
    done(one.tick, one.next_deadline())
    assert not one.may_work_unleased(1.0)


def adopted(one: Executor, spec: TaskSpec) -> list[Instruction]:
    todo = ToDo()
    one.on_spec(spec, todo, 20.0, is_agreed_leased=False)
    return list(todo.apply)


@pytest.mark.parametrize(
    ("standby", "moves", "command", "expected"),
    [
        (Standby.WARM, [], ("other",), [StartWorker]),
        (Standby.COLD, [], ("other",), [StopWorker]),
        (Standby.COLD, ["edge1"], ("other",), [StartWorker]),
        (Standby.COLD, ["edge1", "edge2"], ("other",), [StartWorker]),  # it drains
        (Standby.WARM, ["edge1"], (), [StopWorker]),
        (Standby.COLD, ["edge1"], (), [StopWorker]),
        (Standby.WARM, ["edge1"], SPEC.worker.command, []),
    ],
    ids=["warm", "cold", "cold owner", "cold draining", "foreign from now on", "cold foreign", "as before"],
)
def test_another_command_stops_nobody_who_works_and_a_foreign_worker_is_no_longer_ours(
    standby: Standby, moves: list[str], command: tuple[str, ...], expected: list[type[Instruction]]
) -> None:
    spec = replace(SPEC, worker=replace(SPEC.worker, standby=standby))
    one = edge(spec=spec)
    for epoch, owner in enumerate(moves, 1):
        done(one.execute, allocation_of(epoch, owner), 0.0)
    later = replace(spec, worker=replace(spec.worker, command=command))
    assert [type(step) for step in adopted(one, later)] == expected


def test_a_worker_that_was_foreign_is_started_where_it_is_to_run_and_stays_foreign_otherwise() -> None:
    for spec, expected in ((SPEC, [StartWorker]), (COLD, [StopWorker])):
        assert [type(step) for step in adopted(edge(spec=FOREIGN), spec)] == expected
    still = replace(FOREIGN, worker=replace(FOREIGN.worker, standby=Standby.COLD))
    assert adopted(edge(spec=FOREIGN), still) == []


def test_a_node_that_was_chosen_by_a_newer_file_works_once_it_has_that_file() -> None:
    """By its own file it is no candidate yet, so it runs no worker."""
    one = edge(spec=replace(SPEC, candidates=("edge2", "edge3")))
    assert roles(done(one.execute, allocation_of(1, "edge1"), 0.0)) == []
    steps = adopted(one, SPEC)
    assert roles(tuple(steps)) == [(WorkerRole.ACTIVE, 1)]
    assert of(tuple(steps), StartWorker)


@pytest.mark.parametrize("later", OnIsolation)
def test_who_works_alone_does_so_while_its_file_lets_it(later: OnIsolation) -> None:
    spec = replace(SPEC, on_isolation=OnIsolation.LOCAL)
    alone = Executor(spec=spec, me="robot1", has_streams=True)
    done(alone.execute, allocation_of(1, "edge1"), 0.0)
    done(alone.isolate, 0.5)
    assert alone.is_local
    alone.on_spec(replace(spec, on_isolation=later, drain_s=3.0), ToDo(), 1.0, is_agreed_leased=False)
    assert alone.is_local is (later is OnIsolation.LOCAL)
