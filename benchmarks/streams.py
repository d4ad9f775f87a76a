"""What one hop costs: direct pair, native router hop, naive relay, zsched's hop, in one interleaved run.

``python -m benchmarks.streams [--rounds 3] [--seconds 1.5] [--sizes 64 1024 65536 1048576 4194304] [--shared-memory]``.
TCP on loopback, shared memory off unless asked for; publisher, hop and subscriber are processes of their own.
Throughput: flat out, BLOCK. Latency: one way, paced (CLOCK_MONOTONIC is one clock for all processes). Hop CPU: user and
system time of the hop's process per message of the throughput run. *naive*: ``bytes(payload)`` and a put in the
subscriber's callback. *best_effort* and *reliable*: `python -m zsched.relay` itself, with a plan that rewrites
``bench/in`` to ``edge1/bench/in``.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import time
from collections import defaultdict
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import zenoh

from benchmarks.common import ask, cpu_s, machine, median_us, read
from zsched.core.values.events import RelayChanged, SlotFlipped, SlotReady
from zsched.core.values.fleet import WorkerLink
from zsched.core.values.plan import (
    Direction,
    ReadyWhen,
    Route,
    RoutePhase,
    RoutePlan,
    Slot,
    StreamClass,
    StreamSettings,
)
from zsched.core.values.relay_protocol import HandleReport
from zsched.link.sessions.config import data_config, worker_config
from zsched.runtime.relay.streams import RelayHandle
from zsched_lab.fleet.loopback import free_endpoint
from zsched_lab.fleet.relays import FLEET, hello_of
from zsched_lab.fleet.waiting import until

HOPS = ("direct", "router", "naive", "best_effort", "reliable")
PACE_HZ = {64: 500, 1024: 500, 65536: 250, 1 << 20: 50, 4 << 20: 20}
IN, OUT = "bench/in", "edge1/bench/in"

PUBLISHER = """
import struct, sys, time, zenoh
config, key, size, hz, seconds = sys.argv[1], sys.argv[2], int(sys.argv[3]), float(sys.argv[4]), float(sys.argv[5])
session = zenoh.open(zenoh.Config.from_json5(open(config).read()))
publisher = session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
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
SUBSCRIBER = """
import json, struct, sys, threading, time, zenoh
config, key = sys.argv[1], sys.argv[2]
session = zenoh.open(zenoh.Config.from_json5(open(config).read()))
got, times = [0], []
def take(sample):
    at = time.monotonic()
    sent, number = struct.unpack_from("<dq", sample.payload.to_bytes()[:16])
    got[0] += 1
    if not times:
        times.append(at)
    last[0] = at
    if len(delays) < 20000:
        delays.append(at - sent)
last, delays = [0.0], []
subscriber = session.declare_subscriber(key, take)
print("up", flush=True)
for line in sys.stdin:
    if line.strip() == "reset":
        got[0] = 0; times.clear(); delays.clear()
        print("ok", flush=True)
        continue
    before = -1
    while before != got[0]:
        before = got[0]
        time.sleep(0.1)
    print(json.dumps([got[0], (last[0] - times[0]) if times else 0.0, delays]), flush=True)
session.close()
"""
ROUTER = """
import sys, zenoh
session = zenoh.open(zenoh.Config.from_json5(open(sys.argv[1]).read()))
print("up", flush=True)
sys.stdin.readline()
session.close()
"""
NAIVE = """
import sys, zenoh
session = zenoh.open(zenoh.Config.from_json5(open(sys.argv[1]).read()))
publisher = session.declare_publisher(sys.argv[3], congestion_control=zenoh.CongestionControl.BLOCK)
subscriber = session.declare_subscriber(sys.argv[2], lambda sample: publisher.put(bytes(sample.payload)))
print("up", flush=True)
sys.stdin.readline()
session.close()
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """One run: messages sent and received, their rate, one-way delays in s, the hop's CPU seconds."""

    sent: int
    got: int
    hz: float
    delays: tuple[float, ...]
    hop_cpu_s: float


class Bench:
    """The processes of one way from a publisher to a subscriber over one kind of hop."""

    def __init__(self, folder: Path, hop: str, *, shared_memory: bool = False) -> None:
        self._hop, self._folder, self._shared = hop, folder, shared_memory
        self._endpoint = free_endpoint()
        self._processes: list[subprocess.Popen[str]] = []
        self._relay: RelayHandle | None = None
        self._heard: list[HandleReport] = []

    def run(self, size: int, hz: float, seconds: float) -> Result:
        """Send for so long; ``hz`` 0: flat out."""
        hop = self._start_hop()
        subscriber = self._start(SUBSCRIBER, "sub", self._far_key(), is_hub=self._hop == "direct")
        self._flip()
        publisher = self._start(PUBLISHER, "pub", IN, str(size), str(hz), str(seconds))
        time.sleep(0.6)
        before = cpu_s(hop)
        sent = int(ask(publisher, "go"))
        got, span, delays = json.loads(ask(subscriber, "report"))
        used_s = cpu_s(hop) - before
        return Result(
            sent=sent, got=got, hz=(got - 1) / span if span else 0.0, delays=tuple(delays[5:]), hop_cpu_s=used_s
        )

    def close(self) -> None:
        """End every process."""
        for process in reversed(self._processes):
            process.kill()
            process.communicate()
        if self._relay is not None:
            self._relay.stop()

    def _far_key(self) -> str:
        return IN if self._hop in ("direct", "router") else OUT

    def _start_hop(self) -> int | None:
        if self._hop == "direct":
            return None
        if self._hop in ("router", "naive"):
            process = self._start(NAIVE if self._hop == "naive" else ROUTER, "hop", IN, OUT, is_hub=True)
            return process.pid
        text = data_config(listen=(self._endpoint,), connect=(), shared_memory=self._shared)
        self._relay = RelayHandle(
            hello=hello_of(FLEET, "robot1"),
            path=self._folder / "robot1.relay",
            zenoh_config=text,
            on_report=self._heard.append,
        )
        self._relay.start()
        until(lambda: any(isinstance(r, RelayChanged) and r.is_running for r in self._heard), "the relay runs")
        return self._relay.pid

    def _flip(self) -> None:
        if self._relay is None:
            return
        settings = StreamSettings(stream_class=StreamClass(self._hop), depth=1000)
        route = Route(stream="bench/in/0", direction=Direction.INPUT, from_expr=IN, to_expr=OUT, settings=settings)
        slot = Slot(epoch=1, owner="edge1", routes=(route,), ready_when=ReadyWhen.MATCHING)
        for phase, report in ((RoutePhase.PREPARE, SlotReady), (RoutePhase.FLIP, SlotFlipped)):
            self._relay.apply(RoutePlan(task="bench", phase=phase, current=slot))
            until(partial(self._has, report), phase.value)

    def _has(self, kind: type) -> bool:
        return any(isinstance(report, kind) for report in self._heard)

    def _start(self, program: str, name: str, *arguments: str, is_hub: bool = False) -> subprocess.Popen[str]:
        path = self._folder / f"{name}-{len(self._processes)}.json5"
        path.write_text(self._config(is_hub=is_hub))
        command = [sys.executable, "-c", program, str(path), *arguments]
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self._processes.append(process)
        read(process)
        return process

    def _config(self, *, is_hub: bool) -> str:
        if not is_hub:
            # Ends of the native hop are clients: peers would find each other and leave the hop out.
            link = WorkerLink.CLIENT if self._hop == "router" else WorkerLink.PEER
            return worker_config(connect=(self._endpoint,), shared_memory=self._shared, link=link)
        text = data_config(listen=(self._endpoint,), connect=(), shared_memory=self._shared)
        config = zenoh.Config.from_json5(text)
        if self._hop == "router":
            config.insert_json5("mode", json.dumps("router"))
        return str(config)


def _measure(folder: Path, hop: str, size: int, hz: float, options: argparse.Namespace) -> Result:
    bench = Bench(folder, hop, shared_memory=options.shared_memory)
    try:
        return bench.run(size, hz, options.seconds)
    finally:
        bench.close()


def main() -> None:
    """Print a table: medians over the rounds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=1.5)
    parser.add_argument("--sizes", type=int, nargs="+", default=sorted(PACE_HZ))
    parser.add_argument("--hops", nargs="+", default=HOPS, choices=HOPS)
    parser.add_argument("--shared-memory", action="store_true", help="between all of them, for puts of 3 KiB and more")
    options = parser.parse_args()
    print(machine())
    print("payload   hop          msg/s      MB/s   of router   p50 us   p99 us  added p50   hop CPU us/msg   received")
    with TemporaryDirectory() as folder:
        for size in options.sizes:
            _row(Path(folder), size, options)


def _row(folder: Path, size: int, options: argparse.Namespace) -> None:
    fast: dict[str, list[Result]] = defaultdict(list)
    paced: dict[str, list[Result]] = defaultdict(list)
    for _ in range(options.rounds):
        for hop in options.hops:
            fast[hop].append(_measure(folder, hop, size, 0.0, options))
            paced[hop].append(_measure(folder, hop, size, PACE_HZ.get(size, 100), options))
    rate = {hop: statistics.median(result.hz for result in results) for hop, results in fast.items()}
    p50, p99 = (
        {hop: median_us((one.delays for one in results), share) for hop, results in paced.items()}
        for share in (0.5, 0.99)
    )
    for hop in options.hops:
        results = fast[hop]
        cpu = statistics.median(result.hop_cpu_s / max(1, result.got) for result in results) * 1e6
        share = sum(result.got for result in results) / max(1, sum(result.sent for result in results))
        ratio = rate[hop] / rate["router"] if rate.get("router") else 0.0
        added = p50[hop] - p50.get("direct", 0.0)
        print(
            f"{size:>8}  {hop:<11} {rate[hop]:>8.0f} {rate[hop] * size / 1e6:>9.0f} {ratio:>9.2f} {p50[hop]:>10.0f} "
            f"{p99[hop]:>8.0f} {added:>10.0f} {cpu:>14.1f} {share:>13.1%}",
            flush=True,
        )


if __name__ == "__main__":
    main()
