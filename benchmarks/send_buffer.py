"""What a data link's send buffer costs a large sample, in plain text and over TLS: round trips of 1 MiB.

``python -m benchmarks.send_buffer [--count 200] [--bytes 65536 262144 0]``. Two processes on loopback, opened as relays
open their data session, with this kernel send buffer (0: the kernel's own size), and with one that is sized while it
is used, as relays and workers have it (decision 0094). For the packets of an Ethernet:
``unshare -n sh -c "ip link set lo mtu 1500 up; python -m benchmarks.send_buffer"``.
"""

from __future__ import annotations

import argparse
import contextlib
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import zenoh

from benchmarks.common import machine, percentile
from benchmarks.silent import certificates, with_tls
from zsched.link.sessions.config import DATA_SEND_BUFFER, data_config
from zsched.link.sessions.link_buffers import LinkBuffers
from zsched.link.sessions.link_sockets import LinkSockets
from zsched.link.sessions.stalled_links import StalledLinks
from zsched_lab.fleet.loopback import free_endpoint

MIB, SLOW_MS = 1 << 20, 150.0
SIZED = -1
LOOKED_AT, LOOKS = 6, 1000
ECHO = """
import contextlib, sys, zenoh
from zsched.link.sessions.link_buffers import LinkBuffers
from zsched.link.sessions.link_sockets import LinkSockets
from zsched.link.sessions.stalled_links import StalledLinks
session = zenoh.open(zenoh.Config.from_json5(sys.argv[1]))
watch = StalledLinks(session, 1000.0) if sys.argv[2] == "sized" else contextlib.nullcontext()
back = session.declare_publisher("back", congestion_control=zenoh.CongestionControl.BLOCK)
def answer(sample):
    with watch:
        back.put(sample.payload)
kept = session.declare_subscriber("there", answer)
print(flush=True)
sys.stdin.read()
session.close()
"""


def round_trips(listener: str, dialler: str, count: int, *, is_sized: bool) -> list[float]:
    """Milliseconds of each one that came back within 5 s."""
    taken, came = [], threading.Event()
    word = "sized" if is_sized else ""
    with subprocess.Popen(
        [sys.executable, "-c", ECHO, listener, word], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as echo:
        assert echo.stdout is not None
        echo.stdout.readline()
        with zenoh.open(zenoh.Config.from_json5(dialler)) as session:
            kept = session.declare_subscriber("back", lambda _: came.set())
            publisher = session.declare_publisher("there", congestion_control=zenoh.CongestionControl.BLOCK)
            watch = StalledLinks(session, 1000.0) if is_sized else contextlib.nullcontext()
            time.sleep(1.0)
            for _ in range(count):
                came.clear()
                began = time.monotonic()
                with watch:
                    publisher.put(bytes(MIB))
                if came.wait(5.0):
                    taken.append(1000 * (time.monotonic() - began))
            del kept
            if isinstance(watch, StalledLinks):
                watch.close()
        echo.communicate("")
    return taken


def cost_of_a_look() -> float:
    """Microseconds of CPU for each link of a session, while nothing is put."""
    end = free_endpoint()
    configs = (((end,), ()), *(((), (end,)) for _ in range(LOOKED_AT)))
    texts = [data_config(listen=listen, connect=connect, shared_memory=False) for listen, connect in configs]
    with contextlib.ExitStack() as stack:
        hub, *_ = [stack.enter_context(zenoh.open(zenoh.Config.from_json5(text))) for text in texts]
        time.sleep(1.0)
        buffers, links = LinkBuffers(hub), len(LinkSockets(hub).links())
        began = time.process_time()
        for _ in range(LOOKS):
            buffers.look(at_once=True)
        return 1e6 * (time.process_time() - began) / LOOKS / links


def main() -> None:
    """Print one line for each protocol and size."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--bytes", type=int, nargs="+", default=[DATA_SEND_BUFFER, 4 * DATA_SEND_BUFFER, 0])
    given = parser.parse_args()
    print(machine())
    ours = f"#so_sndbuf={DATA_SEND_BUFFER}"
    with tempfile.TemporaryDirectory() as folder:
        tls = certificates(Path(folder))
        for protocol in ("tcp", "tls"):
            for size in (*given.bytes, SIZED):
                end = free_endpoint().partition("#")[0].replace("tcp/", f"{protocol}/")
                ends = [
                    with_tls(data_config(listen=listen, connect=connect, shared_memory=False), tls).replace(
                        ours, f"#so_sndbuf={size}" if size > 0 else ours if size == SIZED else ""
                    )
                    for listen, connect in (((end,), ()), ((), (end,)))
                ]
                taken = round_trips(ends[0], ends[1], given.count, is_sized=size == SIZED)
                slow = sum(one > SLOW_MS for one in taken)
                told = f"p50 {percentile(taken, 0.5):.1f} p99 {percentile(taken, 0.99):.1f} ms (n={len(taken)})"
                name = {0: "of the kernel", SIZED: "sized while used"}.get(size, str(size))
                print(f"{protocol}  send buffer {name:<18} {told}, {slow} above 150 ms", flush=True)
    print(f"a look at a link: {cost_of_a_look():.1f} us of CPU")


if __name__ == "__main__":
    main()
