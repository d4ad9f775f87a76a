"""What the keys of a wildcard stream cost: relay and worker CPU per message, by how many keys share the same rate.

``python -m benchmarks.many_keys [--keys 1 16 256 2048] [--hz 1000] [--seconds 10]``.
One robot and one edge on this machine, class ``reliable``. An application puts ``--hz`` messages a second on
``robot1/in/0``, ``robot1/in/1``, ... in turn; the worker sends each back on an output of its own key. *CPU* is user and
system time of the robot's relay, which carries each message twice, and of the worker, per message that came back; the
ratios are to the row of the fewest keys. *first* is what the first round of all keys took, declarations included.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import psutil

from benchmarks.common import cpu_s, machine
from zsched.link.sessions.config import client_config
from zsched_lab.fleet.testbed import Testbed, echo_fleet

WORKER = """
from zsched.worker import Worker

with Worker.from_env() as worker:
    outputs = {}

    def answer(received):
        key = received.key.split("/")[-1]
        output = outputs.get(key)
        if output is None:
            output = outputs[key] = worker.publisher("{prefix}/out/{epoch}/" + key, reliable=True)
        output.put(received.payload)

    worker.subscribe("{prefix}/in/*", answer, keep_last=None, depth=100_000)
    worker.ready()
    while worker.wait(1.0):
        pass
"""
APPLICATION = """
import json, sys, time, zenoh
config, keys, hz, seconds = sys.argv[1], int(sys.argv[2]), float(sys.argv[3]), float(sys.argv[4])
got = [0]

def take(sample):
    got[0] += 1

def rounds(count):
    began = due = time.monotonic()
    for number in range(count):
        publishers[number % keys].put(b"x" * 64)
        due += 1 / hz
        time.sleep(max(0.0, due - time.monotonic()))
    until = time.monotonic() + 60
    while got[0] < count and time.monotonic() < until:
        time.sleep(0.01)
    return time.monotonic() - began

with zenoh.open(zenoh.Config.from_json5(config)) as session:
    block = zenoh.CongestionControl.BLOCK
    publishers = [session.declare_publisher(f"robot1/in/{key}", congestion_control=block) for key in range(keys)]
    subscriber = session.declare_subscriber("robot1/out/*", take)
    time.sleep(1.0)
    print(rounds(keys), flush=True)
    sys.stdin.readline()
    got[0] = 0
    count = int(hz * seconds)
    took_s = rounds(count)
    print(json.dumps([count, took_s, got[0]]), flush=True)
    sys.stdin.readline()
    subscriber.undeclare()
"""


def main() -> None:
    """Print one row for each number of keys."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--keys", type=int, nargs="+", default=[1, 16, 256, 2048])
    parser.add_argument("--hz", type=float, default=1000.0)
    parser.add_argument("--seconds", type=float, default=10.0)
    options = parser.parse_args()
    print(machine())
    print("  keys   first s   back/s   not back   relay CPU us         worker CPU us")
    base: tuple[float, float] | None = None
    for keys in sorted(options.keys):
        first_s, rate, missing, relay_us, worker_us = _run(keys, options.hz, options.seconds)
        base = base or (relay_us, worker_us)
        costs = "   ".join(
            f"{us:>8.0f} ({us / least:>5.2f})" for us, least in zip((relay_us, worker_us), base, strict=True)
        )
        print(f"{keys:>6} {first_s:>9.2f} {rate:>8.0f} {missing:>10}   {costs}", flush=True)


def _run(keys: int, hz: float, seconds: float) -> tuple[float, float, int, float, float]:
    rules = {
        "inputs": [{"from": "{robot}/in/*", "to": "{target}/echo/in/*", "class": "reliable"}],
        "outputs": [{"from": "{target}/echo/out/{epoch}/*", "to": "{robot}/out/*", "class": "reliable"}],
    }
    tree = echo_fleet(robots=1, edges=1, worker=(sys.executable, "-c", WORKER), task=rules)
    with tempfile.TemporaryDirectory() as folder, Testbed(Path(folder), tree) as bed:
        bed.init()
        bed.start()
        bed.wait_settled()
        config = client_config(connect=(bed.fleet.node("robot1").listen_data,), timing=bed.fleet.timing)
        command = [sys.executable, "-c", APPLICATION, config, str(keys), str(hz), str(seconds)]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdin is not None
            assert process.stdout is not None
            first_s = float(process.stdout.readline())
            pids = bed.relay_pid("robot1"), _worker_of(bed.pid("edge1"))
            before = [cpu_s(pid) for pid in pids]
            print(file=process.stdin, flush=True)
            sent, took_s, back = json.loads(process.stdout.readline())
            used = [cpu_s(pid) - since for pid, since in zip(pids, before, strict=True)]
            print(file=process.stdin, flush=True)
        relay_us, worker_us = (part / max(1, back) * 1e6 for part in used)
        return first_s, back / took_s, sent - back, relay_us, worker_us


def _worker_of(daemon: int) -> int | None:
    """The worker's process: the child of its daemon that runs the program above."""
    children = psutil.Process(daemon).children(recursive=True)
    return next((one.pid for one in children if WORKER in one.cmdline()), None)


if __name__ == "__main__":
    main()
