"""Class reliable when links break and workers freeze or die: what is sent again, what is reported, who waits."""

from __future__ import annotations

import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import zenoh

from support.beside import COUPLED, Beside
from support.relay_rig import BESIDE, FLEET, ROBOT, TASK, Application, Rig, relay_rig, slot
from support.sessions import matches
from support.waiting import until, within
from zsched.core.values import codec as wire
from zsched.core.values.plan import ReadyWhen, RoutePhase, RoutePlan, StreamClass, StreamCount
from zsched.core.values.relay_protocol import SlotLost, StreamAck, StreamAcks, WorkerSeen
from zsched.link.keyspace import Keyspace
from zsched.link.sessions.config import worker_config

WHAT_FITS = 5500
"""Of 10 kB: in flight 1677 (16 MiB), in the queue 1024, before it 256, the rest in sockets and at the worker."""
MORE_THAN_FITS = 7000
FORGED, FAR = 400, 100_000


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    with relay_rig(tmp_path) as made:
        yield made


def told(rig: Rig, stream: str = "echo/in/0") -> StreamCount:
    return rig.told(stream)


def through(rig: Rig, stream_class: StreamClass = StreamClass.RELIABLE) -> tuple[Any, Any]:
    """An application whose samples go through edge1 and come back."""
    first = slot(1, "edge1", stream_class, 1)
    app = Application(rig.app)
    rig.move(first)
    until(app.connected, "the application sees the relay's subscription")
    return app, first


def freeze(rig: Rig, worker: subprocess.Popen[bytes]) -> None:
    """Stop a worker for longer than the lease: its link is closed, its token goes."""
    worker.send_signal(signal.SIGSTOP)
    rig.wait(WorkerSeen, is_present=False)


def test_what_a_frozen_worker_missed_reaches_it_when_it_wakes_up(rig: Rig) -> None:
    """Longer than the lease: its link is closed, whatever was on its way is gone, and is sent again, both ways."""
    worker = rig.start_worker("edge1")
    app, _ = through(rig)
    thread = app.stream(200)
    until(lambda: len(app.back) > 50, "the stream through edge1")
    freeze(rig, worker)
    worker.send_signal(signal.SIGCONT)
    before = len(app.back)
    until(lambda: len(app.back) > before + 50, "the stream again")
    app.halt(thread)
    until(lambda: len(app.back) >= app.sent, "every answer")
    until(lambda: told(rig).acknowledged == app.sent, "every sample processed, and once")
    assert app.back == list(range(app.sent))
    assert (told(rig).in_flight, told(rig).lost) == (0, 0)
    until(lambda: told(rig, "echo/out/0").messages >= app.sent, "the counters of the answers")
    answers = told(rig, "echo/out/0")
    assert (answers.lost, answers.doubled, answers.reordered) == (0, 0, 0)


def test_an_acknowledgement_from_another_session_takes_nothing_from_what_is_kept(rig: Rig) -> None:
    """In the worker's name, of all that is on its way to it, while it stands still: it is sent that all the same."""
    worker = rig.start_worker("edge1")
    app, _ = through(rig)
    put: list[zenoh.Sample] = []
    recorder = rig.app.declare_subscriber(f"edge1/{TASK}/{ROBOT}/in", put.append)
    until(lambda: app.put() or (put and app.back), "the stream through edge1, seen by a stranger")
    until(lambda: told(rig).acknowledged == app.sent, "every acknowledgement so far")
    before, app.padding = app.sent, bytes(5000)  # more than sockets hold: something is lost with the link
    worker.send_signal(signal.SIGSTOP)
    for _ in range(300):
        app.put()
    rig.wait(WorkerSeen, is_present=False)
    info = put[-1].source_info
    assert info is not None
    count = info.source_sn + 1
    assert count > before
    forged = StreamAck(eid=info.source_id.eid, first=0, arrived=count, processed=count)
    key = Keyspace(FLEET).ack("edge1", TASK, rig.incarnation, str(info.source_id.zid))
    rig.app.put(key, wire.encode(StreamAcks(acks=(forged,))))
    until(lambda: told(rig).acknowledged == count, "the forged word is taken for the worker's")
    recorder.undeclare()
    worker.send_signal(signal.SIGCONT)
    until(lambda: len(app.back) == app.sent, "every answer")
    assert app.back == list(range(app.sent))
    until(lambda: told(rig).acknowledged == app.sent, "every acknowledgement")
    assert (told(rig).lost, told(rig).at_most_lost, told(rig).drops) == (0, 0, ())


def test_who_names_anothers_publisher_under_a_key_of_its_own_says_nothing_of_that_ones_stream(rig: Rig) -> None:
    """Rules bind the key to the member's certificate, and not the publisher that it names in a sample."""
    rig.start_worker("edge1")
    app, _ = through(rig)
    put: list[zenoh.Sample] = []
    recorder = rig.app.declare_subscriber(f"edge1/{TASK}/{ROBOT}/in", put.append)
    until(lambda: app.put() or (put and app.back), "the stream through edge1, seen by a member")
    for _ in range(FORGED):
        app.put()
        info = put[-1].source_info
        assert info is not None
        source = zenoh.SourceInfo(info.source_id, info.source_sn + FAR)
        rig.app.put(
            f"edge1/{TASK}/other/in", b"x", source_info=source, congestion_control=zenoh.CongestionControl.BLOCK
        )
        time.sleep(0.005)  # the rate of a stream: what is wrongly asked for again is sent again
    until(lambda: len(app.back) == app.sent, "every answer")
    until(lambda: told(rig).acknowledged == app.sent, "every acknowledgement")
    recorder.undeclare()
    assert app.back == list(range(app.sent))
    assert (told(rig).doubled, told(rig).replayed, told(rig).lost) == (0, 0, 0)


def test_the_newest_answer_of_a_frozen_worker_reaches_its_robot(rig: Rig) -> None:
    """Class latest: whatever it answers while its link is closed, the newest is sent again."""
    worker = rig.start_worker("edge1", "--latest")
    app, _ = through(rig, StreamClass.LATEST)
    thread = app.stream(200)
    until(lambda: len(app.back) > 50, "the stream through edge1")
    freeze(rig, worker)
    app.halt(thread)  # nothing newer will come to its rescue
    worker.send_signal(signal.SIGCONT)
    until(lambda: app.back[-1] == app.sent - 1, "the newest sample")
    assert app.back == sorted(app.back)
    assert len(app.back) - len(set(app.back)) <= 1  # its ready token came back: the kept value is sent to be sure


def test_a_killed_worker_leaves_at_most_what_is_reported(rig: Rig) -> None:
    worker = rig.start_worker("edge1", "--delay-ms", "5")
    rig.start_worker("edge2")
    app, first = through(rig)
    thread = app.stream(400)
    until(lambda: len(app.back) > 50, "the stream through edge1")
    worker.kill()
    worker.wait(60)
    second = slot(2, "edge2", StreamClass.RELIABLE, 1)
    rig.move(second, first, drains=False)
    until(lambda: app.nodes[-1] == "edge2", "the stream through edge2")
    app.halt(thread)
    until(lambda: app.back[-1] == app.sent - 1, "the newest sample")
    report = rig.wait(SlotLost, epoch=1)
    lost = app.sent - len(set(app.back))
    assert app.back == sorted(set(app.back))
    assert 0 < lost <= report.samples
    until(lambda: told(rig).at_most_lost == report.samples, "the same in the counters")


def test_a_worker_that_restarts_in_place_is_not_sent_what_its_former_life_may_have_done(rig: Rig) -> None:
    worker = rig.start_worker("edge1", "--delay-ms", "5")
    app, _ = through(rig)
    thread = app.stream(400)
    until(lambda: len(app.back) > 50, "the stream through edge1")
    worker.kill()
    worker.wait(60)
    rig.start_worker("edge1")
    before = len(app.back)
    until(lambda: len(app.back) > before + 50, "the stream through its second life")
    app.halt(thread)
    until(lambda: app.back[-1] == app.sent - 1, "the newest sample")
    assert app.back == sorted(set(app.back))
    until(lambda: told(rig).at_most_lost >= app.sent - len(app.back), "what may be lost")
    left = rig.wait(SlotLost, epoch=1).samples
    until(lambda: told(rig).at_most_lost == left > 0, "the log's line says as much as the counters")
    assert rig.reports[ROBOT].count(SlotLost) == 1, "once for each death"


@contextmanager
def stream_beside(rig: Rig) -> Iterator[Beside]:
    """A second task's stream through the same relay, of another process, to a plain zenoh program."""
    way = replace(slot(1, "edge2", StreamClass.RELIABLE, 0, ReadyWhen.MATCHING), routes=(BESIDE,))
    beside = Beside(
        near=rig.endpoint(ROBOT), far=rig.endpoint("edge2"), from_expr=BESIDE.from_expr, to_expr=BESIDE.to_expr
    )
    try:
        for phase in (RoutePhase.PREPARE, RoutePhase.FLIP):
            rig.relays[ROBOT].apply(RoutePlan(task="beside", phase=phase, current=way))
        until(lambda: beside.arrivals, "the live stream flows")
        yield beside
    finally:
        beside.close()


def test_a_stalled_workers_full_queue_delays_no_other_stream(rig: Rig) -> None:
    """A frozen worker is not waited for: what its queue does not hold is dropped and counted, the rest flows."""
    frozen = rig.start_worker("edge1")
    app, _ = through(rig)
    app.padding = bytes(500_000)
    with stream_beside(rig) as beside:
        thread = app.stream(100)
        until(lambda: len(app.back) > 20, "the stream through edge1")
        frozen.send_signal(signal.SIGSTOP)
        until(lambda: dict(told(rig).drops).get("overflow", 0) > 0, "its queue is full")
        before = len(beside.arrivals)
        until(lambda: len(beside.arrivals) > before + 100, "the stream beside goes on, and the application too")
        app.halt(thread)
        within(beside.longest_gap(), 0.9, "without a sample")


@pytest.mark.long
def test_a_slow_workers_full_queue_slows_its_own_application_and_no_other(rig: Rig) -> None:
    """Back-pressure is the link's: what else this application sends waits, too, and comes; another one's flows."""
    rig.start_worker("edge1", "--delay-ms", "1")
    first = slot(1, "edge1", StreamClass.RELIABLE, 0)
    shallow = replace(first.routes[0].settings, depth=1)
    rig.move(replace(first, routes=tuple(replace(route, settings=shallow) for route in first.routes)))
    app = Application(rig.app)
    until(app.connected, "the application sees the relay's subscription")
    app.padding = bytes(10_000)
    coupled: list[int] = []
    with stream_beside(rig) as beside:
        beside.on_coupled(lambda: coupled.append(len(app.back)))
        also = rig.app.declare_publisher(BESIDE.from_expr, congestion_control=zenoh.CongestionControl.BLOCK)
        until(lambda: matches(also), "the relay takes the application's other stream, too")
        for _ in range(MORE_THAN_FITS):
            app.put()
        also.put(COUPLED.encode())  # behind all of them on the same link
        until(lambda: coupled, "the application's other stream", deadline_s=60.0)
        dropped = rig.drops()["overflow"]  # on a busy machine the worker may have looked stalled
        assert coupled[0] + dropped > MORE_THAN_FITS - WHAT_FITS
        until(lambda: len(app.back) + rig.drops()["overflow"] >= app.sent, "every answer", deadline_s=60.0)
        assert app.back == sorted(set(app.back))
        within(beside.longest_gap(), 0.9, "without a sample")


@pytest.mark.parametrize("stream_class", [StreamClass.RELIABLE, StreamClass.LATEST])
def test_a_stalled_worker_delays_no_other_robots_stream(rig: Rig, stream_class: StreamClass) -> None:
    """Two tasks through one relay; one owner is frozen under 20 MB/s. The other stream's longest gap stays small."""
    options = ["--latest"] if stream_class is StreamClass.LATEST else []
    frozen = rig.start_worker("edge1", *options)
    app, _ = through(rig, stream_class)
    app.padding = bytes(200_000)
    beside = replace(slot(1, "edge2", StreamClass.RELIABLE, 0, ReadyWhen.MATCHING), routes=(BESIDE,))
    arrivals: list[float] = []
    foreign = zenoh.open(zenoh.Config.from_json5(worker_config(connect=(rig.endpoint("edge2"),))))
    halt = threading.Event()
    try:
        foreign.declare_subscriber(BESIDE.to_expr, lambda _: arrivals.append(time.monotonic()))
        for phase in (RoutePhase.PREPARE, RoutePhase.FLIP):
            rig.relays[ROBOT].apply(RoutePlan(task="beside", phase=phase, current=beside))
        source = rig.app.declare_publisher(BESIDE.from_expr)
        until(lambda: source.put(b"x") or arrivals, "the live stream flows")

        def put() -> None:
            while not halt.wait(0.005):
                source.put(b"x")

        live = threading.Thread(target=put)
        live.start()
        thread = app.stream(100)
        until(lambda: len(app.back) > 20, "the stream through edge1")
        freeze(rig, frozen)
        before = len(arrivals)
        until(lambda: len(arrivals) > before + 100, "the live stream goes on behind the lease, too")
        app.halt(thread)
        halt.set()
        live.join(60)
        gaps = [later - earlier for earlier, later in pairwise(arrivals)]
        assert len(gaps) > 200
        within(max(gaps[10:]), 0.9, "without a sample")
    finally:
        halt.set()
        foreign.close()


@pytest.mark.parametrize("mib", [40, 70])
def test_a_sample_larger_than_every_bound_is_carried_alone(rig: Rig, mib: int) -> None:
    """Above what queues hold (64 MiB), and above what is kept of answers (32 MiB): there and back, and counted once.

    While a put takes longer than a link's patience, as on a busy machine, what is behind it gives way and is counted.
    """
    rig.start_worker("edge1")
    app, _ = through(rig)
    app.put()
    until(lambda: len(app.back) == 1, "a small one")
    app.padding = bytes(mib << 20)
    for _ in range(2):
        app.put()
    app.padding = b""
    app.put()
    until(lambda: len(app.back) + rig.drops()["overflow"] == 4, "all of them", 60)
    assert app.back[:2] == [0, 1]
    assert app.back == sorted(set(app.back))
    until(lambda: told(rig).acknowledged == len(app.back), "every sample processed")
    assert set(rig.drops()) <= {"overflow"}
