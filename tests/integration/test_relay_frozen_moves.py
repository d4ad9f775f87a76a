"""Moves to an owner that stands still, or whose role is late: nothing is lost, or what is lost is told."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from support.relay_rig import Application, Rig, relay_rig, slot
from support.waiting import until
from zsched.core.values.events import SlotDrained, SlotFlipped, SlotReady
from zsched.core.values.plan import RoutePhase, StreamClass, WorkerRole
from zsched.core.values.relay_protocol import SlotLost

FROZEN_S = 4.0
"""Longer than the lease: its link ends, and whatever is on its way goes with it."""
MORE_THAN_IS_KEPT = 2048 + 1000
"""...and less than a slot's queue holds."""
PADDING = 2000
"""So that no socket holds what a relay does not keep."""


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    with relay_rig(tmp_path) as made:
        yield made


@pytest.mark.parametrize("seconds", [0.9, 4.0])
def test_a_new_owner_that_is_frozen_at_the_move_misses_nothing(rig: Rig, seconds: float) -> None:
    """4 s are longer than the lease: its link is closed, and whatever was on its way is gone."""
    rig.start_worker("edge1")
    frozen = rig.start_worker("edge2")
    first, second = slot(1, "edge1", StreamClass.RELIABLE, 1), slot(2, "edge2", StreamClass.RELIABLE, 1)
    rig.move(first)
    app = Application(rig.app)
    thread = app.flow(200, 50)
    rig.plan(RoutePhase.PREPARE, second, first)
    rig.wait(SlotReady, epoch=2, is_ready=True)
    frozen.send_signal(signal.SIGSTOP)
    rig.role("edge2", WorkerRole.ACTIVE, 2)
    rig.role("edge1", WorkerRole.DRAINING, 1)
    rig.plan(RoutePhase.FLIP, second, first)
    rig.wait(SlotFlipped, epoch=2)
    time.sleep(seconds)
    frozen.send_signal(signal.SIGCONT)
    until(lambda: app.nodes[-1] == "edge2", "the stream through edge2")
    rig.plan(RoutePhase.CLOSE, second)
    app.halt(thread)
    until(lambda: len(app.back) >= app.sent, "every answer")
    assert app.back == list(range(app.sent))


def test_an_owner_that_is_frozen_before_it_is_greeted_misses_nothing(rig: Rig) -> None:
    """It hears neither of the slot nor of its role, and more is on its way to it than a relay keeps to send again.

    Before it has answered nothing may go out: what it does not take would be lost, or would have to be given up.
    """
    rig.start_worker("edge1")
    frozen = rig.start_worker("edge2")
    first, second = slot(1, "edge1", StreamClass.RELIABLE, 1), slot(2, "edge2", StreamClass.RELIABLE, 1)
    rig.move(first)
    app = Application(rig.app)
    app.halt(app.flow(200, 20))
    until(lambda: len(app.back) == app.sent, "every answer of the first owner")
    app.padding = bytes(PADDING)
    frozen.send_signal(signal.SIGSTOP)
    frozen_at = time.monotonic()
    rig.role("edge2", WorkerRole.ACTIVE, 2)
    rig.role("edge1", WorkerRole.DRAINING, 1)
    rig.plan(RoutePhase.PREPARE, second, first)
    rig.plan(RoutePhase.FLIP, second, first)
    rig.wait(SlotFlipped, epoch=2)
    for _ in range(MORE_THAN_IS_KEPT):
        app.put()
    time.sleep(max(0.0, frozen_at + FROZEN_S - time.monotonic()))
    frozen.send_signal(signal.SIGCONT)
    rig.wait(SlotDrained, epoch=1)
    rig.plan(RoutePhase.CLOSE, second)
    until(lambda: len(app.back) >= app.sent, "every answer")
    assert app.back == list(range(app.sent))
    until(lambda: rig.told("echo/in/0").acknowledged == app.sent, "every acknowledgement")
    told = rig.told("echo/in/0")
    assert (told.lost, told.at_most_lost, told.drops) == (0, 0, ())


@pytest.mark.parametrize("is_told", [True, False], ids=["told in the end", "told the last only"])
def test_who_is_left_and_chosen_again_while_it_hears_of_neither_misses_nothing(rig: Rig, *, is_told: bool) -> None:
    """A -> B -> A, planned both times, while A's relay stands still and tells A's worker nothing."""
    rig.start_worker("edge1")
    rig.start_worker("edge2")
    first, second, third = (
        slot(epoch, owner, StreamClass.RELIABLE, 1) for epoch, owner in ((1, "edge1"), (2, "edge2"), (3, "edge1"))
    )
    rig.move(first)
    app = Application(rig.app)
    thread = app.flow(200, 50)
    frozen = rig.relays["edge1"].pid
    assert frozen is not None
    os.kill(frozen, signal.SIGSTOP)
    rig.role("edge2", WorkerRole.ACTIVE, 2)
    if is_told:
        rig.role("edge1", WorkerRole.DRAINING, 1)
        rig.role("edge1", WorkerRole.IDLE)
    rig.role("edge1", WorkerRole.ACTIVE, 3)
    for new, old in ((second, first), (third, second)):
        rig.plan(RoutePhase.PREPARE, new, old)
        rig.wait(SlotReady, epoch=new.epoch, is_ready=True)
        rig.plan(RoutePhase.FLIP, new, old)
        rig.wait(SlotFlipped, epoch=new.epoch)
    rig.role("edge2", WorkerRole.DRAINING, 2)
    sent = app.sent
    until(lambda: app.sent > sent + 50, "samples of an epoch that edge1's worker has not heard of")
    os.kill(frozen, signal.SIGCONT)
    rig.wait(SlotDrained, epoch=2)
    rig.plan(RoutePhase.CLOSE, third)
    app.halt(thread)
    # On a busy machine epoch 1 is closed before A's worker has done it all: those it may have missed are told of.
    until(lambda: len(app.back) + rig.told("echo/in/0").at_most_lost >= app.sent, "an answer or a word to every sample")
    # What may be lost of epoch 1 says nothing of answers that are still on their way.
    until(lambda: set(range(sent, app.sent)) <= set(app.back), "all of the last epoch")
    assert app.back == sorted(set(app.back))


def test_the_newest_value_has_its_result_when_who_is_chosen_again_hears_of_it_late(rig: Rig) -> None:
    """A -> B -> A with class ``latest``: nothing comes behind the last value that would make up for it."""
    rig.start_worker("edge1", "--latest")
    rig.start_worker("edge2", "--latest")
    first, second, third = (
        slot(epoch, owner, StreamClass.LATEST, 1) for epoch, owner in ((1, "edge1"), (2, "edge2"), (3, "edge1"))
    )
    rig.move(first)
    app = Application(rig.app)
    until(app.connected, "the application sees the relay's subscription")
    app.put()
    until(lambda: app.back == [0], "the first result")
    frozen = rig.relays["edge1"].pid
    assert frozen is not None
    os.kill(frozen, signal.SIGSTOP)
    rig.role("edge2", WorkerRole.ACTIVE, 2)
    rig.role("edge1", WorkerRole.ACTIVE, 3)
    for new, old in ((second, first), (third, second)):
        rig.plan(RoutePhase.PREPARE, new, old)
        rig.wait(SlotReady, epoch=new.epoch, is_ready=True)
        rig.plan(RoutePhase.FLIP, new, old)
        rig.wait(SlotFlipped, epoch=new.epoch)
    rig.plan(RoutePhase.CLOSE, third)
    app.put()
    until(lambda: rig.told("echo/in/0").messages == 2, "the value at the relay")
    os.kill(frozen, signal.SIGCONT)
    until(lambda: app.back[-1] == 1, "its result")


def test_work_that_was_counted_as_lost_is_not_done_later(rig: Rig) -> None:
    """A new owner whose role never comes is left again; it withheld what it was sent, and is chosen once more."""
    rig.start_worker("edge1")
    rig.start_worker("edge2")
    first, second, third, fourth = (
        slot(epoch, owner, StreamClass.RELIABLE, 1)
        for epoch, owner in ((1, "edge1"), (2, "edge2"), (3, "edge1"), (4, "edge2"))
    )
    rig.move(first)
    app = Application(rig.app)
    thread = app.flow(200, 50)
    rig.plan(RoutePhase.PREPARE, second, first)
    rig.wait(SlotReady, epoch=2, is_ready=True)
    rig.plan(RoutePhase.FLIP, second, first)
    rig.wait(SlotFlipped, epoch=2)
    sent = app.sent
    until(lambda: app.sent > sent + 50, "samples to a worker that is not told that it is the owner")
    rig.role("edge1", WorkerRole.ACTIVE, 3)
    rig.plan(RoutePhase.PREPARE, third)
    rig.plan(RoutePhase.CLOSE, third)
    lost = rig.wait(SlotLost, epoch=2).samples
    rig.move(fourth, third)
    until(lambda: app.nodes[-1] == "edge2", "the stream through edge2")
    app.halt(thread)
    until(lambda: len(app.back) >= app.sent - lost, "every answer but those")
    assert app.back == sorted(app.back)
    assert len(app.back) == app.sent - lost
    until(lambda: rig.told("echo/in/0").at_most_lost == lost, "their count")
