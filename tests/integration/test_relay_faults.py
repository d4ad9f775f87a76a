"""A relay that dies or wedges, and a robot's daemon that restarts: streams come back, the task stays where it is."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from zsched.core.model import NodeId
from zsched.lab.testbed import Testbed, echo_fleet

pytestmark = pytest.mark.timeout(90)


@pytest.fixture
def bed(tmp_path: Path) -> Iterator[Testbed]:
    with Testbed(tmp_path, echo_fleet()) as testbed:
        testbed.init()
        testbed.start()
        testbed.wait_settled()
        yield testbed


def relay_of(bed: Testbed, node: NodeId) -> int:
    """The process id of a node's relay."""
    for child in psutil.Process(bed.pid(node)).children():
        with contextlib.suppress(psutil.NoSuchProcess):  # it ended while we looked
            if "zsched.relay" in child.cmdline():
                return int(child.pid)
    raise AssertionError(f"{node} has no relay")


class Pinger:
    """An application that asks for an echo every 10 ms and notes when the newest came."""

    def __init__(self, bed: Testbed) -> None:
        session = bed.app("robot1")
        self.sent = 0
        self.back: list[tuple[int, float]] = []
        self._publisher = session.declare_publisher("robot1/in")
        self._subscriber = session.declare_subscriber("robot1/out", self._take)

    def _take(self, sample: object) -> None:
        payload = sample.payload.to_bytes()  # type: ignore[attr-defined] # a zenoh sample
        self.back.append((int(payload), time.monotonic()))

    def silence_after(self, moment: float, deadline_s: float) -> float:
        """Seconds from ``moment`` to the first echo of something sent after it."""
        first = self.sent
        end = time.monotonic() + deadline_s
        while time.monotonic() < end:
            self._publisher.put(str(self.sent).encode())
            self.sent += 1
            newer = [at for number, at in self.back[-50:] if number >= first]
            if newer:
                return newer[0] - moment
            time.sleep(0.01)
        raise AssertionError(f"no echo within {deadline_s} s")


@pytest.mark.parametrize("fault", [signal.SIGKILL, signal.SIGSTOP], ids=["killed", "wedged"])
@pytest.mark.parametrize("whose", ["robot1", "owner"])
def test_a_lost_relay_is_replaced_and_the_task_stays(bed: Testbed, whose: str, fault: signal.Signals) -> None:
    """A wedged one is told by its silence of 5 s; the streams of a robot do not hang on the owner's relay at all."""
    owner = bed.wait_settled()
    epoch = bed.task("robot1")["epoch"]
    pinger = Pinger(bed)
    pinger.silence_after(time.monotonic(), 10)
    node = owner if whose == "owner" else whose
    old = relay_of(bed, node)
    os.kill(old, fault)
    silence_s = pinger.silence_after(time.monotonic(), 12)
    bed.wait(lambda: _is_replaced(bed, node, old), 12, "another relay")
    pinger.silence_after(time.monotonic(), 10)
    print(f"\nrelay of {whose} {fault.name}: silence {silence_s:.2f} s")
    if whose == "owner":
        assert silence_s < 1.0
    assert bed.task("robot1")["epoch"] == epoch


def _is_replaced(bed: Testbed, node: NodeId, old: int) -> bool:
    try:
        return relay_of(bed, node) != old
    except AssertionError:
        return False


def test_a_robots_daemon_that_restarts_takes_its_streams_up_again(bed: Testbed) -> None:
    """Its relay dies with it: the streams of this one robot rest meanwhile; the others' task does not move."""
    owner = bed.wait_settled()
    pinger = Pinger(bed)
    pinger.silence_after(time.monotonic(), 10)
    moment = time.monotonic()
    bed.kill("robot1")
    bed.start("robot1")
    silence_s = pinger.silence_after(moment, 20)
    print(f"\ndaemon restarted: silence {silence_s:.2f} s")
    assert bed.task("robot1")["owner"] == owner
