"""Workers that run by an old recipe start again one candidate after the other, the owner last, after a move."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import pytest

from support.allocations import allocation_of
from support.fleets import task_of
from support.profiles import load_of, profile_of
from zsched.core.executor.renewing import GIVE_AWAY_S, OTHER_FILE_S, SAME_FILE_S, Renewing, Step, step
from zsched.core.values.fleet import Standby, WorkerSpec
from zsched.core.values.instructions import RecordStory, RenewWorker
from zsched.core.values.model import Allocation, NodeId
from zsched.core.values.profile import Profile, Renewal, WorkerState
from zsched.core.values.todo import ToDo

SPEC = task_of("merge", ("edge1", "edge2", "edge3"), worker=WorkerSpec(command=("work",)))
OWNED = allocation_of(3, "edge2", task="merge")
FILE = "new"


def seen(
    node: NodeId, renewal: Renewal = Renewal.NONE, state: WorkerState = WorkerState.READY, **more: bool
) -> Profile:
    return profile_of(node, workers=(replace(load_of("merge", state), renewal=renewal),), **more)


def chosen(me: NodeId, *profiles: Profile, allocation: Allocation = OWNED, is_at_work: bool | None = None) -> Step:
    known = {profile.node: profile for profile in profiles}
    at_work = allocation.owner == me if is_at_work is None else is_at_work
    return step(SPEC, me, allocation, known, is_at_work=at_work)


DUE = Renewal.DUE


@pytest.mark.parametrize(
    ("me", "others", "wanted"),
    [
        ("edge1", (seen("edge2", DUE), seen("edge3", DUE)), Step.RENEW),
        ("edge3", (seen("edge1", DUE), seen("edge2", DUE)), Step.WAIT),
        ("edge3", (seen("edge1", state=WorkerState.STARTING), seen("edge2", DUE)), Step.WAIT),
        ("edge3", (seen("edge1"), seen("edge2", DUE)), Step.RENEW),
        ("edge2", (seen("edge1"), seen("edge3", DUE)), Step.WAIT),
        ("edge2", (seen("edge1", state=WorkerState.STARTING), seen("edge3")), Step.WAIT),
        ("edge2", (seen("edge1", state=WorkerState.STOPPED),), Step.WAIT),
        ("edge3", (seen("edge1", state=WorkerState.STOPPED), seen("edge2", DUE)), Step.WAIT),
        ("edge2", (seen("edge1"), seen("edge3")), Step.GIVE_AWAY),
        ("edge2", (seen("edge1", DUE, draining=True), seen("edge3")), Step.GIVE_AWAY),
        ("edge2", (seen("edge1", DUE, WorkerState.FAILED),), Step.RENEW_IN_PLACE),
        ("edge2", (), Step.RENEW_IN_PLACE),
    ],
)
def test_the_turn_goes_by_name_and_the_owner_is_the_last(me: NodeId, others: tuple[Profile, ...], wanted: Step) -> None:
    assert chosen(me, *others) is wanted


@pytest.mark.parametrize(
    ("command", "standby", "wanted"),
    [
        (("work",), Standby.WARM, Step.WAIT),
        (("work",), Standby.COLD, Step.GIVE_AWAY),
        ((), Standby.WARM, Step.RENEW_IN_PLACE),
    ],
)
def test_a_stopped_worker_of_another_candidate(command: tuple[str, ...], standby: Standby, wanted: Step) -> None:
    spec = replace(SPEC, worker=replace(SPEC.worker, command=command, standby=standby))
    known = {"edge1": seen("edge1", state=WorkerState.STOPPED)}
    assert step(spec, "edge2", OWNED, known, is_at_work=True) is wanted


def test_a_worker_that_somebody_else_has_started_can_have_the_task() -> None:
    spec = replace(SPEC, worker=replace(SPEC.worker, command=()))
    assert step(spec, "edge2", OWNED, {"edge1": seen("edge1")}, is_at_work=True) is Step.GIVE_AWAY


def test_who_still_drains_waits_and_a_task_that_may_not_move_stays() -> None:
    assert chosen("edge1", seen("edge2"), is_at_work=True) is Step.WAIT
    for held in ({"paused": True}, {"pinned": True}):
        allocation = allocation_of(3, "edge2", task="merge", **held)
        assert chosen("edge2", seen("edge1"), allocation=allocation) is Step.RENEW_IN_PLACE


def tend(renewing: Renewing, now: float, *profiles: Profile, owner: NodeId = "edge2") -> ToDo:
    todo = ToDo()
    known: Mapping[NodeId, Profile] = {profile.node: profile for profile in profiles}
    allocation = allocation_of(3, owner, task="merge")
    is_at_work = owner == renewing.me
    renewing.tend(SPEC, allocation, known, todo, now, is_at_work=is_at_work, fleet_file=FILE)
    return todo


def renewed(todo: ToDo) -> bool:
    return any(isinstance(one, RenewWorker) for one in todo.apply)


def test_nobody_acts_before_all_go_by_the_same_file_or_for_too_long() -> None:
    renewing = Renewing("edge1")
    renewing.on_compared("merge", is_old=True)
    others = (seen("edge2", DUE), seen("edge3"))
    assert not renewed(tend(renewing, 10.0, *others)), "no beat was heard yet"
    renewing.hear("edge2", FILE, 10.0)
    renewing.hear("edge3", "old", 10.0)
    assert not renewed(tend(renewing, 10.0 + SAME_FILE_S, *others)), "edge3 goes by another file"
    renewing.hear("edge3", FILE, 12.0)
    assert not renewed(tend(renewing, 12.0 + SAME_FILE_S / 2, *others)), "its profile may be of before"
    assert renewed(tend(renewing, 12.0 + SAME_FILE_S, *others))
    assert not renewed(tend(renewing, 20.0, *others)), "it was told once"

    stuck = Renewing("edge1")
    stuck.on_compared("merge", is_old=True)
    assert not renewed(tend(stuck, 0.0, *others))
    assert renewed(tend(stuck, OTHER_FILE_S, *others)), "a node that never gets the file holds nobody up for ever"


def test_what_was_heard_for_an_earlier_change_says_nothing_of_a_later_one() -> None:
    """A file that comes back has the same hash; whether the others have gone back with it, only new beats tell."""
    renewing, others = Renewing("edge1"), (seen("edge2", DUE), seen("edge3"))
    renewing.on_compared("merge", is_old=True)
    for name in ("edge2", "edge3"):
        renewing.hear(name, FILE, 10.0)
    assert renewed(tend(renewing, 10.0 + SAME_FILE_S, *others))
    renewing.on_compared("merge", is_old=False)
    renewing.on_compared("merge", is_old=True)
    assert not renewed(tend(renewing, 60.0, *others)), "no beat was heard since"
    for name in ("edge2", "edge3"):
        renewing.hear(name, FILE, 61.0)
    assert renewed(tend(renewing, 61.0 + SAME_FILE_S, *others))


def test_an_owner_gives_the_task_away_and_starts_in_place_when_nobody_takes_it() -> None:
    renewing = Renewing("edge2")
    renewing.on_compared("merge", is_old=True)
    for name in ("edge1", "edge3"):
        renewing.hear(name, FILE, 0.0)
    others = (seen("edge1"), seen("edge3"))
    assert renewing.told == {"merge": DUE}
    assert not renewed(tend(renewing, 5.0, *others))
    assert renewing.told == {"merge": Renewal.LEAVES}
    assert not renewed(tend(renewing, 5.0 + GIVE_AWAY_S - 0.1, *others))
    last = tend(renewing, 5.0 + GIVE_AWAY_S, *others)
    assert renewed(last)
    assert any(isinstance(one, RecordStory) and "in place" in one.text for one in last.apply)
    renewing.on_compared("merge", is_old=False)
    assert renewing.told == {}


def test_an_owner_that_is_replaced_starts_its_worker_afterwards() -> None:
    renewing = Renewing("edge2")
    renewing.on_compared("merge", is_old=True)
    for name in ("edge1", "edge3"):
        renewing.hear(name, FILE, 0.0)
    tend(renewing, 5.0, seen("edge1"), seen("edge3"))
    assert renewed(tend(renewing, 6.0, seen("edge1"), seen("edge3"), owner="edge1"))
