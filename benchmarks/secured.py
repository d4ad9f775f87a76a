"""What certificates, access rules and signatures cost: a secured fleet, one without signatures, one in plain text.

``python -m benchmarks.secured [--rounds 3] [--hops 200] [--takeovers 1] [--idle 10]``. Fleets of two robots and two
edges on one machine, `reliable` streams; those that are not measured stand still (SIGSTOP). The round trip is that of
an application on robot1's local side: relay, owner's worker, relay. A commit is `zsched tune`, until the answer. A
takeover: the owner is killed, until the first answer to a message that was sent afterwards. CPU is a robot's daemon and
relay, of one core. At the end robot1 of the secured fleet gets a renewed certificate, and begins anew while a 100 Hz
stream runs.
"""

from __future__ import annotations

import argparse
import itertools
import os
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import psutil
import zenoh

from benchmarks.common import cpu_s, machine, percentile
from benchmarks.floods import certified, with_local_side
from zsched.core.values.errors import AdapterError
from zsched.host import paths as places
from zsched.host.operator_client import ask
from zsched.link.sessions.config import client_config
from zsched.pki.authority import opened
from zsched_lab.fleet.testbed import Testbed, TestbedError, echo_fleet

ROBOT, KIB, MIB = "robot1", 1 << 10, 1 << 20
OPTIONS: dict[str, Any] = {"robots": 2, "edges": 2, "stream_class": "reliable"}
DIGITS = 12
REST_S = 3.0
PLAIN, UNSIGNED, SECURED = "plain", "unsigned", "secured"
"""``unsigned``: certificates and access rules, with ``signatures: off``."""


@dataclass(slots=True)
class Figures:
    """All samples of one fleet."""

    hops: dict[int, list[float]] = field(default_factory=lambda: {KIB: [], MIB: []})
    commits: list[float] = field(default_factory=list)
    takeovers: list[float] = field(default_factory=list)
    cpu: list[float] = field(default_factory=list)


class Application:
    """Sends numbered messages on robot1's local side, and knows when each answer came."""

    def __init__(self, bed: Testbed) -> None:
        local = bed.fleet.node(ROBOT).local
        assert local is not None
        self._session = zenoh.open(zenoh.Config.from_json5(client_config(connect=local.listen, connect_s=20.0)))
        self.sent: dict[int, float] = {}
        self.answered: dict[int, float] = {}
        self._came = threading.Condition()
        self._session.declare_subscriber(f"{ROBOT}/out", self._take)
        self._publisher = self._session.declare_publisher(
            f"{ROBOT}/in", congestion_control=zenoh.CongestionControl.BLOCK
        )

    def _take(self, sample: zenoh.Sample) -> None:
        with self._came:
            self.answered.setdefault(int(sample.payload.to_bytes()[:DIGITS]), time.monotonic())
            self._came.notify_all()

    def send(self, size: int = KIB) -> int:
        """Send the next message; its number."""
        number = len(self.sent)
        self.sent[number] = time.monotonic()
        self._publisher.put(f"{number:0{DIGITS}d}".encode().ljust(size, b"x"))
        return number

    def round_trip(self, size: int, timeout_s: float = 5.0) -> float | None:
        """Milliseconds until the answer; ``None``: it did not come."""
        number = self.send(size)
        with self._came:
            if not self._came.wait_for(lambda: number in self.answered, timeout_s):
                return None
        return 1000 * (self.answered[number] - self.sent[number])

    def until_answered(self) -> float:
        """Send every 5 ms until an answer to one of these comes; when it did."""
        first = len(self.sent)
        while not any(number >= first for number in tuple(self.answered)[-50:]):
            self.send()
            time.sleep(0.005)
        return min(at for number, at in self.answered.items() if number >= first)

    def close(self) -> None:
        """End the session."""
        self._session.close()


def pids(bed: Testbed) -> Iterator[int]:
    """Every process of a fleet."""
    for node in bed.running():
        daemon = psutil.Process(bed.pid(node))
        yield daemon.pid
        yield from (child.pid for child in daemon.children(recursive=True))
        if (relay := bed.relay_pid(node)) is not None:
            yield relay


@contextmanager
def alone(others: list[Testbed]) -> Iterator[None]:
    """Let other fleets stand still meanwhile."""
    stopped = {pid for bed in others for pid in pids(bed)}
    for pid in stopped:
        os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        for pid in stopped:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)


def robots_cpu_s(bed: Testbed) -> float:
    """CPU seconds of robot1's daemon and relay so far."""
    return cpu_s(bed.pid(ROBOT)) + cpu_s(bed.relay_pid(ROBOT))


def measure(bed: Testbed, figures: Figures, given: argparse.Namespace) -> None:
    """One round of one fleet."""
    bed.wait_whole()
    app = Application(bed)
    try:
        app.until_answered()
        for size, count in ((KIB, given.hops), (MIB, max(1, given.hops // 4))):
            taken = [app.round_trip(size) for _ in range(count)]
            figures.hops[size] += [one for one in taken if one is not None]
        for number in range(given.commits):
            figures.commits.append(commit(bed, 0.5 if number % 2 else 0.25))
        for _ in range(given.takeovers):
            bed.wait_whole()
            figures.takeovers.append(takeover(bed, app))
    finally:
        app.close()
    bed.wait_whole()
    time.sleep(2.0)
    before = robots_cpu_s(bed)
    time.sleep(given.idle)
    figures.cpu.append(100 * (robots_cpu_s(bed) - before) / given.idle)


def takeover(bed: Testbed, app: Application) -> float:
    """Milliseconds from the end of the owner's processes to the first answer to a message that was sent afterwards."""
    time.sleep(REST_S)
    owner = bed.wait_settled()
    app.until_answered()
    began = time.monotonic()
    bed.kill(owner)
    return 1000 * (app.until_answered() - began)


def commit(bed: Testbed, cpu: float) -> float:
    """Milliseconds that new weights take, with its answer."""
    began = time.monotonic()
    bed.weigh(ROBOT, cpu)
    return 1000 * (time.monotonic() - began)


def begin_anew(bed: Testbed) -> str:
    """Send robot1 a renewed certificate while 100 messages a second run; what became of them."""
    bed.wait_whole()
    with opened(bed.folder / "authority", bed.fleet.name) as authority:
        certificate = authority.renew(ROBOT, None, b"", b"", datetime.now(UTC)).certificate.decode()
    app = Application(bed)
    try:
        app.until_answered()
        first, answer = len(app.sent), {"verb": "certificate", "certificate": certificate}
        outcome = ask(places.socket_path(bed.folder, ROBOT), answer, 5.0)["outcome"]
        assert outcome == "ok", outcome
        due, ended = time.monotonic(), 0.0
        while not ended or time.monotonic() < ended + 5.0:
            app.send()
            due += 0.01
            time.sleep(max(0.0, due - time.monotonic()))
            if not ended and bed.log(ROBOT).count("ready node=") > 1 and "are opened anew" in bed.log(ROBOT):
                ended = time.monotonic()
            assert time.monotonic() < due + 120.0
        time.sleep(2.0)
        numbers = range(first, len(app.sent))
        lost = [number for number in numbers if number not in app.answered]
        times = sorted(app.answered[number] for number in numbers if number in app.answered)
        gap = max(after - before for before, after in itertools.pairwise(times))
        return f"sent {len(numbers)}, without an answer {len(lost)}, longest pause between answers {1000 * gap:.0f} ms"
    finally:
        app.close()


def row(name: str, pick: Callable[[Figures], list[float]], fleets: dict[str, Figures], unit: str) -> None:
    """One line: the fleets beside each other."""
    texts = []
    for kind, figures in fleets.items():
        values = pick(figures)
        texts.append(
            f"{kind} p50 {percentile(values, 0.5):7.2f} p99 {percentile(values, 0.99):7.2f} (n={len(values)})"
            if values
            else f"{kind}: none"
        )
    print(f"{name:<28} {'   '.join(texts)} {unit}", flush=True)


def main() -> None:
    """Print one line for each cost."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--hops", type=int, default=200)
    parser.add_argument("--commits", type=int, default=20)
    parser.add_argument("--takeovers", type=int, default=1, help="in each round")
    parser.add_argument("--idle", type=float, default=10.0)
    given = parser.parse_args()
    print(machine())
    fleets = {PLAIN: Figures(), UNSIGNED: Figures(), SECURED: Figures()}
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        beds: dict[str, Testbed] = {}
        for kind in fleets:
            folder = Path(name, kind)
            folder.mkdir()
            signatures = "off" if kind == UNSIGNED else "required"
            tree = echo_fleet(**OPTIONS) if kind == PLAIN else certified(folder, signatures, **OPTIONS)
            beds[kind] = stack.enter_context(Testbed(folder, with_local_side(tree)))
            beds[kind].init()
        for _ in range(given.rounds):
            for kind, bed in beds.items():
                bed.start()
                others = [other for other in beds.values() if other is not bed]
                with alone(others), suppress(AdapterError, TestbedError):  # a round that failed has no figures
                    measure(bed, fleets[kind], given)
        row("round trip, 1 KiB", lambda one: one.hops[KIB], fleets, "ms")
        row("round trip, 1 MiB", lambda one: one.hops[MIB], fleets, "ms")
        row("commit", lambda one: one.commits, fleets, "ms")
        row("takeover", lambda one: one.takeovers, fleets, "ms")
        row("idle CPU, daemon and relay", lambda one: one.cpu, fleets, "% of a core")
        print(f"begins anew: {begin_anew(beds[SECURED])}", flush=True)


if __name__ == "__main__":
    main()
