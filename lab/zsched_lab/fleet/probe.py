"""A robot's application as a process of its own: numbered, timed messages out, and what comes back with the time.

Knows: zenoh as a client of one node. Does not know: fleets, tasks; it shows what an application sees, wherever it runs
(in another network namespace too, where the test itself cannot open sockets).

``python -m zsched_lab.fleet.probe CONFIG --put KEY --hz N --watch KEYEXPR ...``; CONFIG is JSON5 text. A message is
``NUMBER SENT_AT`` in seconds of CLOCK_BOOTTIME; per received sample one line goes to standard output:
``KEY NUMBER SENT_AT EPOCH RECEIVED_AT SCHEMA`` (EPOCH is ``-`` unless the payload has a third word; the schema of the
encoding names the worker's node). It ends with its standard input.
"""

from __future__ import annotations

import argparse
import os
import queue
import sys
import threading
import time

import zenoh

from zsched.host.clock import monotonic_s
from zsched.host.guard import guarded

OPEN_S = 120.0
"""A relay takes 20 s to start on a machine where a dozen processes start beside it; a hang takes longer."""


def main() -> int:
    """Run until the standard input ends; the exit code."""
    parser = argparse.ArgumentParser(description="a robot's application")
    parser.add_argument("config")
    parser.add_argument("--put", default="")
    parser.add_argument("--hz", type=float, default=50.0)
    parser.add_argument("--size", type=int, default=0, help="pad messages to so many bytes")
    parser.add_argument("--burst", type=int, default=1, help="put so many at once, and wait for as many turns")
    parser.add_argument("--one-stamp", action="store_true", help="give what is put at once one zenoh timestamp")
    parser.add_argument("--block", action="store_true", help="wait for room, drop nothing")
    parser.add_argument("--watch", action="append", default=[])
    given = parser.parse_args()
    stop = threading.Event()
    guarded(_stop_at_end, stop, name="stop", is_lasting=False).start()
    session = _open(given.config, stop)
    if session is None:
        return 1
    lines: queue.SimpleQueue[str] = queue.SimpleQueue()
    guarded(_write, lines, name="write", is_lasting=False).start()
    kept = [session.declare_subscriber(key, lambda sample: lines.put(_line(sample))) for key in given.watch]
    print("open", flush=True)
    _send(session, given, stop)
    del kept
    return 0


def _stop_at_end(stop: threading.Event) -> None:
    sys.stdin.read()
    stop.set()


def _open(config: str, stop: threading.Event) -> zenoh.Session | None:
    """A client's ``open`` fails while nobody listens: try again for a while."""
    end = time.monotonic() + OPEN_S
    while not stop.is_set() and time.monotonic() < end:
        try:
            return zenoh.open(zenoh.Config.from_json5(config))
        except zenoh.ZError as error:
            print(f"# {error}", file=sys.stderr)
            stop.wait(0.1)
    return None


def _line(sample: zenoh.Sample) -> str:
    words = sample.payload.to_bytes()[:64].decode("ascii", "replace").split()
    number, sent_at, epoch = (*words[:3], *("-" * (3 - len(words))))
    schema = str(sample.encoding).partition(";")[2] or "-"
    return f"{sample.key_expr} {number} {sent_at} {epoch} {monotonic_s():.6f} {schema}"


def _write(lines: queue.SimpleQueue[str]) -> None:
    while True:
        print(lines.get(), flush=True)


def _send(session: zenoh.Session, given: argparse.Namespace, stop: threading.Event) -> None:
    control = zenoh.CongestionControl.BLOCK if given.block else zenoh.CongestionControl.DROP
    publisher = session.declare_publisher(given.put, congestion_control=control) if given.put else None
    number = 0
    while not stop.wait(given.burst / given.hz):
        if publisher is None:
            continue
        stamp = session.new_timestamp() if given.one_stamp else None
        for _ in range(given.burst):
            message = f"{number:010d} {monotonic_s():.6f}"
            publisher.put(message.ljust(given.size).encode(), timestamp=stamp)
            number += 1


if __name__ == "__main__":
    code = main()
    sys.stdout.flush()
    os._exit(code)  # zenoh's threads must not be waited for
