"""Planned moves to owners that stand still just then: what is lost, and whether the counters know of it.

``python -m benchmarks.frozen_moves [--minutes 30] [--seed 1] [--hz 200] [--hogs 0]``. Three edges with real relays and
echo workers, one ``reliable`` stream with ``handover: all``. Each move goes to a random other edge, whose worker is
stopped (SIGSTOP) between *ready* and the flip, for 0.9 s, for 4 s (longer than its link's lease) or not at all. One in
five goes there and back at once, while the relay that tells the first owner its roles is stopped. Every fifth minute
the stream is five times as fast and the workers half as fast as it, and with ``--hogs`` so many endless loops take the
processor all the time: overload may lose, but never silently.

It fails (exit code 1) when a sample is lost that no counter of the robot's relay tells of: neither an input's nor an
answer's; when the counters of an input do not account for every sample (`zsched.core.hop.books`), looked at every
second; when anything was lost, or in flight to a living worker, without overload; or when an answer came twice or out
of order, under overload, too. A round in which the robot's own relay was replaced (the machine gave it no processor for
seconds) says nothing, and is counted *void*.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.common import machine
from benchmarks.rig import Load, Rig, Traffic, routes, told_of
from zsched.core.hop.books import unaccounted
from zsched.core.values.events import SlotFlipped, SlotReady, StreamsCounted
from zsched.core.values.plan import RoutePhase, Slot, StreamClass, StreamCount, WorkerRole
from zsched.core.values.relay_protocol import RelayStarted
from zsched_lab.fleet.relays import ROBOT, TASK
from zsched_lab.fleet.waiting import until

EDGES = ("edge1", "edge2", "edge3")
FREEZES_S = (0.0, 0.9, 4.0)
DRAIN_S = 20.0
BACK_SHARE = 0.2
BACK_S = 0.7
"""The relay stands still for so long behind the second flip: shorter than its daemon's patience with it."""
OVERLOAD = 5
"""So many times the rate."""


@dataclass
class Sums:
    """Of all rounds."""

    moves: Counter[float] = field(default_factory=Counter)
    back: int = 0
    sent: int = 0
    lost: int = 0
    told: int = 0
    void: int = 0
    faults: list[str] = field(default_factory=list)


def main() -> int:
    """Print a line a round and the verdict; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--hz", type=float, default=200.0)
    parser.add_argument("--hogs", type=int, default=0, help="so many endless loops beside it: overload all the time")
    options = parser.parse_args()
    print(machine())
    random_ = random.Random(options.seed)
    sums = Sums()
    hogs = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(options.hogs)]
    try:
        return _rounds(options, random_, sums)
    finally:
        for hog in hogs:
            hog.kill()
            hog.wait(10)


def _rounds(options: argparse.Namespace, random_: random.Random, sums: Sums) -> int:
    end = time.monotonic() + options.minutes * 60
    number = 0
    while time.monotonic() < end:
        is_overload = number % 5 == 4 or (end - time.monotonic() < 60 and number < 4)
        with tempfile.TemporaryDirectory() as folder, Rig(Path(folder), EDGES) as rig:
            until_s = min(end, time.monotonic() + 60)
            is_overload |= options.hogs > 0
            _round(rig, random_, options.hz, until_s, sums, is_overload=is_overload)
        number += 1
    moves = ", ".join(f"{count} frozen for {seconds:g} s" for seconds, count in sorted(sums.moves.items()))
    moves += f", {sums.back} there and back"
    figures = f"sent {sums.sent}, lost {sums.lost}, told of {sums.told}"
    print(f"moves: {moves}; {figures}, faults {len(sums.faults)}, void {sums.void}")
    print("\n".join(sums.faults[:20]))
    return 1 if sums.faults else 0


def _round(rig: Rig, random_: random.Random, hz: float, until_s: float, sums: Sums, *, is_overload: bool) -> None:
    load = (Load(name="small", hz=hz * (OVERLOAD if is_overload else 1), size=100),)
    slow = ("--delay-ms", str(2000 / load[0].hz)) if is_overload else ()
    for edge in EDGES:
        rig.start_worker(edge, *slow)
    traffic = Traffic(rig.application(), load[0])
    now = routes("edge1", 1, load, StreamClass.RELIABLE)
    rig.move(now)
    until(lambda: traffic.is_connected, "the application sees the relay")
    traffic.start()
    until(lambda: len(traffic.back) > 20, "echoes", 60.0)
    while time.monotonic() < until_s:
        time.sleep(random_.uniform(0.2, 1.0))
        freeze_s = random_.choice(FREEZES_S)
        owner = random_.choice([edge for edge in EDGES if edge != now.owner])
        new = routes(owner, now.epoch + 1, load, StreamClass.RELIABLE)
        if random_.random() < BACK_SHARE:
            now = _there_and_back(rig, new, now, routes(now.owner, now.epoch + 2, load, StreamClass.RELIABLE))
            sums.back += 1
            continue
        _move(rig, new, now, freeze_s)
        now = new
        sums.moves[freeze_s] += 1
    traffic.stop()
    if rig.reports[ROBOT].count(RelayStarted) > 1:
        sums.void += 1
        print(f"{time.strftime('%H:%M:%S')} the robot's relay was replaced, and its counters with it: void", flush=True)
        return
    _judge(rig, traffic, sums, is_overload=is_overload)


def _move(rig: Rig, new: Slot, old: Slot, freeze_s: float) -> None:
    """The executor's table; the new owner's worker stands still from *ready* on."""
    rig.plan(RoutePhase.PREPARE, new, old)
    rig.wait(SlotReady, 120.0, epoch=new.epoch, is_ready=True)
    worker = rig.workers[new.owner]
    if freeze_s:
        worker.send_signal(signal.SIGSTOP)
        threading.Timer(freeze_s, lambda: worker.send_signal(signal.SIGCONT)).start()
    rig.role(new.owner, WorkerRole.ACTIVE, new.epoch)
    rig.role(old.owner, WorkerRole.DRAINING, old.epoch)
    rig.plan(RoutePhase.FLIP, new, old)
    rig.wait(SlotFlipped, 30.0, epoch=new.epoch)
    rig.wait_drained(max(DRAIN_S, freeze_s), old)
    time.sleep(freeze_s)  # at most; it is awake before the next move
    rig.plan(RoutePhase.CLOSE, new)
    rig.role(old.owner, WorkerRole.IDLE)


def _flip(rig: Rig, new: Slot, *olds: Slot) -> None:
    rig.plan(RoutePhase.PREPARE, new, *olds)
    rig.wait(SlotReady, 120.0, epoch=new.epoch, is_ready=True)
    rig.plan(RoutePhase.FLIP, new, *olds)
    rig.wait(SlotFlipped, 30.0, epoch=new.epoch)


def _there_and_back(rig: Rig, new: Slot, old: Slot, again: Slot) -> Slot:
    """Away from an owner and back to it; it hears of neither before it has been sent samples of the newest epoch."""
    relay: int = until(lambda: rig.relays[old.owner].pid, "the owner's relay, which may have been replaced", 30.0)
    os.kill(relay, signal.SIGSTOP)
    try:
        rig.role(new.owner, WorkerRole.ACTIVE, new.epoch)
        rig.role(old.owner, WorkerRole.DRAINING, old.epoch)
        rig.role(old.owner, WorkerRole.ACTIVE, again.epoch)
        _flip(rig, new, old)
        _flip(rig, again, old, new)
        rig.role(new.owner, WorkerRole.DRAINING, new.epoch)
        time.sleep(BACK_S)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.kill(relay, signal.SIGCONT)
    rig.wait_drained(DRAIN_S, old, new)
    rig.plan(RoutePhase.CLOSE, again)
    rig.role(new.owner, WorkerRole.IDLE)
    return again


def _judge(rig: Rig, traffic: Traffic, sums: Sums, *, is_overload: bool) -> None:
    end = time.monotonic() + 60
    while time.monotonic() < end:
        counts = rig.counts()
        inward, outward = counts[f"{TASK}/in/0"], counts[f"{TASK}/out/0"]
        lost, doubled, reordered = traffic.result()
        told = told_of(counts, 0)
        if not inward.in_flight and inward.messages == len(traffic.sent) and lost <= told:
            break
    faults = [f"{lost} lost, {told} told of"] if lost > told else []
    if inward.messages != len(traffic.sent):
        faults.append(f"{len(traffic.sent)} sent, {inward.messages} came in")
    if (inward.in_flight or lost or told) and not is_overload:
        faults.append(f"without overload: lost {lost}, told of {told}, in flight {inward.in_flight}")
    if doubled or reordered:
        faults.append(f"doubled {doubled}, reordered {reordered}")
    faults += [f"{missing} unaccounted at {at:.1f}: {count}" for at, count, missing in _unaccounted(rig)]
    what = "overload" if is_overload else "normal"
    figures = f"sent {len(traffic.sent)} lost {lost} told of {told} in flight {inward.in_flight}"
    print(f"{time.strftime('%H:%M:%S')} {what}: {figures}; {inward}; {outward}", flush=True)
    sums.sent, sums.lost, sums.told = sums.sent + len(traffic.sent), sums.lost + lost, sums.told + told
    sums.faults += [f"{time.strftime('%H:%M:%S')} {what}: {fault}" for fault in faults]


def _unaccounted(rig: Rig) -> list[tuple[float, StreamCount, int]]:
    counts = [
        (at, one) for at, said in rig.reports[ROBOT].items if isinstance(said, StreamsCounted) for one in said.counts
    ]
    return [(at, one, missing) for at, one in counts if (missing := unaccounted(one))]


if __name__ == "__main__":
    sys.exit(main())
