"""A planned move to an owner whose worker stands still: nothing is lost, or what is lost is told."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from support.relay_rig import Application, Rig, relay_rig, slot
from support.waiting import until
from zsched.core.events import SlotFlipped, SlotReady
from zsched.core.plan import RoutePhase, StreamClass, WorkerRole


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
    until(app.connected, "the application sees the relay's subscription")
    thread = app.stream(200)
    until(lambda: len(app.back) > 50, "the stream through edge1")
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
