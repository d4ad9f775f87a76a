"""What streams of its own cost an application: direct zenoh, `zsched.stream` and the relay, in one interleaved run.

``python -m benchmarks.own_streams [--rounds 3] [--seconds 2] [--sizes 1024 65536 1048576] [--classes reliable]``.
The receiver is one and the same `zsched.worker`, a process of its own, which keeps everything that comes; TCP on
loopback, no shared memory. *direct*: a zenoh publisher (BLOCK) that the worker dials, unnumbered, nothing kept.
*stream*: `zsched.stream` in the publisher's process. *relay*: a publisher beside a relay (`python -m zsched.relay`).
One way, paced, then flat out. *CPU*: user and system time of publisher and relay per message of the flat-out run.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from collections import defaultdict
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from benchmarks.common import ask, cpu_s, machine, median_us, read
from zsched.adapters.relay.streams import RelayHandle
from zsched.core.events import RelayChanged, SlotFlipped, SlotReady
from zsched.core.relay_protocol import HandleReport
from zsched.core.values.plan import (
    Direction,
    ReadyWhen,
    Role,
    Route,
    RoutePhase,
    RoutePlan,
    Slot,
    StreamClass,
    StreamSettings,
    WorkerRole,
)
from zsched.sessions.config import data_config, worker_config
from zsched_lab.fleet.loopback import free_endpoint
from zsched_lab.fleet.relays import FLEET
from zsched_lab.fleet.waiting import until

WAYS = ("direct", "stream", "relay")
PACE_HZ = {1024: 500, 65536: 250, 1 << 20: 50}
TASK, NEAR, FAR = "bench", "robot1/in", "edge1/bench/robot1/in"

RECEIVER = """
import json, struct, sys, time
from zsched.worker import Worker
got, times, delays = [0], [], []

def take(sample):
    at = time.monotonic()
    sent = struct.unpack_from("<d", sample.payload.to_bytes()[:16])[0]
    got[0] += 1
    times[:] = [times[0] if times else at, at]
    if len(delays) < 20000:
        delays.append(at - sent)

with Worker.from_env() as worker:
    worker.subscribe("{prefix}/*/in", take, keep_last=None, depth=1 << 20)
    worker.ready()
    print("up", flush=True)
    for line in sys.stdin:
        before = -1
        while before != got[0]:
            before = got[0]
            time.sleep(0.2)
        print(json.dumps([got[0], times[1] - times[0] if times else 0.0, delays]), flush=True)
        got[0] = 0; times.clear(); delays.clear()
"""
PUBLISHER = """
import struct, sys, time
from pathlib import Path
way, where, key, size, hz, seconds = *sys.argv[1:4], int(sys.argv[4]), float(sys.argv[5]), float(sys.argv[6])
if way == "stream":
    from zsched.stream import Streams
    session = Streams.join(runtime_dir=Path(where), node="robot1")
    publisher = session.publisher(key)
    matches = lambda: True
    is_there = lambda: not any(task.under_way() for task in session._tasks.values())
else:
    import zenoh
    session = zenoh.open(zenoh.Config.from_json5(where))
    publisher = session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
    matches = lambda: publisher.matching_status.matching
    is_there = lambda: True
while not matches():
    time.sleep(0.01)
publisher.put(struct.pack("<dq", time.monotonic(), -1) + bytes(size - 16))
while not is_there():
    time.sleep(0.01)
time.sleep(1.0)  # links are up, the first sample has come
print("up", flush=True)
sys.stdin.readline()
padding, count, end = bytes(size - 16), 0, time.monotonic() + seconds
due = time.monotonic()
while time.monotonic() < end:
    publisher.put(struct.pack("<dq", time.monotonic(), count) + padding)
    count += 1
    if hz:
        due += 1 / hz
        time.sleep(max(0.0, due - time.monotonic()))
print(count, flush=True)
sys.stdin.readline()
session.close()
"""
HEAD = "payload   class        way       msg/s   of direct   p50 us   p99 us  added p50   CPU us/msg   came   n"


class Result(NamedTuple):
    """One run: sent, came, messages/s, one-way delays in s, CPU seconds of publisher and relay."""

    sent: int
    got: int
    hz: float
    delays: tuple[float, ...]
    cpu_s: float


class Bench:
    """A robot's relay, an edge's, and a worker that three kinds of publishers send to."""

    def __init__(self, stack: ExitStack, folder: Path, stream_class: str) -> None:
        self._folder = folder
        self._ends = {name: free_endpoint() for name in ("robot1", "edge1", "own", "direct")}
        self._heard: list[HandleReport] = []
        self._relays = {}
        for node in ("robot1", "edge1"):
            connect = () if node == "robot1" else (self._ends["robot1"],)
            relay = self._relays[node] = RelayHandle(
                fleet=FLEET,
                node=node,
                zenoh_config=data_config(listen=(self._ends[node],), connect=connect, shared_memory=False),
                on_report=self._heard.append if node == "robot1" else lambda _report: None,
                streams=(folder / "robot1.streams", self._ends["own"]) if node == "robot1" else None,
            )
            relay.start()
            stack.callback(relay.stop)
        until(lambda: self._has(RelayChanged), "the relay runs")
        self._worker = self._start_worker()
        stack.callback(_end, self._worker)
        self._route(stream_class)

    def run(self, way: str, size: int, hz: float, seconds: float) -> Result:
        """Send by one way for so long; ``hz`` 0: flat out."""
        where = {
            "direct": data_config(listen=(self._ends["direct"],), connect=(), shared_memory=False),
            "relay": worker_config(connect=(self._ends["robot1"],), shared_memory=False),
            "stream": str(self._folder),
        }[way]
        arguments = [way, where, FAR if way == "direct" else NEAR, str(size), str(hz), str(seconds)]
        command = [sys.executable, "-c", PUBLISHER, *arguments]
        publisher = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        try:
            read(publisher)
            ask(self._worker, "reset")
            pids = [publisher.pid, self._relays["robot1"].pid or 0]
            before = sum(map(cpu_s, pids))
            sent = int(ask(publisher, "go"))
            got, span, delays = json.loads(ask(self._worker, "report"))
            used_s = sum(map(cpu_s, pids)) - before
        finally:
            _end(publisher)
        return Result(sent, got, (got - 1) / span if span else 0.0, tuple(delays[5:]), used_s)

    def _has(self, kind: type) -> bool:
        return any(isinstance(report, kind) for report in self._heard)

    def _start_worker(self) -> subprocess.Popen[str]:
        path = self._folder / "worker.json5"
        connect = (self._ends["edge1"], *(self._ends[name] for name in ("robot1", "own", "direct")))
        path.write_text(worker_config(connect=connect, listen=(), shared_memory=False, dials_by_gossip=False))
        names = {"FLEET": FLEET, "NODE": "edge1", "TASK": TASK, "INCARNATION": "1", "ZENOH_CONFIG": str(path)}
        env = os.environ | {f"ZSCHED_{name}": value for name, value in names.items()}
        command = [sys.executable, "-c", RECEIVER]
        worker = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=env)
        read(worker)
        return worker

    def _route(self, stream_class: str) -> None:
        settings = StreamSettings(stream_class=StreamClass(stream_class), depth=1000)
        route = Route(stream="bench/in/0", direction=Direction.INPUT, from_expr=NEAR, to_expr=FAR, settings=settings)
        slot = Slot(epoch=1, owner="edge1", routes=(route,), ready_when=ReadyWhen.TOKEN)
        self._relays["edge1"].set_role(Role(task=TASK, role=WorkerRole.ACTIVE, epoch=1))
        for phase, report in ((RoutePhase.PREPARE, SlotReady), (RoutePhase.FLIP, SlotFlipped)):
            self._relays["robot1"].apply(RoutePlan(task=TASK, phase=phase, current=slot))
            until(partial(self._has, report), phase.value)


def _end(process: subprocess.Popen[str]) -> None:
    process.kill()
    process.communicate()


def main() -> None:
    """Print a table: medians over the rounds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--sizes", type=int, nargs="+", default=sorted(PACE_HZ))
    parser.add_argument("--classes", nargs="+", default=["reliable"], choices=["best_effort", "latest", "reliable"])
    options = parser.parse_args()
    print(machine())
    print(HEAD, flush=True)
    for stream_class in options.classes:
        with TemporaryDirectory() as folder, ExitStack() as stack:
            bench = Bench(stack, Path(folder), stream_class)
            for size in options.sizes:
                _rows(bench, size, stream_class, options)


def _rows(bench: Bench, size: int, stream_class: str, options: argparse.Namespace) -> None:
    fast: dict[str, list[Result]] = defaultdict(list)
    paced: dict[str, list[Result]] = defaultdict(list)
    for _ in range(options.rounds):
        for way in WAYS:
            paced[way].append(bench.run(way, size, PACE_HZ.get(size, 100), options.seconds))
            fast[way].append(bench.run(way, size, 0.0, options.seconds))
            time.sleep(0.2)
    rate = {way: statistics.median(result.hz for result in results) for way, results in fast.items()}
    p50, p99 = (
        {way: median_us((one.delays for one in results), share) for way, results in paced.items()}
        for share in (0.5, 0.99)
    )
    for way in WAYS:
        cpu = statistics.median(result.cpu_s / max(1, result.got) for result in fast[way]) * 1e6
        came = sum(result.got for result in fast[way]) / max(1, sum(result.sent for result in fast[way]))
        count = sum(len(result.delays) for result in paced[way])
        print(
            f"{size:>8}  {stream_class:<12} {way:<7} {rate[way]:>7.0f} {rate[way] / rate['direct']:>10.2f} "
            f"{p50[way]:>8.0f} {p99[way]:>8.0f} {p50[way] - p50['direct']:>10.0f} {cpu:>12.1f} {came:>7.1%} {count:>5}",
            flush=True,
        )


if __name__ == "__main__":
    main()
