"""Applications of one robot that receive the same output: a frozen or slow one loses its own samples, nobody else's."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from support.readers import Reader
from support.relay_rig import ROBOT, Application, Rig, relay_rig, slot
from support.waiting import POLL_S, TooSlowError, between, until, within
from zsched.core.values.fleet import Timing
from zsched.core.values.plan import StreamClass
from zsched.link.sessions.config import client_config

pytestmark = pytest.mark.long

READER = """
import sys, time
import zenoh

pause_s, config = float(sys.argv[1]), sys.argv[2]
with zenoh.open(zenoh.Config.from_json5(config)) as session:
    subscriber = session.declare_subscriber("robot1/out", zenoh.handlers.FifoChannel(16))
    print("there", flush=True)
    for sample in subscriber:
        time.sleep(pause_s)
        print(sample.payload.to_bytes()[:20].split(b" ")[0].decode(), flush=True)
"""
PATIENT = Timing(zenoh_lease_s=20.0)
"""A frozen reader is not helped by the end of its lease."""


def reading(rig: Rig, name: str, pause_s: float = 0.0) -> Reader:
    config = client_config(connect=(rig.endpoint(ROBOT),), timing=PATIENT)
    return Reader(READER, rig.folder / name, str(pause_s), config)


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    with relay_rig(tmp_path, PATIENT) as made:
        made.start_worker("edge1")
        yield made


class Healthy(Application):
    """The application that asks, and notes when the answers came."""

    def __init__(self, session: Any) -> None:
        self.times: list[float] = []
        super().__init__(session)

    def _take(self, sample: Any) -> None:
        super()._take(sample)
        self.times.append(time.monotonic())

    def longest_pause_s(self, since: float) -> float:
        times = [at for at in self.times if at >= since]
        return max((later - earlier for earlier, later in pairwise([since, *times])), default=0.0)


def healthy(rig: Rig, stream_class: StreamClass, size: int) -> Healthy:
    app = Healthy(rig.app)
    app.padding = bytes(size)
    rig.move(slot(1, "edge1", stream_class, 1))
    until(app.connected, "the application sees the relay's subscription")
    return app


def gets_all(got: Callable[[], int], sent: int) -> None:
    """Who is healthy gets everything, unless the machine is too busy for him to be: that is tried again."""
    end = time.monotonic() + 20.0
    while got() < sent:
        if time.monotonic() > end:
            raise TooSlowError(f"{got()} of {sent}")
        time.sleep(POLL_S)


@pytest.mark.parametrize(("hz", "size"), [(500, 20_000), (20, 1 << 20)], ids=["small", "large"])
def test_a_slow_application_loses_only_its_own(rig: Rig, hz: float, size: int) -> None:
    """It takes 100 of 500 a second, through full buffers: the others get everything, at the full rate."""
    app = healthy(rig, StreamClass.RELIABLE, size)
    other, slow = reading(rig, "other"), reading(rig, "slow", pause_s=5 / hz)
    try:
        began = time.monotonic()
        thread = app.stream(hz)
        until(lambda: time.monotonic() > began + 10, "ten seconds")
        app.halt(thread)
        gets_all(lambda: len(app.back), app.sent)
        gets_all(lambda: len(other.numbers), app.sent)
        assert app.back == other.numbers == list(range(app.sent))
        within(app.longest_pause_s(began), 2.0, "without an answer")
        until(lambda: dict(rig.told("echo/out/0").drops).get("slow_reader", 0) > 0, "what it missed is counted")
        assert "overflow" not in dict(rig.told("echo/out/0").drops)
        until(lambda: slow.numbers[-1] > app.sent - 2000, "the slow one goes on")
    finally:
        for reader in (other, slow):
            reader.end()


def test_a_slow_application_gets_the_newest_of_class_latest_in_the_end(rig: Rig) -> None:
    """What it was left behind for is made up for once it has room: the others may get that sample twice."""
    app = healthy(rig, StreamClass.LATEST, 100_000)
    slow = reading(rig, "slow", pause_s=0.03)
    try:
        thread = app.stream(200)
        began = time.monotonic()
        until(lambda: dict(rig.told("echo/out/0").drops).get("slow_reader", 0) > 0, "what it missed is counted")
        until(lambda: time.monotonic() > began + 6, "six seconds")
        app.halt(thread)
        until(lambda: app.back[-1] == app.sent - 1, "the newest answer")
        between(0.4, len(app.back) / app.sent, 1.01)  # more than twice what the slow one takes
        until(lambda: slow.numbers[-1] == app.sent - 1, "the newest answer at the slow reader")
        assert slow.numbers == sorted(slow.numbers)
    finally:
        slow.end()


@pytest.mark.parametrize(("hz", "size"), [(500, 2000), (20, 1 << 20)], ids=["small", "large"])
def test_a_frozen_application_delays_no_other(rig: Rig, hz: float, size: int) -> None:
    """It takes nothing for four seconds and more: the others get everything, with a short pause at most."""
    app = healthy(rig, StreamClass.RELIABLE, size)
    other, frozen = reading(rig, "other"), reading(rig, "frozen")
    try:
        thread = app.stream(hz)
        until(lambda: len(app.back) > 20 and len(frozen.numbers) > 20, "the stream")
        frozen.process.send_signal(signal.SIGSTOP)
        began = time.monotonic()
        until(lambda: time.monotonic() > began + 6, "six seconds")
        app.halt(thread)
        print(f"\nlongest pause {app.longest_pause_s(began):.2f} s, {rig.told('echo/out/0').drops}")
        until(lambda: len(app.back) >= app.sent, "every answer")
        until(lambda: len(other.numbers) >= app.sent, "every answer at the other reader, too")
        assert app.back == other.numbers == list(range(app.sent))
        within(app.longest_pause_s(began), 2.0, "without an answer")
        until(lambda: dict(rig.told("echo/out/0").drops).get("slow_reader", 0) > 0, "what it missed is counted")
        assert "overflow" not in dict(rig.told("echo/out/0").drops)
    finally:
        for reader in (other, frozen):
            reader.end()
