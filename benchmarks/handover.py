"""Planned and crash moves of reference echo workers under load: lost, doubled, reordered, and the gap.

``python -m benchmarks.handover [--moves 200] [--class reliable|latest] [--recorder] [--stalled] [--mirror] [--crash]``.
1 kHz x 100 B and 50 Hz x 1 MiB at once, over two edges in turn (A -> B -> A), TCP on loopback, relays driven by hand so
that a move takes what it takes. ``--recorder``: a foreign subscriber to ``**``. ``--stalled``: a third edge whose
worker is frozen takes the same streams meanwhile. ``--crash``: the owner's worker is killed before every move.
``--all`` makes each of these runs, and a plain one of both classes, in turn. ``--out FILE`` keeps what was printed.
The exit code is 1 when after a move the counters do not account for every sample (`zsched.core.hop.books`), or when at
the end more samples have not come back than the counters tell of.
"""

from __future__ import annotations

import argparse
import signal
import sys
import tempfile
import time
from pathlib import Path
from typing import TextIO

from benchmarks.common import line, machine
from benchmarks.rig import Load, Rig, Traffic, routes
from zsched.core.values.plan import RoutePhase, RoutePlan, StreamClass
from zsched_lab.fleet.relays import ROBOT, TASK
from zsched_lab.fleet.waiting import until

SMALL = Load(name="small", hz=1000, size=100)
LARGE = Load(name="large", hz=50, size=1 << 20)
ALL_RUNS: tuple[dict[str, object], ...] = (
    {},
    {"recorder": True},
    {"stalled": True},
    {"crash": True},
    {"stream_class": "latest"},
    {"stream_class": "latest", "mirror": True},
)


def main() -> int:
    """Print what was lost, doubled, reordered, and the gaps; 1 when a sample is in no counter, or was lost silently."""
    options = _options()
    if options.out is not None:
        sys.stdout = _Both(options.out.open("a", encoding="utf-8"))
    print(machine())
    runs = ALL_RUNS if options.all else ({},)
    broken = sum(_one(argparse.Namespace(**(vars(options) | changes))) for changes in runs)
    print(f"\nlooks at which a stream's counters did not account for every sample, and silent losses: {broken}")
    return 1 if broken else 0


def _one(options: argparse.Namespace) -> int:
    extras = [name for name in ("recorder", "stalled", "mirror", "crash") if getattr(options, name)]
    print(f"\n{options.moves} moves, class {options.stream_class}{''.join(f', {name}' for name in extras)}", flush=True)
    edges = ("edge1", "edge2", "edge3") if options.stalled else ("edge1", "edge2")
    with tempfile.TemporaryDirectory() as folder, Rig(Path(folder), edges) as rig:
        return _run(rig, options)


class _Both:
    """Standard output, and a file that is complete after every line."""

    def __init__(self, file: TextIO) -> None:
        self._file = file

    def write(self, text: str) -> int:
        self._file.write(text)
        self._file.flush()
        return sys.__stdout__.write(text) if sys.__stdout__ is not None else 0

    def flush(self) -> None:
        if sys.__stdout__ is not None:
            sys.__stdout__.flush()


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--moves", type=int, default=200)
    parser.add_argument("--class", dest="stream_class", default="reliable", choices=["reliable", "latest"])
    parser.add_argument("--small-hz", type=float, default=SMALL.hz)
    parser.add_argument("--large-hz", type=float, default=LARGE.hz)
    parser.add_argument("--recorder", action="store_true")
    parser.add_argument("--stalled", action="store_true")
    parser.add_argument("--mirror", action="store_true")
    parser.add_argument("--crash", action="store_true")
    parser.add_argument("--all", action="store_true")
    parser.add_argument("--out", type=Path)
    return parser.parse_args()


def _run(rig: Rig, options: argparse.Namespace) -> int:
    """One run; at how many looks the books of a stream were not balanced, and how many streams lost silently."""
    stream_class = StreamClass(options.stream_class)
    arguments = ("--latest",) if stream_class is StreamClass.LATEST else ()
    loads = tuple(
        Load(name=load.name, hz=hz, size=load.size)
        for load, hz in ((SMALL, options.small_hz), (LARGE, options.large_hz))
        if hz
    )
    for edge in ("edge1", "edge2"):
        rig.start_worker(edge, *arguments)
    session = rig.application()
    traffics = [Traffic(session, load) for load in loads]
    recorded = [0]
    if options.recorder:
        recorder = rig.application()
        recorder.declare_subscriber("**", lambda _: recorded.__setitem__(0, recorded[0] + 1))
    now = routes("edge1", 1, loads, stream_class, is_mirrored=options.mirror)
    rig.move(now)
    if options.stalled:
        _stall(rig, loads, stream_class)
    until(lambda: all(traffic.is_connected for traffic in traffics), "the application sees the relay")
    for traffic in traffics:
        traffic.start()
    until(lambda: all(len(traffic.back) > 5 for traffic in traffics), "echoes", 60.0)
    moments, flips, broken = [], [], 0
    for number in range(options.moves):
        time.sleep(0.15)
        owner = "edge2" if now.owner == "edge1" else "edge1"
        new = routes(owner, now.epoch + 1, loads, stream_class, is_mirrored=options.mirror)
        if options.crash:
            rig.workers[now.owner].kill()
            rig.workers[now.owner].wait(5)
        moments.append(time.monotonic())
        flips.append(rig.move(new, now, is_crash=options.crash) * 1000)
        if options.crash:
            rig.start_worker(now.owner, *arguments)
        now = new
        broken += _is_broken(rig, number)
        if number % 50 == 49:
            print(f"  {number + 1}/{options.moves}", flush=True)
    time.sleep(0.3)
    for traffic in traffics:
        traffic.stop()
    _settle(traffics)
    _report(rig, traffics, moments, flips)
    if options.recorder:
        print(f"  the recorder took {recorded[0]} samples")
    silent = rig.silent_losses(traffics)
    print("".join(f"  SILENT {one}\n" for one in silent), end="", flush=True)
    return broken + _is_broken(rig, options.moves) + len(silent)


def _is_broken(rig: Rig, move: int) -> bool:
    missing = rig.unaccounted()
    print("".join(f"  BROKEN after move {move}: {one}\n" for one in missing), end="", flush=True)
    return bool(missing)


def _stall(rig: Rig, loads: tuple[Load, ...], stream_class: StreamClass) -> None:
    """The same streams, as another task's, to an edge whose worker is frozen."""
    rig.start_worker("edge3")
    third = routes("edge3", 1, loads, stream_class, task=f"{TASK}3")
    for phase in (RoutePhase.PREPARE, RoutePhase.FLIP, RoutePhase.CLOSE):
        rig.relays[ROBOT].apply(RoutePlan(task=f"{TASK}3", phase=phase, current=third))
        time.sleep(0.2)
    rig.workers["edge3"].send_signal(signal.SIGSTOP)


def _settle(traffics: list[Traffic], deadline_s: float = 5.0) -> None:
    end = time.monotonic() + deadline_s
    while time.monotonic() < end and any(traffic.result()[0] for traffic in traffics):
        time.sleep(0.05)


def _report(rig: Rig, traffics: list[Traffic], moments: list[float], flips: list[float]) -> None:
    for traffic in traffics:
        load = traffic.load
        lost, doubled, reordered = traffic.result()
        what = f"{load.name}: {load.hz:g} Hz x {load.size} B"
        print(f"{what:<30} sent {len(traffic.sent)} lost {lost} doubled {doubled} reordered {reordered}")
        gaps = [traffic.gap_after(moment) for moment in moments]
        print(line(f"  gap around a move, {load.name}", gaps, "ms", f"one period ({1000 / load.hz:g}) + 20"))
    print(line("  prepare to flip", flips, "ms", "-"))
    left = rig.left_behind()
    if left:
        lost = sum(traffic.result()[0] for traffic in traffics)
        told = f"{len(left)} slots, {sum(left)} samples, largest {max(left)}"
        print(f"  reported 'at most N lost': {told}; lost were {lost}")
    for name, count in rig.counts().items():
        print(
            f"  {name}: {count.messages} msg acknowledged {count.acknowledged} in flight {count.in_flight} "
            f"lost {count.lost} doubled {count.doubled} reordered {count.reordered} replayed {count.replayed} "
            f"at most lost {count.at_most_lost} drops {dict(count.drops)}"
        )


if __name__ == "__main__":
    sys.exit(main())
