"""zenoh alone: what a session still reads of a link that it ended itself may come under another key it subscribes to.

Two zenoh sessions, nothing of zsched between them; docs/develop/zenoh-stale-keys.md is the report.
"""

from __future__ import annotations

import subprocess
import sys
import threading
from typing import Any

import pytest
import zenoh

from support.sessions import opened
from support.waiting import free_endpoint, until
from zsched.link.sessions.config import client_config, data_config

pytestmark = pytest.mark.long

KEYS = 30
TIMES = 8
A_READ = 1500
"""So many of these samples are in one batch of zenoh's, and some."""
SUBSCRIBER = """
import sys, time
import zenoh
from zsched.link.sessions.link_sockets import LinkSockets

counts, keys = [0, 0], int(sys.argv[3])

def take(sample):
    counts[0] += 1
    counts[1] += str(sample.key_expr).encode() not in sample.payload.to_bytes().split()

with zenoh.open(zenoh.Config.from_json5(sys.argv[1])) as session:
    kept = [session.declare_subscriber(f"of/{key:02}", take) for key in range(keys)]
    sockets = LinkSockets(session)
    print("there", flush=True)
    for line in sys.stdin:
        if line == "end\\n":
            for link in sockets.links():
                getattr(link, sys.argv[2])()
        print(*counts, flush=True)
"""


class Subscriber:
    """A client in a process of its own, which ends its link when it is told to."""

    def __init__(self, endpoint: str, how: str) -> None:
        config = client_config(connect=(endpoint,), connect_s=20.0)
        command = [sys.executable, "-c", SUBSCRIBER, config, how, str(KEYS)]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self._read()

    def _read(self) -> list[str]:
        assert self._process.stdout is not None
        return self._process.stdout.readline().split()

    def tell(self, word: str) -> tuple[int, int]:
        """``end``: it ends its link; answers (samples so far, those under another key)."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{word}\n")
        self._process.stdin.flush()
        count, wrong = self._read()
        return int(count), int(wrong)

    def end(self) -> None:
        self._process.kill()
        self._process.communicate(timeout=60)


class Feeder:
    """Puts on all keys at full speed, in one thread."""

    def __init__(self, session: zenoh.Session) -> None:
        drop = zenoh.CongestionControl.DROP
        self._publishers: list[tuple[bytes, Any]] = [
            (key.encode() + b" " * 60, session.declare_publisher(key, congestion_control=drop))
            for key in (f"of/{number:02}" for number in range(KEYS))
        ]
        self._halt = threading.Event()
        self._thread = threading.Thread(target=self._feed, daemon=True)
        self._thread.start()

    def _feed(self) -> None:
        while not self._halt.is_set():
            for payload, publisher in self._publishers:
                publisher.put(payload)

    def end(self) -> None:
        self._halt.set()
        self._thread.join(20)


def most_wrong(how: str, enough: int = 1 << 30) -> int:
    """End the link by ``how`` (`LinkSocket`) again and again; how many samples came under another key at one time.

    ``enough``: no more times behind so many.
    """
    endpoint, most = free_endpoint(), 0
    with opened(data_config(listen=(endpoint,), connect=(), shared_memory=False)) as session:
        feeder, subscriber = Feeder(session), Subscriber(endpoint, how)
        try:
            for _ in range(TIMES):
                flows(subscriber)
                _, before = subscriber.tell("end")
                flows(subscriber)
                most = max(most, subscriber.tell("count")[1] - before)
                if most > enough:
                    break
            return most
        finally:
            subscriber.end()
            feeder.end()


def flows(subscriber: Subscriber) -> None:
    """The stream has come (again), for long enough that what waited in a socket has been read."""
    began, _ = subscriber.tell("count")
    until(lambda: subscriber.tell("count")[0] > began + 150_000, "the stream")


def test_zenoh_reads_what_came_by_a_link_that_has_ended_under_other_keys() -> None:
    """When this fails for good, zenoh has mended it, and `LinkSocket.abort` may be `cut` everywhere."""
    assert most_wrong("cut", A_READ) > A_READ


def test_what_came_by_a_link_that_is_aborted_is_not_read() -> None:
    """But for what zenoh has in its hand: one batch of 64 KiB."""
    assert most_wrong("abort") <= A_READ
