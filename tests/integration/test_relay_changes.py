"""The relay's part of a changed fleet file: streams that differ close and open, all others run on; a task ends."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import zenoh

from support.relay_rig import BESIDE, ROBOT, TASK, Application, Rig, relay_rig, slot
from support.sessions import matches
from support.waiting import until
from zsched.core.values.plan import ReadyWhen, RoutePhase, StreamClass
from zsched.core.values.plan import Slot as OneSlot
from zsched.core.values.relay_protocol import WorkerWatch


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    with relay_rig(tmp_path) as made:
        yield made


def streams(rig: Rig) -> set[str]:
    return {count.stream for count in rig.counts()}


def test_a_stream_comes_and_goes_within_an_epoch_and_the_others_lose_nothing(rig: Rig) -> None:
    rig.start_worker("edge1")
    app = Application(rig.app)
    first = slot(1, "edge1", StreamClass.RELIABLE, 1)
    rig.move(first)
    thread = app.flow(200, 50)
    more: OneSlot = replace(first, routes=(*first.routes, replace(BESIDE, stream=f"{TASK}/in/1")))
    for changed, named in ((more, True), (first, False)) * 3:
        rig.plan(RoutePhase.CLOSE, changed)
        until(lambda named=named: (f"{TASK}/in/1" in streams(rig)) is named, "the stream comes, or goes")  # type: ignore[misc]
        before = len(app.back)
        until(lambda before=before: len(app.back) > before + 20, "the other stream runs on")  # type: ignore[misc]
    app.halt(thread)
    until(lambda: len(app.back) == app.sent, "every answer")
    assert app.back == list(range(app.sent))
    until(lambda: rig.told(f"{TASK}/in/0").acknowledged == app.sent, "every sample is acknowledged, and once")
    count = rig.told(f"{TASK}/in/0")
    assert (count.lost, count.at_most_lost, count.drops) == (0, 0, ())


def test_streams_go_on_when_their_owner_counts_as_ready_by_another_rule(rig: Rig) -> None:
    rig.start_worker("edge1")
    app = Application(rig.app)
    first = slot(1, "edge1", StreamClass.RELIABLE, 1)
    rig.move(first)
    thread = app.flow(200, 50)
    for ready_when in (ReadyWhen.MATCHING, ReadyWhen.TOKEN):
        rig.plan(RoutePhase.CLOSE, replace(first, ready_when=ready_when))
        before = app.sent
        until(lambda before=before: app.back[-1] > before + 100, f"answers go on with {ready_when}")  # type: ignore[misc]
    app.halt(thread)


def test_an_input_that_changes_while_nobody_owns_its_task_is_followed(rig: Rig) -> None:
    route = slot(1, "edge1", StreamClass.RELIABLE, 1).routes[0]
    rig.relays[ROBOT].watch(WorkerWatch(task=TASK, unowned=(route,)))
    app = Application(rig.app)
    until(app.connected, "the application sees the relay's subscription")
    other = replace(route, from_expr=f"{ROBOT}/other")
    rig.relays[ROBOT].watch(WorkerWatch(task=TASK, unowned=(other,)))
    until(lambda: not app.connected(), "nobody takes the key of before")
    publisher = rig.app.declare_publisher(other.from_expr, congestion_control=zenoh.CongestionControl.BLOCK)
    until(lambda: matches(publisher), "the relay subscribes to the new key")
    publisher.put(b"x")
    until(lambda: rig.told(route.stream).messages == 1, "it is counted")


def test_a_task_that_ends_leaves_nothing_and_may_begin_again(rig: Rig) -> None:
    rig.start_worker("edge1")
    app = Application(rig.app)
    rig.move(slot(1, "edge1", StreamClass.RELIABLE, 1))
    until(app.connected, "the application sees the relay's subscription")
    rig.relays[ROBOT].end(TASK)
    until(lambda: not app.connected(), f"nobody takes {ROBOT}'s input any more")
    until(lambda: not streams(rig), "no stream is counted")
    rig.move(slot(2, "edge1", StreamClass.RELIABLE, 1))
    thread = app.flow(100, 10)
    app.halt(thread)
