"""How long a link that loses packets is silent: with the system's waits, and with equal ones.

``python -m benchmarks.link_retries [--links 60] [--seconds 120] [--loss 20]``. Needs root: two network namespaces in
which this many of 100 packets are lost on their way in. Half of the connections have the waits of the control session's
links (`zsched.link.sessions.link_retries`). Over each one both ends send 150 bytes every 0.2 s, as beats do. Prints
how many silences of an hour and link were longer.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import random
import select
import socket
import subprocess
import sys
import time
from collections.abc import Iterable

from benchmarks.common import machine, percentile
from zsched.link.sessions.link_sockets import retry_steadily
from zsched_lab.fleet.netns import Network

PORT, PERIOD_S, BYTES, OPEN_S = 7457, 0.2, 150, 60.0
LIMITS_S = (0.6, 0.9, 1.2, 1.5, 1.8, 3.0)


def connections(address: str, count: int, *, is_listener: bool) -> list[socket.socket]:
    """The same ones at both ends, in the order of their ports at the dialling end."""
    found: list[socket.socket] = []
    if is_listener:
        with socket.create_server((address, PORT), backlog=count) as door:
            door.settimeout(OPEN_S)
            while len(found) < count:
                found.append(door.accept()[0])
        return sorted(found, key=lambda one: one.getpeername()[1])
    until = time.monotonic() + OPEN_S
    while len(found) < count and time.monotonic() < until:
        with contextlib.suppress(OSError):
            found.append(socket.create_connection((address, PORT), timeout=OPEN_S))
    return sorted(found, key=lambda one: one.getsockname()[1])


def silences(links: Iterable[socket.socket], seconds: float) -> list[list[float]]:
    """The time between what has come by each link, all of them in turn sent to."""
    links = list(links)
    poll, begun = select.poll(), time.monotonic() + 1.0
    due, heard_at = dict[int, float](), dict.fromkeys(range(len(links)), begun)
    found: list[list[float]] = [[] for _ in links]
    numbers = {link.fileno(): number for number, link in enumerate(links)}
    for number, link in enumerate(links):
        link.setblocking(False)
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        poll.register(link, select.POLLIN)
        due[number] = begun + random.random() * PERIOD_S
    while (now := time.monotonic()) < begun + seconds:
        for number, at in due.items():
            if at <= now:
                due[number] = at + PERIOD_S
                with contextlib.suppress(OSError):
                    links[number].send(bytes(BYTES))
        for fd, _ in poll.poll(max(1.0, 1000 * (min(due.values()) - time.monotonic()))):
            with contextlib.suppress(OSError):
                if not links[numbers[fd]].recv(1 << 16):
                    poll.unregister(fd)
            now, number = time.monotonic(), numbers[fd]
            found[number].append(now - heard_at[number])
            heard_at[number] = now
    return found


def play(address: str, count: int, seconds: float, *, is_listener: bool) -> None:
    """One end: every second link has equal waits; print the silences of both halves."""
    links = connections(address, count, is_listener=is_listener)
    steady = links[::2]
    done = retry_steadily((one.getsockname(), one.getpeername()) for one in steady)
    if done != len(steady):
        sys.exit(f"{done} of {len(steady)} links could be set")
    found = silences(links, seconds)
    print(json.dumps({"equal": found[::2], "system": found[1::2]}))


def measure(count: int, seconds: float, loss: int) -> dict[str, list[float]]:
    """The silences of both kinds, as both ends heard them."""
    found: dict[str, list[float]] = {"system": [], "equal": []}
    with Network(("there", "here")) as network:
        network.lose(loss, "there", "here")
        address = network.address("there")
        ends = []
        for name in ("there", "here"):
            command = [sys.executable, "-m", "benchmarks.link_retries", "--end", name, "--address", address]
            command += ["--links", str(count), "--seconds", str(seconds)]
            ends.append(subprocess.Popen(network.wrap(name, command), stdout=subprocess.PIPE, text=True))
            time.sleep(0.5)
        for end in ends:
            told = json.loads(end.communicate(timeout=seconds + 3 * OPEN_S)[0])
            for kind, links in told.items():
                found[kind] += [silence for link in links for silence in link]
    return found


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--links", type=int, default=60)
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--loss", type=int, default=20)
    parser.add_argument("--end", choices=["there", "here"], help=argparse.SUPPRESS)
    parser.add_argument("--address", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.end:
        play(given.address, given.links, given.seconds, is_listener=given.end == "there")
        return 0
    found = measure(given.links, given.seconds, given.loss)
    hours = given.links * given.seconds / 3600  # of both ends together, for half of the links each
    print(machine())
    print(f"{given.loss} % lost each way; silences of an hour and link that were longer than")
    print("| waits | " + " | ".join(f"{limit:g} s" for limit in LIMITS_S) + " | p99 | most |")
    print("| --- " * (len(LIMITS_S) + 3) + "|")
    for kind, times in found.items():
        longer = " | ".join(f"{sum(one > limit for one in times) / hours:.0f}" for limit in LIMITS_S)
        print(f"| {kind} | {longer} | {1000 * percentile(times, 0.99):.0f} ms | {max(times):.1f} s |")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
