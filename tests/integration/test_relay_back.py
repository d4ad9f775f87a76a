"""A task that moves again before the slot that it left has drained: each slot drains, one after the other."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from support.relay_rig import ROBOT, TASK, Application, Rig, relay_rig, slot
from support.waiting import until
from zsched.core.values.events import SlotDrained, SlotFlipped, SlotReady
from zsched.core.values.plan import OnCrash, RoutePhase, Slot, StreamClass, WorkerRole
from zsched.host.clock import monotonic_s

pytestmark = pytest.mark.long

BEFORE, BACKLOG, BEHIND = 5, 200, 10
DRAIN_S = 2.0


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    with relay_rig(tmp_path) as made:
        yield made


def flip(rig: Rig, new: Slot, *olds: Slot) -> None:
    rig.plan(RoutePhase.PREPARE, new, *olds)
    rig.wait(SlotReady, epoch=new.epoch, is_ready=True)
    rig.plan(RoutePhase.FLIP, new, *olds)
    rig.wait(SlotFlipped, epoch=new.epoch)


def slots(on_crash: OnCrash = OnCrash.REPORT) -> tuple[Slot, Slot, Slot]:
    """edge1's, edge2's and edge1's again."""
    first, second, third = (
        slot(epoch, owner, StreamClass.RELIABLE, 0, on_crash=on_crash)
        for epoch, owner in ((1, "edge1"), (2, "edge2"), (3, "edge1"))
    )
    return first, second, third


def away(rig: Rig, app: Application, first: Slot, second: Slot) -> None:
    """edge1 has `BACKLOG` samples that it has not answered when edge2 gets `BEHIND` more."""
    for _ in range(BACKLOG):
        app.put()
    rig.role("edge2", WorkerRole.ACTIVE, 2)
    rig.role("edge1", WorkerRole.DRAINING, 1)
    flip(rig, second, first)
    for _ in range(BEHIND):
        app.put()


def there_and_back(rig: Rig, app: Application, on_crash: OnCrash) -> None:
    """Away from edge1, and back to it, which gets as many again as edge2 did."""
    first, second, third = slots(on_crash)
    away(rig, app, first, second)
    rig.role("edge1", WorkerRole.ACTIVE, 3)
    rig.role("edge2", WorkerRole.DRAINING, 2)
    flip(rig, third, first, second)
    for _ in range(BEHIND):
        app.put()


def first_owner(rig: Rig, app: Application, on_crash: OnCrash) -> None:
    rig.start_worker("edge2")
    rig.move(slots(on_crash)[0])
    until(app.connected, "the application sees the relay's subscription")
    for _ in range(BEFORE):  # a lane that nobody has acknowledged holds what it is given, for any owner
        app.put()
    until(lambda: len(app.back) == BEFORE, "the first owner answers")


def all_is_back(rig: Rig, app: Application, on_crash: OnCrash) -> None:
    """The executor's table; a slot that was never given anything has its drain time to say that it has ended."""
    rig.wait(SlotDrained, epoch=1)
    left_at = monotonic_s()
    until(lambda: rig.reports[ROBOT].find(SlotDrained, epoch=2) or monotonic_s() > left_at + DRAIN_S, "epoch 2")
    rig.plan(RoutePhase.CLOSE, slots(on_crash)[2])
    until(lambda: len(app.back) >= app.sent, f"{app.sent} samples back")
    assert app.back == list(range(app.sent))
    assert [rig.told(f"{TASK}/in/0").at_most_lost, rig.told(f"{TASK}/out/0").lost] == [0, 0]


@pytest.mark.parametrize("on_crash", OnCrash)
def test_a_slow_owner_gives_back_what_it_had_before_it_was_left_and_came_back(rig: Rig, on_crash: OnCrash) -> None:
    rig.start_worker("edge1", "--delay-ms", "20")
    app = Application(rig.app)
    first_owner(rig, app, on_crash)
    there_and_back(rig, app, on_crash)
    assert len(app.back) < BEFORE + BACKLOG, "the first owner is busy all the while"
    all_is_back(rig, app, on_crash)


@pytest.mark.parametrize("on_crash", OnCrash)
def test_a_frozen_owner_gives_back_what_it_had_before_it_was_left_and_came_back(rig: Rig, on_crash: OnCrash) -> None:
    worker = rig.start_worker("edge1")
    app = Application(rig.app)
    first_owner(rig, app, on_crash)
    worker.send_signal(signal.SIGSTOP)
    there_and_back(rig, app, on_crash)
    worker.send_signal(signal.SIGCONT)
    all_is_back(rig, app, on_crash)


def test_a_slot_that_is_closed_before_it_has_drained_lets_the_next_one_have_its_turn(rig: Rig) -> None:
    """The first slot's drain time is over: its samples are told as perhaps lost, and the next owner's answers come."""
    worker = rig.start_worker("edge1")
    app = Application(rig.app)
    first_owner(rig, app, OnCrash.REPORT)
    worker.send_signal(signal.SIGSTOP)
    first, second, third = slots()
    away(rig, app, first, second)
    rig.plan(RoutePhase.PREPARE, third, second)
    until(lambda: app.back[-1] == app.sent - 1, f"what {ROBOT} sent to edge2 comes back")
    missing = app.sent - len(app.back)
    assert app.back == [*range(BEFORE), *range(BEFORE + missing, app.sent)], (
        "what was not sent to edge1 yet edge2 has got"
    )
    told = until(lambda: rig.told(f"{TASK}/in/0").at_most_lost, "what the first slot had is told")
    assert 0 < missing <= told <= BEFORE + missing, "an answer may be back before its acknowledgement"


def test_the_first_slot_carries_on_when_the_task_moves_again_before_the_flip(rig: Rig) -> None:
    """The flip waits for an owner that has not heard of its role yet; by then it is no longer meant."""
    rig.start_worker("edge1")
    app = Application(rig.app)
    first_owner(rig, app, OnCrash.REPORT)
    first, second, third = slots()
    rig.plan(RoutePhase.PREPARE, second, first)
    rig.wait(SlotReady, epoch=2, is_ready=True)
    rig.plan(RoutePhase.FLIP, second, first)
    rig.plan(RoutePhase.PREPARE, third, first, second)
    rig.wait(SlotReady, epoch=3, is_ready=True)
    for _ in range(BEHIND):
        app.put()
    until(lambda: len(app.back) == BEFORE + BEHIND, "the first owner answers")
    rig.role("edge1", WorkerRole.ACTIVE, 3)
    rig.plan(RoutePhase.FLIP, third, first, second)
    rig.wait(SlotFlipped, epoch=3)
    for _ in range(BEHIND):
        app.put()
    until(lambda: len(app.back) == app.sent, "nothing is lost")
    assert app.back == list(range(app.sent))
    assert app.nodes == ["edge1"] * app.sent
    rig.plan(RoutePhase.CLOSE, third)
