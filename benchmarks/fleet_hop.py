"""What a stream costs in a real fleet, with and without shared memory: daemons, relay, echo worker, an application.

``python -m benchmarks.fleet_hop [--sizes 65536 1048576] [--classes best_effort reliable] [--seconds 5] [--hz N]``.
One robot and one edge on this machine, as ``shared_memory: off`` and as ``auto``. An application publishes on the
robot's key, as fast as it is let (or ``--hz``), the worker sends everything back, another application receives it.
With ``--freeze`` a process is stopped for 0.05 to 0.6 s, 1.5 times a second. *wrong*: came back twice, or not as sent.
*sent* is what its publisher was let put; *CPU* is user and system time of the robot's relay, which carries each message
twice, and of the worker, per message that came back. The last column says whether payloads came in shared memory.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import psutil

from benchmarks.common import cpu_s, machine
from zsched.core.values.problems import of_kind
from zsched.link.sessions.config import client_config
from zsched_lab.fleet.pace import at_pace
from zsched_lab.fleet.testbed import Testbed, echo_fleet

APPLICATION = """
import json, os, struct, sys, time, zenoh
config, size, hz, seconds = sys.argv[1], int(sys.argv[2]), float(sys.argv[3]), float(sys.argv[4])
got, shared, last, wrong, seen = [0], [0], [0.0], [0], set()

def take(sample):
    got[0] += 1
    shared[0] += sample.payload.as_shm() is not None
    last[0] = time.monotonic()
    raw = sample.payload.to_bytes()
    number = struct.unpack_from("<q", raw)[0]
    is_whole = len(raw) == size and raw == struct.pack("<q", number) * (size // 8)
    wrong[0] += not is_whole or number in seen
    seen.add(number)

with zenoh.open(zenoh.Config.from_json5(config)) as session, zenoh.open(zenoh.Config.from_json5(config)) as other:
    publisher = session.declare_publisher("robot1/in", congestion_control=zenoh.CongestionControl.BLOCK)
    subscriber = other.declare_subscriber("robot1/out", take)
    number = 0

    def put():
        global number
        publisher.put(struct.pack("<q", number) * (size // 8))
        number += 1

    while not got[0]:
        put()
        time.sleep(0.1)
    time.sleep(1.0)
    first = got[0]
    shared[0] = 0
    print("begin", flush=True)
    began = due = time.monotonic()
    sent = 0
    while (now := time.monotonic()) < began + seconds:
        put()
        sent += 1
        if hz:
            due += 1 / hz
            time.sleep(max(0.0, due - time.monotonic()))
    while time.monotonic() < last[0] + 3.0:
        time.sleep(0.05)
    print(json.dumps([sent, got[0] - first, last[0] - began, shared[0], wrong[0]]), flush=True)
    subscriber.undeclare()
"""

HEAD = (
    "payload   class        setting     sent/s   back/s  not back  wrong  relay CPU us  worker CPU us  shared  "
    "drops, problems"
)


def main() -> None:
    """Print one row for each size, class and setting."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sizes", type=int, nargs="+", default=[65536, 1 << 20])
    parser.add_argument("--classes", nargs="+", default=["best_effort", "reliable"])
    parser.add_argument("--settings", nargs="+", default=["off", "auto"], choices=["off", "auto"])
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--hz", type=float, default=0.0)
    parser.add_argument("--freeze", action="store_true", help="stop the relay, the worker or the receiver now and then")
    options = parser.parse_args()
    print(machine())
    print(HEAD)
    for size in options.sizes:
        for stream_class in options.classes:
            for setting in options.settings:
                _row(size, stream_class, setting, options)


def _row(size: int, stream_class: str, setting: str, options: argparse.Namespace) -> None:
    tree = {**echo_fleet(robots=1, edges=1, stream_class=stream_class), "shared_memory": setting}
    with tempfile.TemporaryDirectory() as folder, Testbed(Path(folder), tree) as bed:
        bed.init()
        bed.start()
        bed.wait_settled()
        problems = of_kind(bed.status("robot1"), "shared_memory")
        endpoint = bed.fleet.node("robot1").listen_data
        config = client_config(connect=(endpoint,), timing=bed.fleet.timing, shared_memory=setting == "auto")
        command = [sys.executable, "-c", APPLICATION, config, str(size), str(options.hz), str(options.seconds)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            process.stdout.readline()
            worker = _worker_of(bed.pid("edge1"))
            relay = bed.relay_pid("robot1")
            before = [cpu_s(pid) for pid in (relay, worker)]
            with at_pace(1.5, lambda: _freeze((relay, worker, process.pid)) if options.freeze else None):
                sent, back, took_s, shared, wrong = json.loads(process.stdout.readline())
            used = [after - since for after, since in zip((cpu_s(relay), cpu_s(worker)), before, strict=True)]
        relay_us, worker_us = (part / max(1, back) * 1e6 for part in used)
        drops: dict[str, Any] = {stream["stream"]: stream["drops"] for stream in bed.task("robot1")["streams"]}
        rates = f"{sent / options.seconds:>9.0f} {back / max(took_s, 1e-9):>8.0f} {sent - back:>9} {wrong:>6}"
        costs = f"{relay_us:>13.0f} {worker_us:>14.0f} {shared / max(1, back):>8.0%}"
        print(f"{size:>8}  {stream_class:<12} {setting:<8} {rates} {costs}  {drops} {' '.join(problems)}", flush=True)


def _worker_of(daemon: int) -> int | None:
    """The echo worker's process: a child of its daemon."""
    children = psutil.Process(daemon).children(recursive=True)
    return next((one.pid for one in children if "zsched.tasks.echo" in one.cmdline()), None)


def _freeze(pids: tuple[int | None, ...]) -> None:
    """Stop one of the processes for 0.05 to 0.6 s."""
    pid = random.choice(pids)
    if pid is not None:
        os.kill(pid, signal.SIGSTOP)
        time.sleep(random.uniform(0.05, 0.6))
        os.kill(pid, signal.SIGCONT)


if __name__ == "__main__":
    main()
