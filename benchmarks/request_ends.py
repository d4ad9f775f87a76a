"""When requests end whose owner is killed under them: ``python -m benchmarks.request_ends [--kills 150]``.

Two kinds of askers ask one owner without a pause, a few threads of each: by zenoh's own ``get``, and through the
relay's service, which asks by the same session. A request that leaves in the first milliseconds after the owner's death
is left to its time by zenoh 1.10.2; the relay ends it. Reported is how long those requests took that nobody answered.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

import zenoh

from benchmarks.common import machine
from benchmarks.record import Record, progress, table
from zsched.core.values.plan import Direction, Route, ServiceSettings, StreamSettings
from zsched.link.sessions.config import data_config, worker_config
from zsched.relay.services.service import ServiceStream
from zsched_lab.fleet.loopback import free_endpoints
from zsched_lab.fleet.pace import at_pace
from zsched_lab.fleet.waiting import until

ASKED, OWNERS = "robot1/ask", "edge1/echo/robot1/ask"
TIME_S: Final = 2.0
"""What a request may take: those that take as long ended by nothing else."""
ASKERS: Final = 3
LOOK_HZ: Final = 100
"""How often a relay looks after its requests while their owner is gone."""


def owner(endpoint: str) -> int:
    """The owner's process: answers until it is killed."""

    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply(query.key_expr, b"")

    with zenoh.open(zenoh.Config.from_json5(worker_config(connect=(endpoint,), shared_memory=False))) as session:
        _queryable = session.declare_queryable(OWNERS, answer, complete=True)
        print("up", flush=True)
        threading.Event().wait()
    return 0


class Asking:
    """Threads that ask without a pause until they are told to halt; keeps what each request took in vain, seconds."""

    def __init__(self, session: zenoh.Session, key: str, timeout_s: float, may_ask: Callable[[], bool]) -> None:
        self.in_vain_s: list[float] = []
        self.answered = 0
        self._session, self._key, self._timeout_s, self._may_ask = session, key, timeout_s, may_ask
        self._halt = threading.Event()
        self._threads = [threading.Thread(target=self._run, daemon=True) for _ in range(ASKERS)]
        for thread in self._threads:
            thread.start()

    def _run(self) -> None:
        while not self._halt.is_set():
            if not self._may_ask():
                self._halt.wait(0.001)
                continue
            started = time.monotonic()
            replies = self._session.get(self._key, timeout=self._timeout_s, consolidation=zenoh.ConsolidationMode.NONE)
            if any(reply.ok is not None for reply in replies):
                self.answered += 1
            else:
                self.in_vain_s.append(time.monotonic() - started)

    def halt(self) -> None:
        """Wait for the last word."""
        self._halt.set()
        for thread in self._threads:
            thread.join(2 * TIME_S + 5.0)


def run(record: Record, kills: int) -> None:
    """One owner after the other, asked and killed."""
    endpoint, application = free_endpoints(2)
    route = Route(
        stream="echo/srv/0",
        direction=Direction.SERVICE,
        from_expr=ASKED,
        to_expr=OWNERS,
        settings=StreamSettings(),
        service=ServiceSettings(timeout_s=TIME_S, hold_s=0.0, max_pending=64),
    )
    text = data_config(listen=(endpoint, application), connect=(), shared_memory=False)
    with (
        zenoh.open(zenoh.Config.from_json5(text)) as relay,
        zenoh.open(zenoh.Config.from_json5(worker_config(connect=(application,), shared_memory=False))) as app,
    ):
        stream = ServiceStream(relay, route)
        stream.open(1, route)
        stream.flip(1)
        with at_pace(LOOK_HZ, stream.look_after):
            for number in range(kills):
                one_kill(record, number, endpoint, relay, app, stream)
                progress(f"kill {number + 1}/{kills}")
        stream.close()


def one_kill(
    record: Record, number: int, endpoint: str, relay: zenoh.Session, app: zenoh.Session, stream: ServiceStream
) -> None:
    """Both kinds of askers on one owner's death."""
    command = [sys.executable, "-m", "benchmarks.request_ends", "--owner", endpoint]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        try:
            assert process.stdout is not None
            process.stdout.readline()
            until(lambda: stream.is_matching(1), "the owner is found")
            both = {
                "zenoh's get": Asking(relay, OWNERS, TIME_S, lambda: stream.is_matching(1)),
                "the relay": Asking(app, ASKED, TIME_S + 1.0, lambda: stream.is_matching(1)),
            }
            until(lambda: all(asking.answered >= 20 for asking in both.values()), "both kinds are answered")
        finally:
            process.kill()
            process.wait(10)
    until(lambda: not stream.is_matching(1), "the owner is missed")
    for side, asking in both.items():
        asking.halt()
        record.add({"side": side, "kill": number, "in_vain_ms": [1000 * one for one in asking.in_vain_s]})


def main() -> int:
    """Print both sides' distributions; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=150)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--owner", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.owner:
        return owner(given.owner)
    print(machine(), flush=True)
    record = Record(given.out, "request_ends")
    run(record, given.kills)
    rows = []
    for side in ("zenoh's get", "the relay"):
        each = [row["in_vain_ms"] for row in record.having(side=side)]
        late = sum(any(one >= 1000 * TIME_S for one in found) for found in each)
        name = f"{side}: in {late} of {len(each)} kills some took all their time"
        rows.append((name, [one for found in each for one in found], "0 kills"))
    print(table(rows, "ms until a request without an answer ended"))
    return 0


if __name__ == "__main__":
    sys.exit(main())
