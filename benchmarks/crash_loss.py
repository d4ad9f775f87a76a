"""What an owner's death costs a ``reliable`` stream, with `on_crash: report` and with `replay`.

``python -m benchmarks.crash_loss [--n 20] [--hz 100] [--only kill|cut] [--rule report|replay]
[--burst 20 --one-stamp] [--mbit 12 --size 10000 --burst 50]``. Real daemons in network namespaces (root). The
application on robot1 publishes numbers, the echo worker answers each. *kill*: the owner's daemon, relay and worker are
killed (SIGKILL): their sockets close at once. *cut*: the owner's link goes and then everything on it, as when its power
fails: nobody sees a socket close. Per death: how many numbers have no answer at all, how many have two, and what the
robot's status says of it.

``--one-stamp``: all messages of a burst have the same timestamp, as the parts of one scan; no answer tells which of
them it is of. It tells most together with ``--mbit``: then the owner dies within a burst.

``--mbit``: what leaves the edges goes over links of so many Mbit/s, which the answers to a burst fill: they wait there,
acknowledgements do not. The owner dies while answers come.

Samples and answers are in order. So what is lost beyond what the status tells of had been acknowledged. It fails (exit
code 1) when there is any of that, or when anything at all is lost with `replay`.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from benchmarks.common import machine
from zsched.core.hop.books import given_up, unaccounted
from zsched.core.values.plan import StreamCount
from zsched.host.clock import monotonic_s
from zsched_lab.fleet.netbed import Netbed, Probe
from zsched_lab.fleet.testbed import TASK, Json, echo_fleet

SETTLE_S = 1.0
JUST_S = 0.03
SHARES = 6
"""A burst is cut in so many different places."""
IN_FLIGHT = 40
"""A calm stream has no more than this between two acknowledgements."""
ROBOT = "robot1"


def main() -> int:
    """Print a line a death, and the sums; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--n", type=int, default=20)
    parser.add_argument("--hz", type=float, default=100.0)
    parser.add_argument("--size", type=int, default=0)
    parser.add_argument("--burst", type=int, default=1, help="messages that are put at once")
    parser.add_argument(
        "--one-stamp", action="store_true", help="a burst's messages have one timestamp, as a scan's parts"
    )
    parser.add_argument("--mbit", type=float)
    parser.add_argument("--timing", default="wifi", choices=["wifi", "wired"])
    parser.add_argument("--only", choices=["kill", "cut"])
    parser.add_argument("--rule", choices=["report", "replay"])
    options = parser.parse_args()
    print(machine())
    faults = 0
    for rule in [options.rule] if options.rule else ["report", "replay"]:
        for death in [options.only] if options.only else ["kill", "cut"]:
            faults += _case(options, rule, death)
    return 1 if faults else 0


def _tree(rule: str, timing: str) -> Json:
    tree = echo_fleet(robots=3, edges=3, timing=timing, stream_class="reliable")
    task = tree["tasks"][TASK]
    task["inputs"][0]["on_crash"] = rule
    task["outputs"][0]["handover"] = "all"
    return tree


def _case(options: argparse.Namespace, rule: str, death: str) -> int:
    lost: list[int] = []
    doubled: list[int] = []
    told: list[int] = []
    silent = deaths = 0
    with tempfile.TemporaryDirectory() as folder, Netbed(Path(folder), _tree(rule, options.timing)) as bed:
        bed.init()
        bed.start()
        bed.wait_settled()
        is_full = options.mbit is not None
        for edge in [name for name in bed.names if name.startswith("edge")] if is_full else []:
            bed.network.narrow(edge, options.mbit)
        probe = bed.probe(
            ROBOT,
            put=f"{ROBOT}/in",
            hz=options.hz,
            size=options.size,
            burst=options.burst,
            has_one_stamp=options.one_stamp,
            watch=[f"{ROBOT}/out"],
            blocks=is_full,
        )
        bed.wait(probe.is_flowing, 20, "echoes")
        for number in range(options.n):
            figures = _death(bed, probe, death, options, number)
            for series, figure in zip((lost, doubled, told), figures, strict=True):
                series.append(figure)
            silent += max(0, figures[0] - figures[2])
            deaths += figures[0] > figures[2]
            print(
                f"  {rule} {death} {number + 1}/{options.n}: lost {figures[0]} doubled {figures[1]} told {figures[2]}"
            )
            sys.stdout.flush()
        count = _count(bed)
    missing = unaccounted(count)
    print(
        f"on_crash: {rule}, {death}, {options.hz:g} Hz, n {options.n}: lost a death {_spread(lost)}, doubled"
        f" {_spread(doubled)}, status told of {_spread(told)}; silently {silent} in {deaths} deaths,"
        f" unaccounted {missing}",
        flush=True,
    )
    return silent + abs(missing or 0) + (sum(lost) if rule == "replay" else 0)


def _spread(values: list[int]) -> str:
    ordered = sorted(values)
    return f"median {ordered[len(ordered) // 2]} ({ordered[0]} to {ordered[-1]})"


def _death(bed: Netbed, probe: Probe, death: str, options: argparse.Namespace, number: int) -> tuple[int, int, int]:
    """One cycle; (numbers without an answer, numbers with two, samples that the status says may be lost)."""
    owner = bed.wait_whole()
    _wait_calm(bed, probe, options.burst)
    before, seen = _told(bed), len(probe.received)
    bed.wait(lambda: _comes_back(probe, monotonic_s() - JUST_S), 20, "answers that come just now")
    if options.mbit is not None:  # a burst is on its way: now somewhere within it
        busy_s = options.burst * options.size * 8e-6 / options.mbit
        time.sleep(0.9 * busy_s * (number % SHARES + 0.5) / SHARES)
    first = max(one.number for one in probe.received[-200:]) + 1
    start = monotonic_s()
    bed.power_off(owner, is_seen=death == "kill")
    bed.wait(lambda: probe.first_after(start, but_of=owner), 60, "an answer of the next owner")
    _wait_calm(bed, probe, options.burst)  # what is done again takes its time, too
    time.sleep(SETTLE_S)
    last = max(one.number for one in probe.received[-200:])
    bed.wait(lambda: _count(bed).last_seen_s is not None, 5, "counters")
    time.sleep(SETTLE_S)
    times = Counter(one.number for one in probe.received[seen:])
    lost = sum(number not in times for number in range(first, last + 1))
    doubled = sum(count > 1 for count in times.values())
    told = _told(bed) - before
    bed.network.link(owner, is_up=True)
    return lost, doubled, told


def _wait_calm(bed: Netbed, probe: Probe, burst: int) -> None:
    bed.wait(lambda: probe.is_flowing() and _in_flight(bed) < IN_FLIGHT + 2 * burst, 60, "a calm stream")


def _comes_back(probe: Probe, since: float) -> bool:
    return any(one.at > since for one in probe.received[-5:])


def _in_flight(bed: Netbed) -> int:
    in_flight = _count(bed).in_flight
    return IN_FLIGHT if in_flight is None else in_flight


def _count(bed: Netbed, stream: str = f"{TASK}/in/0") -> StreamCount:
    found = [count for count in bed.counts(ROBOT) if count.stream == stream]
    return found[0] if found else StreamCount(stream=stream)  # the relay has not counted yet


def _told(bed: Netbed) -> int:
    """What the robot says may be lost of its input, and of the answers."""
    return given_up(_count(bed)) + given_up(_count(bed, f"{TASK}/out/0"))


if __name__ == "__main__":
    sys.exit(main())
