"""Streams over real relays, real echo workers and real applications: what a move must not lose, double or reorder."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import zenoh

from support.relay_rig import BESIDE, ROBOT, TASK, Application, Rig, relay_rig, slot
from support.sessions import matches
from support.waiting import between, until, within
from zsched.core.values.events import RelayChanged, SlotDrained, SlotFlipped, SlotReady
from zsched.core.values.plan import (
    ReadyWhen,
    RoutePhase,
    RoutePlan,
    StreamClass,
    WorkerRole,
)
from zsched.core.values.relay_protocol import WorkerWatch
from zsched.link.sessions.config import DEFAULT_TIMING, worker_config

WAITS_S = 5.0
"""Half of such a link's lease."""


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    with relay_rig(tmp_path) as made:
        yield made


@pytest.fixture
def patient_rig(tmp_path: Path) -> Iterator[Rig]:
    """Links to a frozen process stay for 10 s: who waits for one is seen to."""
    with relay_rig(tmp_path, replace(DEFAULT_TIMING, zenoh_lease_s=10.0)) as made:
        yield made


def goes_on(app: Application) -> None:
    before = len(app.back)
    until(lambda: len(app.back) > before + 20, "the stream goes on")


def there_and_back(rig: Rig, app: Application, stream_class: StreamClass) -> None:
    """Five owners in turn while the application streams at 200 Hz."""
    options = ["--latest"] if stream_class is StreamClass.LATEST else []
    rig.start_worker("edge1", *options)
    rig.start_worker("edge2", *options)
    now = slot(1, "edge1", stream_class, 1)
    rig.move(now)
    until(app.connected, "the application sees the relay's subscription")
    thread = app.stream(200)
    for epoch, owner in enumerate(["edge2", "edge1", "edge2", "edge1"], start=2):
        goes_on(app)  # between two moves
        new = slot(epoch, owner, stream_class, 1)
        rig.move(new, now)
        now = new
    app.halt(thread)


def test_moves_of_a_reliable_stream_lose_double_and_reorder_nothing(rig: Rig) -> None:
    app = Application(rig.app)
    there_and_back(rig, app, StreamClass.RELIABLE)
    until(lambda: len(app.back) >= app.sent, f"{app.sent} samples back, {len(app.back)} came")
    assert app.back == list(range(app.sent))
    assert set(app.nodes) == {"edge1", "edge2"}


def test_one_epoch_after_another_of_the_same_owner_loses_nothing(rig: Rig) -> None:
    rig.start_worker("edge1")
    app = Application(rig.app)
    now = slot(1, "edge1", StreamClass.RELIABLE, 0)
    rig.move(now)
    until(app.connected, "the application sees the relay's subscription")
    thread = app.stream(200)
    for epoch in (2, 3, 4):
        goes_on(app)
        new = slot(epoch, "edge1", StreamClass.RELIABLE, 0)
        rig.role("edge1", WorkerRole.ACTIVE, epoch)
        rig.plan(RoutePhase.PREPARE, new, now)
        rig.wait(SlotReady, epoch=epoch, is_ready=True)
        rig.plan(RoutePhase.FLIP, new, now)
        rig.wait(SlotDrained, epoch=epoch - 1)
        rig.plan(RoutePhase.CLOSE, new)
        now = new
    app.halt(thread)
    until(lambda: len(app.back) >= app.sent, f"{app.sent} samples back, {len(app.back)} came")
    assert app.back == list(range(app.sent))


def test_moves_of_a_latest_stream_end_with_the_newest_value(rig: Rig) -> None:
    app = Application(rig.app)
    there_and_back(rig, app, StreamClass.LATEST)
    until(lambda: app.back and app.back[-1] == app.sent - 1, "the newest value")
    assert app.back == sorted(app.back), "an older value behind a newer one"
    # The value that is kept at a move reaches both owners; a value in between may give way to a newer one.
    assert len(app.back) - len(set(app.back)) <= 2 * 4 + 1
    assert len(set(app.back)) > 0.9 * app.sent


@pytest.mark.parametrize("stream_class", [StreamClass.RELIABLE, StreamClass.LATEST])
def test_a_frozen_owner_does_not_hold_up_its_successor(patient_rig: Rig, stream_class: StreamClass) -> None:
    rig = patient_rig
    options = ["--latest"] if stream_class is StreamClass.LATEST else []
    frozen = rig.start_worker("edge1", *options)
    rig.start_worker("edge2", *options)
    app = Application(rig.app)
    app.padding = bytes(200_000)
    first, second = slot(1, "edge1", stream_class, 1), slot(2, "edge2", stream_class, 1)
    rig.move(first)
    thread = app.flow(100, 20)
    frozen.send_signal(signal.SIGSTOP)
    before = app.sent
    until(lambda: app.sent > before + 50, "10 MB fill its socket and its queues")
    started = time.monotonic()
    rig.move(second, first, drains=False)
    until(lambda: app.nodes[-1] == "edge2", "the stream through edge2")
    within(time.monotonic() - started, WAITS_S)
    app.halt(thread)


def test_a_stalled_owner_delays_no_other_stream(patient_rig: Rig) -> None:
    rig = patient_rig
    stalled = rig.start_worker("edge1")
    app = Application(rig.app)
    rig.move(slot(1, "edge1", StreamClass.RELIABLE, 0))
    until(app.connected, "the application sees the relay's subscription")
    beside = replace(slot(1, "edge2", StreamClass.RELIABLE, 0, ReadyWhen.MATCHING), routes=(BESIDE,))
    arrivals: list[float] = []
    foreign = zenoh.open(zenoh.Config.from_json5(worker_config(connect=(rig.endpoint("edge2"),))))
    try:
        foreign.declare_subscriber(BESIDE.to_expr, lambda _: arrivals.append(time.monotonic()))
        for phase in (RoutePhase.PREPARE, RoutePhase.FLIP):
            rig.relays[ROBOT].apply(RoutePlan(task="beside", phase=phase, current=beside))
            until(lambda: rig.reports[ROBOT].find(SlotReady, task="beside"), "the live target is ready")
        until(lambda: rig.reports[ROBOT].find(SlotFlipped, task="beside"), "the live target is fed")
        source = rig.app.declare_publisher(BESIDE.from_expr)
        until(lambda: rig.app.put(BESIDE.from_expr, b"x") or arrivals, "the live stream flows")
        stalled.send_signal(signal.SIGSTOP)
        started, before = time.monotonic(), len(arrivals)

        def put() -> bool:
            rig.app.put(f"{ROBOT}/in", bytes(65536), attachment=b"attached")
            source.put(b"x")
            return len(arrivals) > before + 250

        until(put, "the live stream goes on")
        within(time.monotonic() - started, WAITS_S)
    finally:
        foreign.close()


def test_the_last_value_reaches_a_new_owner(rig: Rig) -> None:
    rig.start_worker("edge1", "--latest")
    rig.start_worker("edge2", "--latest")
    app = Application(rig.app)
    first, second = slot(1, "edge1", StreamClass.LATEST, 1), slot(2, "edge2", StreamClass.LATEST, 1)
    rig.move(first)
    until(app.connected, "the application sees the relay's subscription")
    for number in range(3):
        app.put()
        until(lambda number=number: number in app.back, "the value through edge1")  # type: ignore[misc] # bound at once
    rig.move(second, first)
    until(lambda: "edge2" in app.nodes, "the kept value through edge2, with nothing new published")
    assert app.back[app.nodes.index("edge2")] == 2


def test_a_worker_that_restarts_in_place_gets_the_last_value_again(rig: Rig) -> None:
    worker = rig.start_worker("edge1", "--latest")
    app = Application(rig.app)
    rig.move(slot(1, "edge1", StreamClass.LATEST, 1))
    until(app.connected, "the application sees the relay's subscription")
    app.put()
    until(lambda: app.back == [0], "the value through the first incarnation")
    worker.kill()
    worker.wait(60)
    rig.wait(SlotReady, epoch=1, is_ready=False)
    rig.start_worker("edge1", "--latest")
    until(lambda: len(app.back) > 1, "the value again, from the second incarnation, which asked for its role")
    assert set(app.back) == {0}


def test_output_of_a_stale_epoch_never_passes(rig: Rig) -> None:
    rig.start_worker("edge1")
    app = Application(rig.app)
    first = slot(1, "edge1", StreamClass.RELIABLE, 0)
    rig.move(first)
    until(app.connected, "the application sees the relay's subscription")
    liar = zenoh.open(zenoh.Config.from_json5(worker_config(connect=(rig.endpoint("edge2"),))))
    try:
        stale = liar.declare_publisher(f"edge1/{TASK}/0/{ROBOT}/out")
        other = liar.declare_publisher(f"edge2/{TASK}/1/{ROBOT}/out")
        honest = liar.declare_publisher(f"edge1/{TASK}/1/{ROBOT}/out")
        until(lambda: matches(honest), "the gate is open for the owner's epoch")
        for publisher in (stale, other):
            publisher.put(b"99", attachment=b"attached")
        honest.put(b"7", attachment=b"attached")  # behind them on the same link
        app.put()
        until(lambda: {0, 7} <= set(app.back), "what is of the owner's epoch")
        assert len(app.back) == 2
    finally:
        liar.close()


def test_a_killed_owner_is_replaced_within_the_goal(rig: Rig) -> None:
    owner = rig.start_worker("edge1")
    rig.start_worker("edge2")
    app = Application(rig.app)
    first, second = slot(1, "edge1", StreamClass.RELIABLE, 0), slot(2, "edge2", StreamClass.RELIABLE, 0)
    rig.move(first)
    thread = app.flow(200, 50)
    owner.kill()
    owner.wait(60)
    rig.wait(SlotReady, epoch=1, is_ready=False)
    rig.move(second, first)
    until(lambda: app.nodes and app.nodes[-1] == "edge2", "the stream through edge2")
    app.halt(thread)
    until(lambda: app.back[-1] == app.sent - 1, "the newest sample")
    assert app.back == sorted(set(app.back))


def test_a_relay_that_is_killed_is_restarted_with_the_newest_plan(rig: Rig) -> None:
    rig.start_worker("edge1")
    app = Application(rig.app)
    rig.move(slot(1, "edge1", StreamClass.RELIABLE, 0))
    until(app.connected, "the application sees the relay's subscription")
    pid = rig.relays[ROBOT].pid
    assert pid is not None
    os.kill(pid, signal.SIGKILL)
    rig.wait(RelayChanged, is_running=False)
    until(lambda: rig.reports[ROBOT].count(RelayChanged) == 3, "the relay runs again")
    until(lambda: rig.relays[ROBOT].pid not in (None, pid), "another process")
    before = len(app.back)
    until(lambda: app.put() or len(app.back) > before, "the stream flows again")


@pytest.mark.long
@pytest.mark.parametrize("stream_class", [StreamClass.RELIABLE, StreamClass.LATEST])
@pytest.mark.parametrize("times", [1, 2])
def test_an_owner_that_heard_a_relay_that_was_killed_drains_all_the_same(
    rig: Rig, stream_class: StreamClass, times: int
) -> None:
    """It waits for the end of all that it has heard: of a relay's life that another one has followed nothing comes."""
    first, second = (slot(epoch, f"edge{epoch}", stream_class, 0) for epoch in (1, 2))
    rig.start_worker("edge1")
    rig.start_worker("edge2")
    app = Application(rig.app)
    rig.move(first)
    thread = app.flow(100, 20)
    for _ in range(times):
        pid = rig.relays[ROBOT].pid
        assert pid is not None
        os.kill(pid, signal.SIGKILL)
        until(lambda pid=pid: rig.relays[ROBOT].pid not in (None, pid), "another relay")  # type: ignore[misc]
        before = len(app.back)
        until(lambda before=before: len(app.back) > before + 20, "the stream flows again")  # type: ignore[misc]
    rig.prepare(second, first)
    rig.flip(second, first)
    rig.wait(SlotDrained, 5.0, task=TASK, epoch=1)
    rig.plan(RoutePhase.CLOSE, second)
    until(lambda: app.nodes[-1] == "edge2", "answers of the next owner")
    app.halt(thread)


def test_a_stream_does_not_hang_on_the_relay_beside_the_worker(rig: Rig) -> None:
    rig.start_worker("edge1")
    rig.start_worker("edge2")
    app = Application(rig.app)
    slots = [slot(epoch, f"edge{2 - epoch % 2}", StreamClass.RELIABLE, 0) for epoch in (1, 2, 3)]
    rig.move(slots[0])
    thread = app.flow(200, 20)
    os.kill(rig.relays["edge1"].pid or 0, signal.SIGKILL)
    until(lambda: rig.reports["edge1"].count(RelayChanged) == 3, "edge1's relay runs again")
    rig.move(slots[1], slots[0])
    rig.move(slots[2], slots[1])  # edge1's worker hears its roles from the new relay
    until(lambda: app.nodes[-1] == "edge1", "the stream through edge1 again")
    app.halt(thread)

    def dropped() -> int:
        return sum(rig.drops().values())  # on a busy machine a worker may look stalled

    until(lambda: len(app.back) + dropped() >= app.sent, "every sample back, or its drop counted")
    assert app.back == sorted(set(app.back))
    between(-1, dropped(), 1)


def test_a_foreign_worker_needs_only_its_subscription(rig: Rig) -> None:
    app = Application(rig.app)
    foreign = zenoh.open(zenoh.Config.from_json5(worker_config(connect=(rig.endpoint("edge1"),))))
    try:
        got: list[bytes] = []
        target = slot(1, "edge1", StreamClass.LATEST, 1, ReadyWhen.MATCHING)
        rig.plan(RoutePhase.PREPARE, target)
        until(app.connected, "the application sees the relay's subscription")
        app.put()
        until(lambda: rig.told(f"{TASK}/in/0").messages, "the relay has the value, and has looked at the slot since")
        assert not rig.reports[ROBOT].find(SlotReady, epoch=1)
        foreign.declare_subscriber(f"edge1/{TASK}/{ROBOT}/in", lambda sample: got.append(sample.payload.to_bytes()))
        rig.wait(SlotReady, epoch=1, is_ready=True)
        rig.plan(RoutePhase.FLIP, target)
        rig.wait(SlotFlipped, epoch=1)
        until(lambda: got == [b"0 "], "the kept value as warm-up")
        app.put()
        app.put()
        until(lambda: got == [b"0 ", b"1 ", b"2 "], "both, once each: class latest waits instead of dropping")
    finally:
        foreign.close()


@pytest.mark.parametrize("stream_class", StreamClass)
def test_what_a_foreign_worker_was_sent_is_unconfirmed_and_never_dropped(rig: Rig, stream_class: StreamClass) -> None:
    """It acknowledges nothing; a move used to count all it had been sent, and had answered, as dropped (closed)."""
    app = Application(rig.app)
    foreign = zenoh.open(zenoh.Config.from_json5(worker_config(connect=(rig.endpoint("edge1"),))))
    try:
        got: list[str] = []
        for edge in ("edge1", "edge2"):
            foreign.declare_subscriber(f"{edge}/{TASK}/{ROBOT}/in", lambda sample: got.append(str(sample.key_expr)))
        keep_last = 1 if stream_class is StreamClass.LATEST else 0
        first, second = (
            slot(number, f"edge{number}", stream_class, keep_last, ReadyWhen.MATCHING) for number in (1, 2)
        )
        rig.move(first)
        until(app.connected, "the application sees the relay's subscription")
        for count in range(1, 41):
            app.put()
            until(lambda count=count: len(got) == count, f"{count} of them")  # type: ignore[misc]
        rig.move(second, first, drains=False)
        app.put()
        until(lambda: f"edge2/{TASK}/{ROBOT}/in" in got, "the next owner")
        until(lambda: rig.told(f"{TASK}/in/0").unconfirmed == len(got), "as many unconfirmed as sent")
        told = rig.told(f"{TASK}/in/0")
        assert (told.drops, told.lost, told.at_most_lost, told.acknowledged) == ((), 0, 0, None)
    finally:
        foreign.close()


@pytest.mark.parametrize("stream_class", StreamClass)
def test_what_comes_before_the_first_owner_is_counted(rig: Rig, stream_class: StreamClass) -> None:
    """A task whose worker never gets ready has no owner, no plan and no slot: its robot's inputs count all the same."""
    now = slot(1, "edge1", stream_class, 1)
    rig.relays[ROBOT].watch(WorkerWatch(task=TASK, unowned=now.routes[:1]))
    app = Application(rig.app)
    until(app.connected, "the application sees the relay's subscription")
    for _ in range(160):
        app.put()
    until(lambda: rig.told(f"{TASK}/in/0").messages == 160, "the relay counts")
    told = rig.told(f"{TASK}/in/0")
    if stream_class is StreamClass.LATEST:
        assert (told.drops, told.unsent) == ((), 160)
    else:
        assert told.drops == (("no_route", 160),)
    rig.assert_nothing_is_unaccounted()
    rig.start_worker("edge1")
    rig.move(now)
    app.put()
    until(lambda: app.back, "the first owner answers")
    until(lambda: rig.told(f"{TASK}/in/0").messages == 161, "the same stream goes on")
    rig.assert_nothing_is_unaccounted()


def test_a_key_that_the_worker_does_not_take_is_told(rig: Rig) -> None:
    """Its token is there, so what is missing has to be named."""
    now = slot(1, "edge1", StreamClass.RELIABLE, 1)
    wrong = replace(now, routes=(replace(now.routes[0], to_expr="edge1/wrongkey/robot1/in"), *now.routes[1:]))
    rig.plan(RoutePhase.PREPARE, wrong)
    rig.wait(SlotReady, epoch=1, is_ready=False, has_token=False, untaken=("edge1/wrongkey/robot1/in",))
    rig.start_worker("edge1")
    rig.wait(SlotReady, epoch=1, is_ready=False, has_token=True, untaken=("edge1/wrongkey/robot1/in",))
    session = rig.app
    taken = session.declare_subscriber("edge1/wrongkey/robot1/in", lambda _sample: None)
    rig.wait(SlotReady, epoch=1, is_ready=True)
    taken.undeclare()
