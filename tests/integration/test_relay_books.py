"""The books of a robot's streams over the ends of its relay: every sample that came in is in one counter.

Real relays and a real worker; the robot's relay is killed, hangs, is replaced in order or left by its daemon.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from support.books import newest_counts
from support.relay_rig import FLEET, ROBOT, TASK, Application, Rig, slot
from support.waiting import until
from zsched.adapters.relay.streams import Bequest, RelayHandle
from zsched.core.events import RelayChanged, StreamsCounted
from zsched.core.hop.books import given_up
from zsched.core.values.plan import Route, RoutePhase, RoutePlan, Slot, StreamClass, StreamCount
from zsched.core.values.struct import replace
from zsched.ipc.takeover import Door

IN = f"{TASK}/in/0"
SLOT = slot(1, "edge1", StreamClass.RELIABLE, 0)


@dataclass
class Booked(Rig):
    """A rig whose robot's relay may outlive its daemon."""

    incarnations: int = 0
    text: str = ""
    left: list[RelayHandle] = field(default_factory=list)

    def handle(self, node: str, text: str) -> RelayHandle:
        if node != ROBOT:
            return super().handle(node, text)
        self.text = text
        return self._daemon("fleet")

    def _daemon(self, digest: str) -> RelayHandle:
        self.incarnations += 1
        bequest = Bequest(door=Door(self.folder, ROBOT), orphan_s=30.0, incarnation=self.incarnations, digest=digest)
        add = self.reports[ROBOT].add
        return RelayHandle(fleet=FLEET, node=ROBOT, zenoh_config=self.text, on_report=add, bequest=bequest)

    def next_daemon(self, digest: str) -> None:
        """The daemon begins again; by another digest its relay is replaced."""
        self.relays[ROBOT].leave()
        self.left.append(self.relays[ROBOT])
        self.relays[ROBOT] = self._daemon(digest)
        self.relays[ROBOT].start()

    def came_back(self, app: Application, pid: int) -> None:
        """Another relay runs, and the stream flows through it."""
        until(lambda: self.relays[ROBOT].pid not in (None, pid), "another relay")
        before = len(app.back)
        until(lambda: len(app.back) > before + 20, "the stream flows again")

    @property
    def input(self) -> StreamCount:
        return self.told(IN)


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Booked]:
    with Booked(tmp_path) as made:
        yield made
        made.assert_nothing_is_unaccounted()


@pytest.fixture
def app(rig: Booked) -> Application:
    rig.start_worker("edge1")
    made = Application(rig.app)
    rig.move(SLOT)
    return made


def carried(slot: Slot) -> RoutePlan:
    """The plan of a slot that is open and flipped to."""
    return RoutePlan(task=TASK, phase=RoutePhase.CLOSE, current=slot)


def pid_of(rig: Booked) -> int:
    pid = rig.relays[ROBOT].pid
    assert pid is not None
    return pid


def settle(rig: Booked, app: Application) -> StreamCount:
    """Wait until all that the relays have taken is known of; answers the counters then."""

    def is_settled() -> bool:
        count = rig.input
        is_counted = count.messages > 0 and not count.in_flight
        return is_counted and (count.acknowledged or 0) + given_up(count) == count.messages

    until(is_settled, "an account of every sample")
    found = rig.input
    assert found.messages <= app.sent
    return found


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP], ids=["killed", "hangs"])
def test_what_a_relay_had_when_it_was_killed_is_at_most_lost(
    rig: Booked, app: Application, how: signal.Signals
) -> None:
    """Its worker stands still meanwhile, so that much is in its hand; and it takes more before its next count."""
    thread = app.flow(400, 50)
    worker = rig.workers["edge1"]
    worker.send_signal(signal.SIGSTOP)
    until(lambda: (rig.input.in_flight or 0) > 100, "a count with samples in flight")
    pid, told = pid_of(rig), rig.input
    os.kill(pid, how)
    until(lambda: rig.reports[ROBOT].find(RelayChanged, is_running=False), "its end is seen")
    worker.send_signal(signal.SIGCONT)
    rig.came_back(app, pid)
    app.halt(thread)
    found = settle(rig, app)
    assert found.at_most_lost >= (told.in_flight or 0), "at least what it told of"
    assert found.messages > told.messages, "the counters go on"


def test_a_relay_that_is_replaced_in_order_leaves_exact_books(rig: Booked, app: Application) -> None:
    """The next daemon cannot go on with it: it lets arrive what is under way, and loses nothing that it has taken."""
    thread = app.flow(200, 200)
    until(lambda: rig.input.messages > 200, "a count of them")
    pid, told = pid_of(rig), rig.input
    rig.next_daemon("another fleet file")
    rig.relays[ROBOT].apply(carried(SLOT))
    rig.came_back(app, pid)
    app.halt(thread)
    found = settle(rig, app)
    assert found.at_most_lost == 0
    assert (found.acknowledged or 0) > (told.acknowledged or 0) + 20, "its last samples and those of the next one"
    assert given_up(found) <= app.sent - len(set(app.back)), "what is called lost is lost"


def test_a_relay_that_is_replaced_says_what_it_could_not_hand_over(rig: Booked, app: Application) -> None:
    """Its worker hangs: what it was sent is at most lost, what still waited is dropped, and said to be."""
    thread = app.flow(400, 50)
    rig.workers["edge1"].send_signal(signal.SIGSTOP)
    until(lambda: (rig.input.in_flight or 0) > 100, "a count with samples in flight")
    pid, told = pid_of(rig), rig.input
    rig.next_daemon("another fleet file")
    rig.relays[ROBOT].apply(carried(SLOT))
    until(lambda: rig.relays[ROBOT].pid not in (None, pid), "another relay")
    rig.workers["edge1"].send_signal(signal.SIGCONT)
    rig.came_back(app, pid)
    app.halt(thread)
    assert given_up(settle(rig, app)) >= (told.in_flight or 0)


def test_counters_go_on_over_relays_and_daemons(rig: Booked, app: Application) -> None:
    """A relay is killed; the next daemon goes on with its successor, which has the books of both."""
    thread = app.flow(200, 50)
    pid = pid_of(rig)
    os.kill(pid, signal.SIGKILL)
    rig.came_back(app, pid)
    app.halt(thread)
    before, pid = settle(rig, app), pid_of(rig)
    rig.next_daemon("fleet")
    rig.relays[ROBOT].apply(carried(SLOT))
    until(lambda: rig.relays[ROBOT].pid == pid, "the next daemon goes on with it")
    already = len(rig.reports[ROBOT].items)
    until(lambda: newest_counts(rig.reports[ROBOT].told()[already:]), "it counts for the next daemon")
    assert rig.input.messages == before.messages


def test_an_input_that_changes_takes_its_counters_along(rig: Booked, app: Application) -> None:
    """Another depth of its queue: it is opened again, and what it has counted stays."""
    thread = app.flow(200, 50)
    app.halt(thread)
    before = settle(rig, app)
    routes: tuple[Route, ...] = tuple(
        replace(route, settings=replace(route.settings, depth=3000)) for route in SLOT.routes
    )
    changed: Slot = replace(SLOT, routes=routes)
    counted = rig.reports[ROBOT].count(StreamsCounted)
    rig.relays[ROBOT].apply(carried(changed))
    until(lambda: rig.reports[ROBOT].count(StreamsCounted) > counted + 2, "counts since it was opened again")
    for _ in range(10):
        app.put()
    until(lambda: rig.input.messages >= before.messages + 10, "a count of them")
    found = settle(rig, app)
    assert found.messages == before.messages + 10
    assert (found.acknowledged or 0) >= (before.acknowledged or 0)
