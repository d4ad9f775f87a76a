"""An application that stands still (SIGSTOP) and goes on: it misses nothing on a side of its own, and never uncounted.

Real relays and workers; the application that stops is a process with a plain zenoh subscriber.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest
import zenoh

from support.readers import Reader
from support.relay_rig import FLEET, ROBOT, Application, Rig, slot
from support.waiting import free_endpoint, until, within
from zsched.core.values.fleet import LocalMode, LocalSide, Timing
from zsched.core.values.plan import StreamClass
from zsched.link.sessions.config import client_config, local_config
from zsched.runtime.relay.streams import RelayHandle
from zsched_lab.fleet.relays import hello_of

pytestmark = pytest.mark.long

READER = """
import sys, time
import zenoh

config = zenoh.Config.from_json5(sys.argv[1])
with zenoh.open(config) as session:
    subscriber = session.declare_subscriber(
        "robot1/out", lambda sample: print(sample.payload.to_bytes()[:20].split(b" ")[0].decode(), flush=True)
    )
    print("there", flush=True)
    time.sleep(600)
"""
HZ = 100.0
TRIES = 5
MINUTE = Timing(zenoh_lease_s=60.0)
"""What the guide lets an application announce."""


@dataclass
class Host(Rig):
    """The robot, with a side of its own for its applications."""

    side: str = field(default_factory=free_endpoint)

    def handle(self, node: str, text: str) -> RelayHandle:
        local = local_config(LocalSide(mode=LocalMode.PEER, listen=(self.side,)), timing=self.timing)
        return RelayHandle(
            hello=hello_of(FLEET, node),
            path=self.folder / f"{node}.relay",
            zenoh_config=text,
            on_report=self.reports[node].add,
            local_config=local if node == ROBOT else "",
        )

    def application_config(self) -> str:
        return client_config(connect=(self.side,), timing=MINUTE, connect_s=20.0)


def stop_for(reader: Reader, seconds: float) -> None:
    reader.process.send_signal(signal.SIGSTOP)
    until_s = time.monotonic() + seconds
    until(lambda: time.monotonic() > until_s, "the standstill", seconds + 5)
    reader.process.send_signal(signal.SIGCONT)


class Timed(Application):
    """The application that asks, and how long it was without an answer."""

    longest_s = 0.0
    _last: float | None = None

    def _take(self, sample: zenoh.Sample) -> None:
        super()._take(sample)
        now = time.monotonic()
        self.longest_s = max(self.longest_s, now - (self._last or now))
        self._last = now


def only_asks(app: Application) -> Application:
    """The application does not subscribe any more."""
    app._subscriber.undeclare()
    return app


@pytest.fixture
def host(tmp_path: Path) -> Iterator[Host]:
    with Host(tmp_path) as made:
        made.start_worker("edge1")
        yield made
        made.assert_nothing_is_unaccounted()


def flowing(rig: Rig, app: Application, size: int) -> None:
    app.padding = bytes(size)
    rig.move(slot(1, "edge1", StreamClass.RELIABLE, 1))
    until(app.connected, "the application sees the relay's subscription")


@pytest.mark.parametrize(("stop_s", "size", "is_alone"), [(20.0, 4096, True), (12.0, 100, False)])
def test_one_that_stops_misses_nothing(host: Host, stop_s: float, size: int, *, is_alone: bool) -> None:
    """What its socket does not hold waits in the relay, where nobody else receives the stream."""
    app = Timed(host.app)
    if is_alone:
        only_asks(app)
    flowing(host, app, size)
    reader = Reader(READER, host.folder / "reader", host.application_config())
    try:
        thread = app.stream(HZ)
        until(lambda: len(reader.numbers) > 3 * HZ, "the stream")
        stop_for(reader, stop_s)
        until(lambda: reader.numbers[-1] > app.sent - 20, "it has caught up")
        app.halt(thread)
        until(lambda: reader.numbers[-1] == app.sent - 1, "every answer")
        assert reader.numbers == list(range(reader.numbers[0], app.sent))
        assert host.told("echo/out/0").drops == ()
        within(app.longest_s, 1.0, "without an answer")
    finally:
        reader.end()


def test_what_one_on_the_fleets_own_side_misses_is_counted(tmp_path: Path) -> None:
    """There the relay's lease is short, and whoever wakes behind it ends its link."""
    with Rig(tmp_path) as rig:
        rig.start_worker("edge1")
        app = Application(rig.app)
        flowing(rig, app, 100)
        reader = Reader(READER, tmp_path / "reader", client_config(connect=(rig.endpoint(ROBOT),), timing=MINUTE))

        def missed() -> int:
            return app.sent - reader.numbers[0] - len(reader.numbers)

        try:
            thread = app.stream(HZ)
            for _ in range(TRIES):  # now and then zenoh reads first, and its link stays
                until(lambda: reader.numbers[-1:] > [app.sent - 20], "it goes on")
                stop_for(reader, 3.0)
                until(lambda: reader.numbers[-1] > app.sent - 20, "it goes on")
                if missed() > 2 * HZ:
                    break
            app.halt(thread)
            # The newest answer may be among those that it missed, so it is not waited for.
            until(lambda: dict(rig.told("echo/out/0").drops).get("slow_reader", 0) >= missed(), "what it missed")
            assert missed() > 2 * HZ, "it ended its link"
        finally:
            reader.end()
