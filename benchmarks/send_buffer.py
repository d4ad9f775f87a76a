"""What a data link's send buffer costs a large sample, in plain text and over TLS: round trips of 1 MiB.

``python -m benchmarks.send_buffer [--count 200] [--bytes 65536 262144 0]``. Two processes on loopback, opened as relays
open their data session, with this kernel send buffer (0: the kernel's own size). For the packets of an Ethernet:
``unshare -n sh -c "ip link set lo mtu 1500 up; python -m benchmarks.send_buffer"``.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import zenoh

from benchmarks.common import machine, percentile
from benchmarks.silent import certificates, with_tls
from zsched.sessions.config import DATA_SEND_BUFFER, data_config
from zsched_lab.fleet.loopback import free_endpoint

MIB, SLOW_MS = 1 << 20, 150.0
ECHO = """
import sys, zenoh
session = zenoh.open(zenoh.Config.from_json5(sys.argv[1]))
back = session.declare_publisher("back", congestion_control=zenoh.CongestionControl.BLOCK)
kept = session.declare_subscriber("there", lambda sample: back.put(sample.payload))
print(flush=True)
sys.stdin.read()
session.close()
"""


def round_trips(listener: str, dialler: str, count: int) -> list[float]:
    """Milliseconds of each one that came back within 5 s."""
    taken, came = [], threading.Event()
    with subprocess.Popen(
        [sys.executable, "-c", ECHO, listener], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as echo:
        assert echo.stdout is not None
        echo.stdout.readline()
        with zenoh.open(zenoh.Config.from_json5(dialler)) as session:
            kept = session.declare_subscriber("back", lambda _: came.set())
            publisher = session.declare_publisher("there", congestion_control=zenoh.CongestionControl.BLOCK)
            time.sleep(1.0)
            for _ in range(count):
                came.clear()
                began = time.monotonic()
                publisher.put(bytes(MIB))
                if came.wait(5.0):
                    taken.append(1000 * (time.monotonic() - began))
            del kept
        echo.communicate("")
    return taken


def main() -> None:
    """Print one line for each protocol and size."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--bytes", type=int, nargs="+", default=[DATA_SEND_BUFFER, 4 * DATA_SEND_BUFFER, 0])
    given = parser.parse_args()
    print(machine())
    ours = f"#so_sndbuf={DATA_SEND_BUFFER}"
    with tempfile.TemporaryDirectory() as name:
        tls = certificates(Path(name))
        for protocol in ("tcp", "tls"):
            for size in given.bytes:
                end = free_endpoint().partition("#")[0].replace("tcp/", f"{protocol}/")
                ends = [
                    with_tls(data_config(listen=listen, connect=connect, shared_memory=False), tls).replace(
                        ours, f"#so_sndbuf={size}" if size else ""
                    )
                    for listen, connect in (((end,), ()), ((), (end,)))
                ]
                taken = round_trips(ends[0], ends[1], given.count)
                slow = sum(one > SLOW_MS for one in taken)
                told = f"p50 {percentile(taken, 0.5):.1f} p99 {percentile(taken, 0.99):.1f} ms (n={len(taken)})"
                print(f"{protocol}  send buffer {size or 'of the kernel':<18} {told}, {slow} above 150 ms", flush=True)


if __name__ == "__main__":
    main()
