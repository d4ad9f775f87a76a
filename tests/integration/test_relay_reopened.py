"""A relay opens its data session anew under a running stream: nothing is lost or doubled, the own side stays.

Real relays and workers. The daemon of the robot is replaced, as by one that begins anew, and wants another session.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from support.relay_rig import FLEET, ROBOT, TASK, Application, Reports, Rig, slot
from support.waiting import free_endpoint, until
from zsched.core.values.events import RelayChanged, SlotReady
from zsched.core.values.fleet import LocalMode, LocalSide
from zsched.core.values.plan import OnCrash, RoutePhase, Slot, StreamClass
from zsched.core.values.relay_protocol import RelayStarted
from zsched.link.sessions.config import client_config, data_config, local_config
from zsched.runtime.relay.streams import RelayHandle
from zsched_lab.fleet.relays import hello_of

HZ = 100.0
TIMES = 3


@dataclass
class Host(Rig):
    """The robot has a side of its own, and daemons one after the other."""

    side: str = field(default_factory=free_endpoint)
    daemons: int = 0
    threads: int = 6
    tasks: tuple[str, ...] = (TASK,)

    def handle(self, node: str, text: str) -> RelayHandle:
        if node != ROBOT:
            return super().handle(node, text)
        self.daemons += 1
        return RelayHandle(
            hello=hello_of(FLEET, ROBOT, threads=self.threads, tasks=self.tasks),
            path=self.folder / f"{ROBOT}.relay",
            zenoh_config=text,
            on_report=self.reports[ROBOT].add,
            local_config=local_config(LocalSide(mode=LocalMode.PEER, listen=(self.side,))),
        )

    def text(self) -> str:
        """Of a data session that is configured otherwise than the one before: nobody listens where it dials."""
        nobody = tuple(f"tcp/127.0.0.1:{9 + number}" for number in range(self.daemons))
        return data_config(listen=(self.endpoint(ROBOT),), connect=nobody, timing=self.timing, shared_memory=False)

    def application_config(self) -> str:
        return client_config(connect=(self.side,), connect_s=20.0)

    def begin_anew(self, plan: Slot) -> None:
        """Another daemon, whose data session is configured otherwise, comes to the relay and plans as before."""
        self.relays[ROBOT].leave()
        self.reports[ROBOT] = Reports()
        self.relays[ROBOT] = self.handle(ROBOT, self.text())
        self.relays[ROBOT].start()
        self.wait(RelayChanged, is_running=True)
        self.plan(RoutePhase.PREPARE, plan)
        self.wait(SlotReady, epoch=plan.epoch, is_ready=True)
        self.plan(RoutePhase.CLOSE, plan)


@pytest.fixture
def host(tmp_path: Path) -> Iterator[Host]:
    made = Host(folder=tmp_path)
    try:
        made.start()
        yield made
        made.assert_nothing_is_unaccounted()
    finally:
        made.stop()


def flowing(host: Host, only: Slot) -> tuple[Application, threading.Thread]:
    app = Application(host.app)
    host.start_worker("edge1")
    host.move(only)
    return app, app.flow(HZ, 20)


@pytest.mark.parametrize("on_crash", OnCrash)
def test_nothing_of_a_reliable_stream_is_lost_or_doubled(host: Host, on_crash: OnCrash) -> None:
    only = slot(1, "edge1", StreamClass.RELIABLE, 0, on_crash=on_crash)
    app, thread = flowing(host, only)
    relay, zids = host.relays[ROBOT].pid, {host.wait(RelayStarted).zid}
    for _ in range(TIMES):
        host.begin_anew(only)
        zids.add(host.wait(RelayStarted).zid)
        assert host.relays[ROBOT].pid == relay, "the process, and with it the host's own side, goes on"
        here = len(app.back)
        until(lambda here=here: len(app.back) > here + 20, "the stream goes on")  # type: ignore[misc]
    assert len(zids) == TIMES + 1, "each daemon has a session of its own"
    app.halt(thread)
    until(lambda: len(app.back) >= app.sent, f"{app.sent} answers, {len(app.back)} came")
    assert app.back == list(range(app.sent))
    counted = host.told(f"{TASK}/in/0")
    assert (counted.lost, counted.at_most_lost, dict(counted.drops)) == (0, 0, {})


@pytest.mark.parametrize("stream_class", [StreamClass.RELIABLE, StreamClass.LATEST])
def test_an_owner_that_heard_a_session_of_before_drains_all_the_same(host: Host, stream_class: StreamClass) -> None:
    """It waits for the end of all that it has heard: of what came by the session of before nothing else would come."""
    first, second = (slot(epoch, f"edge{epoch}", stream_class, 0) for epoch in (1, 2))
    app, thread = flowing(host, first)
    host.start_worker("edge2")
    until(lambda: len(app.back) > 20, "answers")
    host.begin_anew(first)
    here = len(app.back)
    until(lambda: len(app.back) > here + 20, "the stream goes on")
    host.move(second, first)
    app.halt(thread)


@pytest.mark.parametrize("stream_class", [StreamClass.BEST_EFFORT, StreamClass.LATEST])
def test_other_classes_carry_on(host: Host, stream_class: StreamClass) -> None:
    only = slot(1, "edge1", stream_class, 1)
    app, thread = flowing(host, only)
    host.begin_anew(only)
    here = len(app.back)
    until(lambda: len(app.back) > here + 20, "the stream goes on")
    app.halt(thread)
    until(lambda: app.back[-1] == app.sent - 1, "the newest one is back")


def test_a_slow_worker_finishes_what_it_has(host: Host) -> None:
    """A worker that is slow has time to do what it was sent before, as long as it comes further."""
    only = slot(1, "edge1", StreamClass.RELIABLE, 0)
    app = Application(host.app)
    host.start_worker("edge1", "--delay-ms", "40")
    host.move(only)
    until(app.connected, "the application sees the relay's subscription")
    for _ in range(100):  # 4 s of work: more than is waited for
        app.put()
    until(lambda: len(app.back) > 3, "the first answers")
    host.begin_anew(only)
    until(lambda: len(set(app.back)) == app.sent, f"{app.sent} answers, {len(app.back)} came")
    assert app.back == list(range(app.sent))


def test_a_fleet_that_has_outgrown_the_threads_gets_another_relay(host: Host) -> None:
    only = slot(1, "edge1", StreamClass.RELIABLE, 0)
    app, thread = flowing(host, only)
    relay = host.relays[ROBOT].pid
    host.threads += 1
    host.begin_anew(only)
    assert host.relays[ROBOT].pid != relay
    here = len(app.back)
    until(lambda: len(app.back) > here + 20, "the stream goes on")
    app.halt(thread)


def test_a_task_that_has_left_the_fleet_is_carried_no_more(host: Host) -> None:
    only = slot(1, "edge1", StreamClass.RELIABLE, 0)
    app, thread = flowing(host, only)
    host.relays[ROBOT].leave()
    host.reports[ROBOT] = Reports()
    host.tasks = ()
    host.relays[ROBOT] = host.handle(ROBOT, host.text())
    host.relays[ROBOT].start()
    host.wait(RelayChanged, is_running=True)
    until(lambda: not app.connected(), "the relay takes its input no more")
    app.halt(thread)
