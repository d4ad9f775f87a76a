"""Attackers that send as much as one process can: frames, questions, tokens, connections.

``python -m zsched_lab.fleet.floods frames|questions|tokens --config JSON --key KEY --count N``. It prints how many it
has sent and in which time, and holds tokens until its standard input ends.

Knows: zenoh, sockets. Does not know: what is in a frame, what becomes of it.
"""

from __future__ import annotations

import argparse
import contextlib
import socket
import sys
import time
from collections.abc import Iterator

import zenoh

HEARD_S = 30.0
"""It waits this long until somebody hears it."""


def frames(session: zenoh.Session, key: str, payload: bytes, count: int) -> None:
    """Put ``count`` frames under one key; what the network does not take is dropped."""
    publisher = session.declare_publisher(key, congestion_control=zenoh.CongestionControl.DROP)
    end = time.monotonic() + HEARD_S
    while not getattr(publisher.matching_status, "matching", False) and time.monotonic() < end:
        time.sleep(0.01)
    start = time.monotonic()
    for _ in range(count):
        publisher.put(payload)
    print(f"sent={count} s={time.monotonic() - start:.2f}", flush=True)


def questions(session: zenoh.Session, key: str, payload: bytes, count: int) -> None:
    """Ask ``count`` times, and wait for no answer."""
    start = time.monotonic()
    for _ in range(count):
        session.get(key, lambda _: None, payload=payload, attachment=payload, timeout=1.0)
    print(f"sent={count} s={time.monotonic() - start:.2f}", flush=True)


def tokens(session: zenoh.Session, key: str, _payload: bytes, count: int) -> None:
    """Show ``count`` tokens below a key, and hold them."""
    start = time.monotonic()
    held = [session.liveliness().declare_token(f"{key}/{number}") for number in range(1, count + 1)]
    print(f"sent={len(held)} s={time.monotonic() - start:.2f}", flush=True)
    sys.stdin.read()


@contextlib.contextmanager
def connections(endpoint: str, count: int) -> Iterator[int]:
    """Hold up to ``count`` connections that say nothing; how many were made."""
    host, _, port = endpoint.partition("/")[2].partition("#")[0].rpartition(":")
    with contextlib.ExitStack() as stack:
        made = 0
        for _ in range(count):
            with contextlib.suppress(OSError):
                stack.enter_context(socket.create_connection((host.strip("[]"), int(port)), 0.5))
                made += 1
        yield made


FLOODS = {"frames": frames, "questions": questions, "tokens": tokens}


def main() -> None:
    """One attacker."""
    parser = argparse.ArgumentParser(prog="python -m zsched_lab.fleet.floods", description=__doc__)
    parser.add_argument("kind", choices=sorted(FLOODS))
    parser.add_argument("--config", required=True, help="of its session, JSON5")
    parser.add_argument("--key", required=True)
    parser.add_argument("--payload", default="", help="hex")
    parser.add_argument("--count", type=int, default=100_000)
    given = parser.parse_args()
    with zenoh.open(zenoh.Config.from_json5(given.config)) as session:
        FLOODS[given.kind](session, given.key, bytes.fromhex(given.payload), given.count)


if __name__ == "__main__":
    main()
