"""How links come back after cuts, by the time that zenoh may take for one dial: ``python -m benchmarks.relink``.

Two equal fleets of plain zenoh sessions with our control settings, each in network namespaces of its own, are split in
halves at the same moments; they differ in ``transport/unicast/open_timeout``. A split is a little longer than zenoh's
lease, so that a redial's first SYN is lost and TCP's next one, a second later, gets through: a dial that is given up at
that very moment can leave a link that sends, never reads, and keeps all others out (decision 0036). A link is dead when
nothing has come by it 8 s after the split has healed; both fleets are then made anew. Needs root.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

import zenoh

from benchmarks.common import machine
from benchmarks.record import Record, progress, table
from zsched.core.values.fleet import Timing
from zsched.link.sessions import config as zenoh_config
from zsched_lab.fleet.netns import Network, why_not

LEASE_S = 1.0
BEAT_S = 0.1
HEARD_S = 0.5
"""A link works when its last beat is no older."""
DEAD_S = 8.0
SPLIT_S = (1.3, 2.1)
"""Lengths of the splits: the leases end after 1.0 to 1.25 s, the redials' second SYN is sent after 2.0 to 2.25 s."""


class Peers:
    """One fleet: a process and a namespace per session, every pair linked, dialled by the later of the two."""

    def __init__(self, count: int, open_timeout_s: float) -> None:
        self.names = [f"peer{index}" for index in range(count)]
        self._last_heard: dict[tuple[str, str], float] = {}
        self.network = Network(self.names)
        self._processes = [self._start(index, open_timeout_s) for index in range(count)]

    def _start(self, index: int, open_timeout_s: float) -> subprocess.Popen[str]:
        name, earlier = self.names[index], self.names[:index]
        config = json.loads(
            zenoh_config.control_config(
                listen=("tcp/0.0.0.0:7457",),
                connect=tuple(f"tcp/{self.network.address(other)}:7457" for other in earlier),
                timing=Timing(zenoh_lease_s=LEASE_S),
                dials_by_gossip=False,
            )
        )
        config["transport"]["unicast"]["open_timeout"] = round(open_timeout_s * 1000)
        command = self.network.wrap(
            name, [sys.executable, "-m", "benchmarks.relink", "--peer", name, json.dumps(config)]
        )
        process = subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "ZENOH_RUNTIME": zenoh_config.daemon_pools(len(self.names))},
        )
        threading.Thread(target=self._listen, args=(name, process), daemon=True).start()
        return process

    def _listen(self, name: str, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        for line in process.stdout:
            with contextlib.suppress(ValueError):  # zenoh's own words
                for other, age_s in json.loads(line).items():
                    self._last_heard[name, other] = time.monotonic() - age_s

    def missing(self) -> list[tuple[str, str]]:
        """(who hears nothing, of whom)."""
        limit = time.monotonic() - HEARD_S
        pairs = [(one, other) for one in self.names for other in self.names if one != other]
        return [pair for pair in pairs if self._last_heard.get(pair, 0.0) < limit]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for process in self._processes:
            process.kill()
            process.wait(10)
        self.network.close()


def peer(name: str, config: str) -> int:
    """One session of a fleet: beats, and says ten times a second how long ago it has heard whom."""
    heard: dict[str, float] = {}

    def on_beat(sample: zenoh.Sample) -> None:
        heard[str(sample.key_expr).rpartition("/")[2]] = time.monotonic()

    zenoh.init_log_from_env_or("off")
    with zenoh.open(zenoh.Config.from_json5(config)) as session:
        _subscriber = session.declare_subscriber("relink/*", on_beat)
        beats = session.declare_publisher(
            f"relink/{name}",
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.REAL_TIME,
            express=True,
            allowed_destination=zenoh.Locality.REMOTE,
        )
        while True:  # until it is killed
            beats.put(b"beat")
            now = time.monotonic()
            print(json.dumps({other: round(now - at, 3) for other, at in tuple(heard.items())}), flush=True)
            time.sleep(BEAT_S)


def until_whole(fleets: Sequence[Peers], deadline_s: float) -> list[float | None]:
    """After how many seconds nobody in a fleet missed anybody, or ``None``: one figure for each."""
    begin = time.monotonic()
    found: list[float | None] = [None] * len(fleets)
    while None in found and time.monotonic() < begin + deadline_s:
        for index, fleet in enumerate(fleets):
            if found[index] is None and not fleet.missing():
                found[index] = time.monotonic() - begin
        time.sleep(0.02)
    return found


def run(record: Record, given: argparse.Namespace) -> None:
    """All splits, with fresh fleets after each that left a dead link."""
    chance = random.Random(given.seed)
    while len(record.rows) < given.splits * len(given.open_timeout):
        with contextlib.ExitStack() as stack:
            fleets = [stack.enter_context(Peers(given.peers, seconds)) for seconds in given.open_timeout]
            if None in until_whole(fleets, 20.0):
                raise RuntimeError("the sessions do not find each other")
            while len(record.rows) < given.splits * len(given.open_timeout):
                half, length_s = chance.sample(fleets[0].names, given.peers // 2), chance.uniform(*SPLIT_S)
                for fleet in fleets:
                    fleet.network.separate(half, [name for name in fleet.names if name not in half])
                time.sleep(length_s)
                for fleet in fleets:
                    fleet.network.heal()
                took = until_whole(fleets, DEAD_S)
                for seconds, healed_s in zip(given.open_timeout, took, strict=True):
                    record.add({"open_timeout": seconds, "healed_s": healed_s})
                shown = ", ".join("dead" if one is None else f"{one:.2f} s" for one in took)
                progress(
                    f"split {len(record.rows) // len(fleets)}/{given.splits} of {length_s:.2f} s, whole after {shown}"
                )
                if None in took:
                    break


def main() -> int:
    """Print what came back when, side by side; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--open-timeout", type=float, nargs="+", default=[1.0, zenoh_config.OPEN_TIMEOUT_S])
    parser.add_argument("--splits", type=int, default=200)
    parser.add_argument("--peers", type=int, default=12)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--peer", nargs=2, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.peer:
        return peer(*given.peer)
    reason = why_not()
    if reason is not None:
        print(f"no network namespaces here: {reason}", file=sys.stderr)
        return 1
    print(machine(), flush=True)
    record = Record(given.out, "relink")
    run(record, given)
    rows = []
    for seconds in given.open_timeout:
        found = record.having(open_timeout=seconds)
        whole = [1000 * row["healed_s"] for row in found if row["healed_s"] is not None]
        dead = len(found) - len(whole)
        rows.append((f"open_timeout {seconds:g} s: {dead} of {len(found)} splits left a dead link", whole, "0 dead"))
    print(table(rows, "ms until all hear all"))
    return 0


if __name__ == "__main__":
    sys.exit(main())
