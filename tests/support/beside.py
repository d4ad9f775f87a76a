"""A stream of another application, from a process of its own: what else a relay carries must not wait for a frozen one.

Knows: two sessions, one publisher, one subscriber, when every sample came. Does not know: relays, who is frozen.

The sessions of a process share zenoh's pools. One thread closes the links of them all, and the end of a link to a
frozen worker takes it as long as the socket lingers; beside it other sessions of that process give no sign of life, and
are left. So this one has a process, and several such threads.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from itertools import pairwise

import zenoh

from zsched.link.sessions.config import worker_config, worker_pools

PERIOD_S = 0.005
COUPLED = "coupled"
"""What is told of a sample with this payload; of every other, nothing but when it came."""


class Beside:
    """The process, seen from the test."""

    def __init__(self, *, near: str, far: str, from_expr: str, to_expr: str) -> None:
        """Start it, and wait until its samples come from the node at ``near`` to the one at ``far``."""
        self.arrivals: list[float] = []
        self._on_coupled: Callable[[], None] = lambda: None
        self._process = subprocess.Popen(
            [sys.executable, __file__, near, far, from_expr, to_expr],
            env=os.environ | {"ZENOH_RUNTIME": worker_pools(3, 2)},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            at, what = line.split(" ")
            self.arrivals.append(float(at))
            if what.strip() == COUPLED:
                self._on_coupled()

    def on_coupled(self, call: Callable[[], None]) -> None:
        """Call it at every sample ``coupled``."""
        self._on_coupled = call

    def longest_gap(self) -> float:
        """From the tenth sample on."""
        arrivals = tuple(self.arrivals)
        assert len(arrivals) > 200
        return max(later - earlier for earlier, later in pairwise(arrivals[10:]))

    def close(self) -> None:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()
        try:
            self._process.wait(60)
        finally:
            self._process.kill()
            self._process.wait(10)
            self._reader.join(10)
            self._process.stdout.close()


def main(near: str, far: str, from_expr: str, to_expr: str) -> None:
    """Put a sample every 5 ms, and print when each comes, until nobody holds standard input."""

    def take(sample: zenoh.Sample) -> None:
        what = COUPLED if sample.payload.to_bytes() == COUPLED.encode() else "-"
        print(f"{time.monotonic()} {what}", flush=True)

    config = zenoh.Config.from_json5(worker_config(connect=(far,)))
    config.insert_json5("id", '"1"')  # the lowest of all: the others dial it, and so does the relay
    with (
        zenoh.open(config) as there,
        zenoh.open(zenoh.Config.from_json5(worker_config(connect=(near,)))) as here,
    ):
        there.declare_subscriber(to_expr, take)
        source = here.declare_publisher(from_expr)
        halt = threading.Event()

        def wait() -> None:
            sys.stdin.read()
            halt.set()

        threading.Thread(target=wait, daemon=True).start()
        while not halt.wait(PERIOD_S):
            source.put(b"x")


if __name__ == "__main__":
    main(*sys.argv[1:])
