"""A relay that dies or wedges, and a robot's daemon that restarts: streams come back, the task stays where it is."""

from __future__ import annotations

import contextlib
import itertools
import math
import os
import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import zsched
from support.waiting import within
from zsched.core.values.model import NodeId
from zsched.link.pipe.relay_socket import PROTOCOL
from zsched_lab.fleet.testbed import Testbed, echo_fleet


@pytest.fixture(scope="module")
def fleets(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[str], Testbed]]:
    """Two fleets, started when first asked for: their task is idempotent, or exclusive."""
    with contextlib.ExitStack() as stack:
        made: dict[str, Testbed] = {}

        def fleet(kind: str) -> Testbed:
            if kind not in made:
                edges = 1 if kind == "exclusive" else 2
                tree = echo_fleet(edges=edges, stream_class="reliable", task={"exclusive": kind == "exclusive"})
                made[kind] = stack.enter_context(Testbed(tmp_path_factory.mktemp(kind), tree))
                made[kind].init()
            made[kind].wait_whole(60)
            return made[kind]

        yield fleet


@pytest.fixture
def bed(fleets: Callable[[str], Testbed]) -> Testbed:
    """The idempotent fleet, whole again whatever the last test did to it."""
    testbed = fleets("idempotent")
    testbed.wait(lambda: not any("relay" in text for text in relay_problems(testbed)), 60, "every relay runs")
    return testbed


def relay_problems(bed: Testbed) -> list[str]:
    return [text for node in bed.names for text in bed.status(node)["problems"]]


def relay_of(bed: Testbed, node: NodeId) -> int:
    """The process id of a node's relay."""
    pid = bed.relay_pid(node)
    assert pid is not None, f"{node} has no relay"
    return pid


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
    pinger.silence_after(time.monotonic(), 60)
    node = owner if whose == "owner" else whose
    old = relay_of(bed, node)
    os.kill(old, fault)
    silence_s = pinger.silence_after(time.monotonic(), 60)
    bed.wait(lambda: _is_replaced(bed, node, old), 60, "another relay")
    pinger.silence_after(time.monotonic(), 60)
    print(f"\nrelay of {whose} {fault.name}: silence {silence_s:.2f} s")
    within(silence_s, 1.0 if whose == "owner" else 12.0, "of silence")
    assert bed.task("robot1")["epoch"] == epoch


def _is_replaced(bed: Testbed, node: NodeId, old: int) -> bool:
    try:
        return relay_of(bed, node) != old
    except AssertionError:
        return False


class Talker:
    """An application that asks for an echo every 5 ms all the time, in a thread of its own."""

    def __init__(self, bed: Testbed) -> None:
        session = bed.app("robot1")
        self.sent: list[float] = []
        self.back: dict[int, float] = {}
        self._publisher = session.declare_publisher("robot1/in")
        self._subscriber = session.declare_subscriber("robot1/out", self._take)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _take(self, sample: object) -> None:
        number = int(sample.payload.to_bytes())  # type: ignore[attr-defined] # a zenoh sample
        self.back.setdefault(number, time.monotonic())

    def _run(self) -> None:
        while not self._stop.wait(0.005):
            self._publisher.put(str(len(self.sent)).encode())
            self.sent.append(time.monotonic())

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()

    def missing(self, since: float) -> list[int]:
        """What was asked since then and has not been answered."""
        return [number for number, at in enumerate(tuple(self.sent)) if at >= since and number not in self.back]

    def longest_gap_s(self, since: float) -> float:
        times = sorted(at for at in tuple(self.back.values()) if at >= since)
        return max((after - before for before, after in itertools.pairwise(times)), default=math.inf)


def end_daemon(bed: Testbed, node: NodeId, how: str) -> None:
    if how == "crashed":
        bed.kill(node, with_relay=False)
    else:
        bed.send(node, signal.SIGUSR2)
        bed.wait(lambda: bed.has_ended(node), 60, "the daemon has ended")


@pytest.mark.parametrize(("kind", "how"), [("idempotent", "crashed"), ("exclusive", "restarted")])
def test_a_robots_streams_run_on_while_its_daemon_restarts(
    fleets: Callable[[str], Testbed], kind: str, how: str
) -> None:
    """Nothing lost, no pause, the same relay; the daemon that follows connects to it and the task stays."""
    bed = fleets(kind)
    owner, epoch, relay = bed.wait_settled(), bed.task("robot1")["epoch"], relay_of(bed, "robot1")
    talker = Talker(bed)
    try:
        bed.wait(lambda: len(talker.back) > 20, 60, "echoes")
        moment = time.monotonic()
        end_daemon(bed, "robot1", how)
        bed.start("robot1")
        assert bed.wait_settled() == owner
        bed.wait(lambda: time.monotonic() > moment + 2, 60, "a while")
    finally:
        talker.stop()
    bed.wait(lambda: not talker.missing(moment), 60, "every answer")
    gap_s = talker.longest_gap_s(moment)
    print(f"\ndaemon {how}: longest gap {gap_s * 1000:.0f} ms, lost 0 of {len(talker.sent)}")
    within(gap_s, 0.5, "between two answers")
    assert relay_of(bed, "robot1") == relay
    assert bed.task("robot1")["epoch"] == epoch


def test_an_upgrade_that_replaces_a_robots_relay_loses_no_answer_that_had_come(
    fleets: Callable[[str], Testbed], tmp_path: Path
) -> None:
    """The next daemon is slow to come, and of another protocol: what was asked until then is answered."""
    bed = fleets("exclusive")
    relay = relay_of(bed, "robot1")
    talker = Talker(bed)
    try:
        bed.wait(lambda: len(talker.back) > 20, 60, "echoes")
        began = time.monotonic()
        end_daemon(bed, "robot1", "restarted")
        bed.wait(lambda: time.monotonic() > began + 1, 60, "a while without a daemon")
        asked, bed.code["robot1"] = len(talker.sent), with_another_protocol(tmp_path)
        bed.start("robot1")
        bed.wait(lambda: _is_replaced(bed, "robot1", relay), 60, "another relay")
        bed.wait(lambda: not talker.missing(time.monotonic() - 0.2), 60, "the streams flow again")
    finally:
        talker.stop()
    assert [number for number in talker.missing(began) if number < asked] == []


def with_another_protocol(folder: Path) -> Path:
    """Where a package is whose daemons cannot go on with the relays of this one."""
    shutil.copytree(Path(zsched.__file__).parent, folder / "zsched", ignore=shutil.ignore_patterns("__pycache__"))
    path = folder / "zsched/link/pipe/relay_socket.py"
    text = path.read_text()
    path.write_text(text.replace(f"PROTOCOL: Final = {PROTOCOL}\n", f"PROTOCOL: Final = {PROTOCOL + 1}\n"))
    assert path.read_text() != text
    return folder


def test_an_orphaned_relay_follows_a_move_once_its_next_daemon_knows(bed: Testbed) -> None:
    """The task moves while the robot has no daemon: its streams go to the new owner as soon as it has one again."""
    first = bed.wait_settled()
    talker = Talker(bed)
    try:
        bed.wait(lambda: len(talker.back) > 20, 60, "echoes")
        bed.kill("robot1", with_relay=False)
        bed.kill(first)
        bed.wait(lambda: bed.owner("robot2", "robot3") not in (None, first), 60, "another owner")
        bed.start("robot1")
        second = bed.wait_settled()
        moment = time.monotonic()
        bed.wait(lambda: any(at > moment for at in tuple(talker.back.values())), 60, "echoes of the new owner")
    finally:
        talker.stop()
    assert second != first
    bed.wait(lambda: not talker.missing(moment), 60, "every answer")
