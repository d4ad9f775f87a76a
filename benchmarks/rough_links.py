"""Links that hurt: nodes far from each other, and a robot whose address changes while its stream flows.

``python -m benchmarks.rough_links [--case far roam] [--n 5] [--minutes 1] [--one-way-ms 150]``. Needs root: two robots
and two edges in network namespaces, one application at ``robot1`` with a `reliable` stream of 50 Hz.

``far``: every packet between two nodes takes 150 ms, timing `wan`. Counts false deaths at rest, then makes planned
moves and kills the owner's daemon. ``roam``: timing `wifi`; ``robot1`` gets another address, as on another access
point, and all its connections are dead; once with its application on a local side, and once without one.

A gap is the longest time between two answers at the application from the event until `AFTER_S` later.
"""

from __future__ import annotations

import argparse
import itertools
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.common import line, machine
from benchmarks.false_deaths import pass_time
from zsched.core.values.model import NodeId, PeerState
from zsched.host.clock import monotonic_s
from zsched_lab.fleet import netns
from zsched_lab.fleet.netbed import OnboardBed, Probe
from zsched_lab.fleet.testbed import TASK, echo_fleet

CLI = (sys.executable, "-m", "zsched.cli")
ROBOT, ANSWERS = "robot1", "robot1/out"
HZ = 50.0
SETTLE_S, AFTER_S, FLOWS_S, FRESH_S = 5.0, 3.0, 60.0, 2.0
CASES = ("far", "roam")
LOCAL = "tcp/127.0.0.1:7470"


def fleet(timing: str) -> dict[str, Any]:
    """The fleet file of both cases."""
    tree = echo_fleet(robots=2, edges=2, timing=timing, stream_class="reliable")
    tree["tasks"][TASK]["outputs"][0]["handover"] = "all"
    return tree


def begin(bed: OnboardBed) -> Probe:
    """Start all, and the application; it gets its answers when this returns."""
    bed.init()
    bed.start()
    bed.wait_whole(180)
    probe = bed.probe(ROBOT, put=f"{ROBOT}/in", hz=HZ, watch=[ANSWERS], blocks=True)
    bed.wait(lambda: len(probe.received) > HZ, FLOWS_S, "answers")
    pass_time(bed, SETTLE_S)
    return probe


def gap_s(bed: OnboardBed, probe: Probe, since: float) -> float:
    """The longest time without an answer, once answers to what was put later flow again."""
    bed.wait(lambda: probe.first_after(since) is not None and probe.is_flowing(FRESH_S), FLOWS_S, "answers again")
    pass_time(bed, AFTER_S)
    came = sorted(one.at for one in list(probe.received) if one.at >= since - 1.0)
    return max((after - before for before, after in itertools.pairwise(came)), default=0.0)


def deaths(bed: OnboardBed, since: float, *, but: NodeId = "") -> list[str]:
    """Who was held for gone since then, but for one that really was."""
    changes = (one for one in bed.changes(since=since) if one.after is PeerState.GONE and one.node != but)
    return [f"{one.observer} holds {one.node} for gone: {one.reason}" for one in changes]


def tell_numbers(bed: OnboardBed, probe: Probe) -> None:
    """What came back of what was put, and what the relay's counters say."""
    numbers = [one.number for one in list(probe.received)]
    missing = len(set(range(max(numbers) + 1)) - set(numbers))
    print(f"  of {max(numbers) + 1} numbers: without an answer {missing}, twice {len(numbers) - len(set(numbers))}")
    print(f"  the relay's counters tell of {bed.told_lost(ROBOT)} lost or at most lost")


def move(bed: OnboardBed, target: NodeId) -> None:
    """A planned move, by the verb."""
    here = ("--runtime-dir", str(bed.folder), "--node", ROBOT, "--yes", "--timeout", "60")
    subprocess.run([*CLI, "move", TASK, target, *here], check=True, stdout=subprocess.DEVNULL, timeout=120)


def far(n: int, minutes: float, one_way_ms: float) -> None:
    """Nodes far from each other."""
    with tempfile.TemporaryDirectory() as folder, OnboardBed(Path(folder), fleet("wan")) as bed:
        for name in bed.names:
            bed.network.lengthen(name, one_way_ms / 2000)
        probe = begin(bed)
        since = monotonic_s()
        pass_time(bed, 60 * minutes)
        trips = [1000 * (one.at - one.sent_at) for one in list(probe.received) if one.sent_at >= since]
        print(f"far: {one_way_ms:g} ms each way, timing wan")
        print(line("  round trip of a sample", trips, "ms", "-"))
        print(f"  false deaths in {minutes:g} min: {len(deaths(bed, since))}")
        moves, kills = [], []
        for _ in range(n):
            owner = bed.wait_settled(120)
            since = monotonic_s()
            move(bed, "edge2" if owner == "edge1" else "edge1")
            moves.append(1000 * gap_s(bed, probe, since))
        print(line("  gap of a planned move", moves, "ms", "-"))
        print(f"  false deaths meanwhile: {len(deaths(bed, since))}")
        tell_numbers(bed, probe)
        for _ in range(n):
            owner = bed.wait_settled(120)
            since = monotonic_s()
            bed.kill(owner)
            kills.append(1000 * gap_s(bed, probe, since))
            bed.wait_whole(180)
        print(line("  gap when the owner is killed", kills, "ms", "-"))
        tell_numbers(bed, probe)


def roam(n: int, *, has_local_side: bool) -> None:
    """A robot whose address changes."""
    tree = fleet("wifi")
    if has_local_side:
        tree["nodes"][ROBOT]["local"] = {"mode": "peer", "listen": [LOCAL]}
    with tempfile.TemporaryDirectory() as folder, OnboardBed(Path(folder), tree, hidden=(ROBOT,)) as bed:
        probe = begin(bed)
        gaps = []
        for _ in range(n):
            bed.network.renumber(ROBOT)
            since = monotonic_s()
            gaps.append(1000 * gap_s(bed, probe, since))
            bed.wait_whole(120)
            for text in deaths(bed, since, but=ROBOT):
                print(f"  {text}")
        where = "a local side" if has_local_side else "the data session"
        print(f"roam: robot1 gets another address, timing wifi, its application on {where}")
        print(line("  gap of its stream", gaps, "ms", "-"))
        tell_numbers(bed, probe)


def main() -> int:
    """Print the figures; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--case", nargs="+", default=list(CASES), choices=CASES)
    parser.add_argument("--n", type=int, default=5)
    parser.add_argument("--minutes", type=float, default=1.0)
    parser.add_argument("--one-way-ms", type=float, default=150.0)
    given = parser.parse_args()
    reason = netns.why_not()
    if reason is not None:
        print(f"no network namespaces here: {reason}", file=sys.stderr)
        return 1
    print(machine(), flush=True)
    if "far" in given.case:
        far(given.n, given.minutes, given.one_way_ms)
    if "roam" in given.case:
        for has_local_side in (True, False):
            roam(given.n, has_local_side=has_local_side)
    return 0


if __name__ == "__main__":
    sys.exit(main())
