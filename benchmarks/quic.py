"""QUIC against two sessions over TLS on a thin radio with loss: what control and bulk data take.

``python -m benchmarks.quic [--mbit 20] [--seconds 15] [--loss 0 1 3]``. Needs root: a robot and an edge in network
namespaces; what leaves the robot passes a token bucket of ``--mbit`` with a queue of 100 ms, and each of the two
loses so many percent of what comes in. The robot puts 64 KiB 50 times a second (26 Mbit/s) in class DATA, and 200 B
20 times a second in class INTERACTIVE_HIGH. ``two tls``: each on a session of its own, as zsched has them. ``two
quic``: the same over QUIC. ``one quic``, ``one tls``: both on one session. One-way latency; the namespaces share one
clock.
"""

from __future__ import annotations

import argparse
import json
import struct
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import zenoh

from benchmarks.common import machine, percentile
from benchmarks.silent import certificates, with_tls
from zsched.link.sessions.config import control_config, data_config
from zsched_lab.fleet import netns

SETUPS = (("two tls", "tls", 2), ("two quic", "quic", 2), ("one tls", "tls", 1), ("one quic", "quic", 1))
SIZES, RATES = {"control": 200, "bulk": 1 << 16}, {"control": 20.0, "bulk": 50.0}
STAMP = struct.Struct("<d")
PORT = 7990


def send(configs: list[str], seconds: float) -> None:
    """The robot: put both for this time."""
    sessions = [zenoh.open(zenoh.Config.from_json5(text)) for text in configs]
    kinds = {
        "control": (sessions[0], zenoh.Priority.INTERACTIVE_HIGH, True),
        "bulk": (sessions[-1], zenoh.Priority.DATA, False),
    }
    end = time.monotonic() + 10.0
    while not all(session.info.links() for session in sessions) and time.monotonic() < end:
        time.sleep(0.05)
    time.sleep(1.0)
    until = time.monotonic() + seconds

    def run(name: str) -> None:
        session, priority, is_express = kinds[name]
        publisher = session.declare_publisher(
            name, congestion_control=zenoh.CongestionControl.DROP, priority=priority, express=is_express
        )
        due = time.monotonic()
        while (now := time.monotonic()) < until:
            publisher.put(STAMP.pack(now).ljust(SIZES[name], b"x"))
            due += 1 / RATES[name]
            time.sleep(max(0.0, due - time.monotonic()))

    threads = [threading.Thread(target=run, args=(name,)) for name in kinds]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    time.sleep(1.0)
    for session in sessions:
        session.close()


def listen(configs: list[str], _seconds: float) -> None:
    """The edge: latencies in ms of what comes, until the standard input ends."""
    came: dict[str, list[float]] = {name: [] for name in SIZES}

    def take(sample: zenoh.Sample) -> None:
        sent = STAMP.unpack_from(sample.payload.to_bytes())[0]
        came[str(sample.key_expr)].append(1000 * (time.monotonic() - sent))

    sessions = [zenoh.open(zenoh.Config.from_json5(text)) for text in configs]
    kept = [session.declare_subscriber(name, take) for session in sessions for name in SIZES]
    print("open", flush=True)
    sys.stdin.read()
    del kept
    print(json.dumps(came), flush=True)
    for session in sessions:
        session.close()


def child(network: netns.Network, place: str, what: str, configs: list[str], seconds: float) -> subprocess.Popen[str]:
    """One end, in its namespace."""
    command = [sys.executable, "-m", "benchmarks.quic", "--child", what, "--seconds", str(seconds), *configs]
    return subprocess.Popen(network.wrap(place, command), stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def run(network: netns.Network, tls: dict[str, Any], setup: tuple[str, str, int], seconds: float) -> dict[str, Any]:
    """Latencies of one set-up."""
    _, protocol, count = setup
    ends = [f"{protocol}/{network.address('edge1')}:{PORT + number}" for number in range(count)]
    makes = (control_config, data_config)[:count] if count == 2 else (data_config,)
    off = {"shared_memory": False}
    there, here = [], []
    for make, end in zip(makes, ends, strict=True):
        more: dict[str, Any] = off if make is data_config else {}
        there.append(with_tls(make(listen=(end,), connect=(), **more), tls))
        here.append(with_tls(make(listen=(), connect=(end,), **more), tls))
    with child(network, "edge1", "listen", there, seconds) as edge:
        assert edge.stdout is not None
        edge.stdout.readline()
        with child(network, "robot1", "send", here, seconds) as robot:
            robot.wait(seconds + 60)
        told, _ = edge.communicate("", timeout=60)
    found: dict[str, Any] = json.loads(told)
    return found


def main() -> None:
    """Print one line for each set-up and loss."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--mbit", type=float, default=20.0)
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--loss", type=int, nargs="+", default=[0, 1, 3], help="percent")
    parser.add_argument("--child", choices=("send", "listen"), help=argparse.SUPPRESS)
    parser.add_argument("configs", nargs="*", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.child is not None:
        {"send": send, "listen": listen}[given.child](given.configs, given.seconds)
        return
    if (reason := netns.why_not()) is not None:
        raise SystemExit(f"no network namespaces here: {reason}")
    print(machine())
    due = round(given.seconds * RATES["control"])
    with tempfile.TemporaryDirectory() as name, netns.Network(("robot1", "edge1")) as network:
        tls = certificates(Path(name))
        network.narrow("robot1", given.mbit)
        for percent in given.loss:
            if percent:
                network.lose(percent, "robot1", "edge1")
            for setup in SETUPS:
                came = run(network, tls, setup, given.seconds)
                control, bulk = came["control"], came["bulk"]
                figures = ", ".join(f"{percentile(control, q):.1f}" for q in (0.5, 0.99)) if control else "-"
                mbit = 8 * SIZES["bulk"] * len(bulk) / given.seconds / 1e6
                p50 = f"{percentile(bulk, 0.5):.0f}" if bulk else "-"
                print(
                    f"loss {percent} %  {setup[0]:<9} control p50, p99 {figures} ms, {len(control)} of {due} came; "
                    f"bulk {mbit:.1f} Mbit/s, p50 {p50} ms",
                    flush=True,
                )


if __name__ == "__main__":
    main()
