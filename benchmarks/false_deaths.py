"""How often a living node is taken for dead: on busy cores, and on links that lose packets.

``python -m benchmarks.false_deaths [--minutes 10] [--case wired-busy wifi-busy wifi-loss5 wifi-loss20] [--together]
[--out FOLDER] [--table]``. Needs root: six daemons in network namespaces with echo workers per case. ``busy``: an
endless loop per core runs beside them; ``lossP``: P of 100 packets are dropped on their way into every namespace.
Without faults every *gone* is a false death, every newer epoch a needless move. ``--together`` runs the cases at the
same time, busy ones with busy ones. With ``--out`` every minute is on disk at once, and the same command goes on where
it was interrupted.

Goals: 0 false deaths in 10 minutes with all cores saturated (`wired` and `wifi`), 0 at 5 % loss (`wifi`); at 20 % the
figure.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from benchmarks.common import machine
from benchmarks.record import Record, progress, save, together
from zsched.core.values.model import PeerState
from zsched.host.clock import monotonic_s
from zsched_lab.fleet import netns
from zsched_lab.fleet.netbed import Netbed
from zsched_lab.fleet.testbed import echo_fleet

SETTLE_S = 5.0
SLICE_S = 60.0
BUSY_LOOP = (sys.executable, "-c", "while True: pass")


@dataclass(frozen=True, slots=True)
class Case:
    """What the fleet goes through."""

    timing: str
    is_busy: bool = False
    loss: int = 0
    goal: str = "0"


CASES = {
    "wired-busy": Case("wired", is_busy=True),
    "wifi-busy": Case("wifi", is_busy=True),
    "wifi-loss5": Case("wifi", loss=5),
    "wifi-loss20": Case("wifi", loss=20, goal="-"),
}


@contextlib.contextmanager
def busy_cores(count: int) -> Iterator[None]:
    """Endless loops, ended with the context."""
    loops = [subprocess.Popen(BUSY_LOOP) for _ in range(count)]
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()


def pass_time(bed: Netbed, seconds: float) -> None:
    """Let time pass; stop early when a daemon has died."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        time.sleep(min(5.0, max(end - time.monotonic(), 0.0)))
        for node in bed.running():
            if not Path(f"/proc/{bed.pid(node)}").exists():
                raise SystemExit(f"{node} has died:\n{bed.log(node)[-2000:]}")


def watch(record: Record, name: str, minutes: float) -> None:
    """Run what is missing of a case's time, and count in slices of a minute."""
    case = CASES[name]
    tree = echo_fleet(timing=case.timing, scheduling={"price_s": 2})
    with tempfile.TemporaryDirectory() as folder, Netbed(Path(folder), tree) as bed:
        bed.init()
        bed.start()
        bed.wait_settled(60)
        bed.probe("robot1", put="robot1/in", hz=50, watch=["robot1/out"])
        if case.loss:
            bed.network.lose(case.loss, *bed.names)
        pass_time(bed, SETTLE_S)
        while (left_s := minutes * 60 - seconds_of(record, name)) > 0.5:
            slice_s = min(SLICE_S, left_s)
            start, before = monotonic_s(), bed.task("robot1")["epoch"]
            pass_time(bed, slice_s)
            changes = bed.changes(since=start)
            deaths = [one for one in changes if one.after is PeerState.GONE]
            row = {
                "case": name,
                "seconds": slice_s,
                "deaths": [f"{one.observer} holds {one.node} for gone: {one.reason}" for one in deaths],
                "suspicions": sum(one.after is PeerState.SUSPECT for one in changes),
                "moves": bed.task("robot1")["epoch"] - before,
                "load": round(os.getloadavg()[0], 1),
            }
            record.add(row)
            done_s = seconds_of(record, name)
            figures = f"{len(deaths)} deaths, {row['suspicions']} suspicions, {row['moves']} moves"
            progress(f"{name}: {done_s / 60:.1f} of {minutes:g} min; in this slice {figures}")


def seconds_of(record: Record, name: str) -> float:
    """How long a case has been watched."""
    return float(sum(row["seconds"] for row in record.having(case=name)))


def report(folder: Path, names: list[str], out: Path | None) -> None:
    """Print one line per case, and who accused whom."""
    found = {}
    print("| case | minutes | false deaths | suspicions | needless moves | goal |", "| --- " * 6 + "|", sep="\n")
    for name in names:
        rows = Record(folder, f"false-deaths-{name}").having(case=name)
        if not rows:
            continue
        deaths = [text for row in rows for text in row["deaths"]]
        suspicions, moves = (sum(row[key] for row in rows) for key in ("suspicions", "moves"))
        minutes = sum(row["seconds"] for row in rows) / 60
        print(f"| {name} | {minutes:.1f} | {len(deaths)} | {suspicions} | {moves} | {CASES[name].goal} |")
        found[name] = {"minutes": minutes, "deaths": deaths, "suspicions": suspicions, "moves": moves}
    for name, case in found.items():
        for text in case["deaths"][:10]:
            print(f"{name}: {text}")
    save(out, "false-deaths", {"cases": found})


def run_all(names: list[str], folder: Path, minutes: float, *, is_together: bool) -> int:
    """Busy cases first, then those that lose packets; the worst exit code."""
    code = 0
    for is_busy in (True, False):
        chosen = [name for name in names if CASES[name].is_busy is is_busy]
        missing = [
            name for name in chosen if seconds_of(Record(folder, f"false-deaths-{name}"), name) < minutes * 60 - 0.5
        ]
        groups = [missing] if is_together else [[name] for name in missing]
        for group in (group for group in groups if group):
            with busy_cores((os.cpu_count() or 1) if is_busy else 0):
                shared = ["--minutes", str(minutes), "--out", str(folder)]
                each = [["--child", name] for name in group]
                code = max(code, together("benchmarks.false_deaths", each, shared))
    return code


def main() -> int:
    """Print the counts; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--case", nargs="+", default=list(CASES), choices=list(CASES))
    parser.add_argument("--together", action="store_true")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--table", action="store_true")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    given = parser.parse_args()
    reason = netns.why_not()
    if reason is not None and not given.table:
        print(f"no network namespaces here: {reason}", file=sys.stderr)
        return 1
    with tempfile.TemporaryDirectory() as scratch:
        folder = given.out or Path(scratch)
        if given.child:
            watch(Record(folder, f"false-deaths-{given.child}"), given.child, given.minutes)
            return 0
        code = 0
        if not given.table:
            print(machine(), flush=True)
            code = run_all(given.case, folder, given.minutes, is_together=given.together)
        report(folder, given.case, given.out)
    return code


if __name__ == "__main__":
    sys.exit(main())
