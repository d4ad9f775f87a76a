"""What looking costs: CPU of a daemon and of `zsched web`, with nobody there, with the page's server, with pages open.

``python -m benchmarks.web [--seconds 15] [--rounds 3] [--pages 3]``: a fleet of six at rest, asked through robot1. The
three states are measured in turns; CPU is the kernel's count of what the processes ran (``schedstat``), so other work
on the machine changes it little.
"""

from __future__ import annotations

import argparse
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from benchmarks.common import machine
from benchmarks.idle import memory, read
from zsched_lab.fleet.loopback import free_endpoint
from zsched_lab.fleet.testbed import Testbed, echo_fleet

NODE = "robot1"
START_S = 20.0
SETTLE_S = 2.0
"""A page's first answer holds the whole past."""
Place = tuple[str, int]


def cpu_shares(seconds: float, *pids: int) -> list[float]:
    """Percent of a core that each process takes over the next ``seconds``."""
    before, began = [sum(read(pid).cpu_ns.values()) for pid in pids], time.monotonic()
    time.sleep(seconds)
    took_s = time.monotonic() - began
    return [(sum(read(pid).cpu_ns.values()) - first) / 1e7 / took_s for pid, first in zip(pids, before, strict=True)]


@contextmanager
def web_server(folder: str) -> Iterator[tuple[int, Place]]:
    """(process id, (address, port)) of `zsched web`, which listens."""
    host, _, port = free_endpoint().removeprefix("tcp/").rpartition(":")
    place = host, int(port)
    command = [sys.executable, "-m", "zsched.cli", "web", "--listen", f"{host}:{port}"]
    process = subprocess.Popen([*command, "--runtime-dir", folder, "--node", NODE], stderr=subprocess.DEVNULL)
    try:
        end = time.monotonic() + START_S
        while not _listens(place):
            if time.monotonic() > end:
                raise TimeoutError(f"zsched web does not listen at {host}:{port} after {START_S:g} s")
            time.sleep(0.1)
        yield process.pid, place
    finally:
        process.terminate()
        process.wait(20)


def _listens(place: Place) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(place) == 0


@contextmanager
def pages(place: Place, count: int) -> Iterator[None]:
    """So many pages follow the fleet live."""
    with ExitStack() as stack:
        followed = [stack.enter_context(socket.create_connection(place, START_S)) for _ in range(count)]
        for one in followed:
            one.sendall(f"GET /api/live HTTP/1.1\r\nHost: {place[0]}:{place[1]}\r\n\r\n".encode())
        readers = [threading.Thread(target=_read, args=(one,)) for one in followed]
        for reader in readers:
            reader.start()
        try:
            yield
        finally:
            for one in followed:
                one.shutdown(socket.SHUT_RDWR)
            for reader in readers:
                reader.join(START_S)


def _read(page: socket.socket) -> None:
    page.settimeout(None)
    while page.recv(65536):
        pass


def main() -> None:
    """Print a row for each state: the daemon's share, the server's share and memory."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--pages", type=int, default=3)
    given = parser.parse_args()
    print(machine())
    states = {"nobody looks": None, "zsched web, no page": 0, f"zsched web, {given.pages} pages": given.pages}
    daemon: dict[str, list[float]] = {name: [] for name in states}
    server: dict[str, list[float]] = {name: [] for name in states}
    pss: dict[str, list[float]] = {name: [] for name in states}
    with tempfile.TemporaryDirectory() as folder, Testbed(Path(folder), echo_fleet()) as bed:
        bed.init()
        bed.start()
        bed.wait_settled()
        for _ in range(given.rounds):
            for name, count in states.items():
                if count is None:
                    daemon[name] += cpu_shares(given.seconds, bed.pid(NODE))
                    continue
                with web_server(folder) as (web, place), pages(place, count):
                    time.sleep(SETTLE_S)
                    shares = cpu_shares(given.seconds, bed.pid(NODE), web)
                    daemon[name].append(shares[0])
                    server[name].append(shares[1])
                    pss[name].append(memory(web)[0])
    print(f"| state (n = {given.rounds}) | daemon, % of a core | `zsched web`, % of a core | its PSS, MiB |")
    print("| --- | ---: | ---: | ---: |")
    for name in states:
        cells = [_middle(values[name]) for values in (daemon, server, pss)]
        print(f"| {name} | {' | '.join(cells)} |")


def _middle(values: list[float]) -> str:
    return f"{statistics.median(values):.2f}" if values else "-"


if __name__ == "__main__":
    main()
