"""How often links that nothing is wrong with are ended: on busy cores, and on links that lose packets.

``python -m benchmarks.link_closings [--other PATH] [--minutes 2] [--loss 20] [--congestion reno] [--busy 0]
[--timing wifi]``. Needs root: six nodes in network namespaces, an application at ``robot1`` that puts 50 samples a
second; no link carries anything else. ``--loss``: so many of 100 packets are lost on their way into each namespace.
``--busy``: so many endless loops run beside them. With ``--other`` (another working tree of zsched) a fleet of its
programs runs at the same time.

Every 2 s each node's connections are listed; one that was not there at first has followed one that was ended. Both its
ends count, so figures are twice the number of links.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.common import machine
from benchmarks.false_deaths import SETTLE_S, busy_cores
from benchmarks.idle import TreeBed
from zsched.core.values.model import NodeId, PeerState
from zsched.host.clock import monotonic_s
from zsched_lab.fleet import netns
from zsched_lab.fleet.netbed import CONTROL_PORT, DATA_PORT
from zsched_lab.fleet.testbed import echo_fleet

LOOK_S = 2.0
CONGESTION_FILE = "/proc/sys/net/ipv4/tcp_congestion_control"
KINDS = {f":{CONTROL_PORT}": "control", f":{DATA_PORT}": "data"}
End = tuple[NodeId, str, str, str]
"""(node, kind of link, our address, theirs)."""


def ends(bed: TreeBed) -> set[End]:
    """Both ends of every link between nodes that there is now."""
    found = set()
    for node in bed.names:
        for line in bed.network.run(node, "ss", "-Htn", "state", "established").splitlines():
            ours, theirs = line.split()[2:4]
            kind = next((kind for port, kind in KINDS.items() if ours.endswith(port) or theirs.endswith(port)), "")
            if kind and not ours.startswith("127."):
                found.add((node, kind, ours, theirs))
    return found


def begin(bed: TreeBed, congestion: str) -> None:
    """Start all, with this congestion control."""
    for node in bed.names:
        if congestion:
            bed.network.run(node, "sh", "-c", f"echo {congestion} > {CONGESTION_FILE}")
    bed.init()
    bed.start()
    bed.wait_settled(90)
    bed.probe("robot1", put="robot1/in", hz=50, watch=["robot1/out"])


def measure(beds: dict[str, TreeBed], minutes: float) -> None:
    """Count, and print a row for every fleet."""
    first = {name: ends(bed) for name, bed in beds.items()}
    seen = {name: set[End]() for name in beds}
    since, epochs = monotonic_s(), {name: bed.task("robot1")["epoch"] for name, bed in beds.items()}
    until = time.monotonic() + 60 * minutes
    while time.monotonic() < until:
        for name, bed in beds.items():
            seen[name] |= ends(bed)
        time.sleep(LOOK_S)
    print("| tree | ends of data links | new ones | new ones of control links | gone | suspect | moves |")
    print("| --- " * 7 + "|")
    for name, bed in beds.items():
        new = [kind for _, kind, *_ in seen[name] - first[name]]
        before = [kind for _, kind, *_ in first[name]]
        after = [change.after for change in bed.changes(since=since)]
        counts = [before.count("data"), new.count("data"), new.count("control")]
        counts += [after.count(PeerState.GONE), after.count(PeerState.SUSPECT)]
        counts.append(bed.task("robot1")["epoch"] - epochs[name])
        print(f"| {name} | {' | '.join(map(str, counts))} |", flush=True)


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--other", type=Path)
    parser.add_argument("--minutes", type=float, default=2.0)
    parser.add_argument("--loss", type=int, default=20)
    parser.add_argument("--congestion", default="", help="of TCP, on the links of streams; the system's own by default")
    parser.add_argument("--busy", type=int, default=0)
    parser.add_argument("--timing", default="wifi")
    given = parser.parse_args()
    if (reason := netns.why_not()) is not None:
        print(f"no network namespaces here: {reason}", file=sys.stderr)
        return 1
    print(machine())
    trees: dict[str, Path | None] = {"this": None}
    if given.other is not None:
        trees["other"] = given.other.resolve()
    beds = {}
    with contextlib.ExitStack() as stack:
        for name, tree in trees.items():
            folder = stack.enter_context(tempfile.TemporaryDirectory())
            fleet = echo_fleet(timing=given.timing, scheduling={"price_s": 2})
            beds[name] = bed = stack.enter_context(TreeBed(Path(folder), fleet))
            bed.tree = tree
            begin(bed, given.congestion)
        for bed in beds.values():
            if given.loss:
                bed.network.lose(given.loss, *bed.names)
        stack.enter_context(busy_cores(given.busy))
        time.sleep(SETTLE_S)
        measure(beds, given.minutes)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
