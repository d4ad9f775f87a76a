"""What a fleet's streams lose while it gets another version, node by node: old and new beside each other, and back.

``python -m benchmarks.rolling --old REF [--hz 50] [--task reliable|exclusive|best_effort]``. Two robots and two edges
on one machine begin by the code of the commit REF, with today's libraries. Each node in turn is restarted as `systemctl
restart` does it, by this tree's code: edges first, then robots; then all go back. An application on each robot sends a
stream to the owner and hears the answers: of class `reliable`, also to the task that is `exclusive`, or `best_effort`.
One line for each restart: the versions then, sent, lost and doubled of both robots, the longest pause between two
answers, whether the node's relay went on.
"""

from __future__ import annotations

import argparse
import signal
import subprocess
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

from benchmarks.common import REPO, machine, unpacked
from zsched.core.values.model import NodeId
from zsched_lab.fleet.openings import Stream
from zsched_lab.fleet.testbed import TASK, Testbed, echo_fleet

ROBOTS, EDGES = ("robot1", "robot2"), ("edge1", "edge2")
OLD = "0+old."
"""Begins the version of the older code."""
WAIT_S = 120.0
QUIET_S = 2.0
"""Behind a restart the streams run on for this time."""


def code_of(ref: str, folder: Path) -> Path:
    """A folder for ``PYTHONPATH`` with the package as it was at a commit."""
    unpacked(ref, folder, "zsched")
    version = subprocess.run(
        ["git", "-C", str(REPO), "describe", "--always", ref], capture_output=True, text=True, check=True
    ).stdout.strip()
    (folder / "zsched/_version.py").write_text(f'__version__ = "{OLD}{version}"\n')
    return folder


def restart(bed: Testbed, node: NodeId, code: Path) -> None:
    """As systemd does it: the daemon hands over and leaves its relay, the next one is of ``code``."""
    bed.send(node, signal.SIGUSR2)
    bed.wait(lambda: bed.has_ended(node), WAIT_S, f"{node} ends")
    bed.code[node] = code
    bed.wait_whole(WAIT_S)


def settle(streams: dict[NodeId, Stream]) -> dict[NodeId, int]:
    """Let every number that was sent until now be answered, or be lost; those numbers."""
    time.sleep(QUIET_S)
    sent = {robot: stream.sent for robot, stream in streams.items()}
    until = time.monotonic() + WAIT_S / 4
    while time.monotonic() < until and any(
        len({one for one, _ in stream.answers}) < sent[robot] for robot, stream in streams.items()
    ):
        time.sleep(0.1)
    return sent


def steps(bed: Testbed, old: Path, hz: float) -> Iterator[str]:
    """Restart each node, and all of them back; one line for each."""
    streams = {robot: Stream(bed.fleet.node(robot).listen_data, robot, hz) for robot in ROBOTS}
    try:
        for stream in streams.values():
            stream.start()
        first = settle(streams)
        for code in (REPO, old):
            for node in (*EDGES, *ROBOTS):
                relay, owner = bed.relay_pid(node), bed.task("robot1")["owner"]
                began = time.monotonic()
                restart(bed, node, code)
                last = settle(streams)
                told = judged(streams, first, last, began)
                version = bed.status(node)["version"]
                if version.startswith(OLD) is not (code == old):
                    raise SystemExit(f"{node} runs {version}, not the code of {code}")
                kept = "relay goes on" if bed.relay_pid(node) == relay else "another relay"
                role = "owner" if owner == node else ""
                yield f"{node:<7} {role:<6} -> {version:<36} {told}  {kept}"
                first = last
    finally:
        for stream in streams.values():
            stream.close()


def judged(streams: dict[NodeId, Stream], first: dict[NodeId, int], last: dict[NodeId, int], began: float) -> str:
    """What became of the numbers from ``first`` to ``last``."""
    sent = lost = doubled = 0
    pause = 0.0
    for robot, stream in streams.items():
        found = Counter(number for number, _ in stream.answers)
        numbers = range(first[robot], last[robot])
        sent, lost = sent + len(numbers), lost + sum(found[one] == 0 for one in numbers)
        doubled += sum(found[one] > 1 for one in numbers)
        times = [when for _, when in stream.answers]
        pause = max([pause, *(after - before for before, after in pairwise(times) if after >= began)])
    return f"sent {sent:5}  lost {lost}  doubled {doubled}  longest pause {1000 * pause:5.0f} ms"


def main() -> None:
    """Print one line for each restart."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--old", required=True, metavar="REF")
    parser.add_argument("--hz", type=float, default=50.0)
    parser.add_argument("--task", choices=("reliable", "exclusive", "best_effort"), default="reliable")
    given = parser.parse_args()
    print(machine())
    stream_class = "best_effort" if given.task == "best_effort" else "reliable"
    tree = echo_fleet(robots=len(ROBOTS), edges=len(EDGES), stream_class=stream_class)
    tree["tasks"][TASK]["exclusive"] = given.task == "exclusive"
    tree["electorate"] = [*ROBOTS, EDGES[0]]  # one at a time may be away
    if stream_class == "reliable":
        tree["tasks"][TASK]["outputs"][0]["handover"] = "all"
    with tempfile.TemporaryDirectory() as name:
        old = code_of(given.old, Path(name) / "old")
        (Path(name) / "bed").mkdir()
        with Testbed(Path(name) / "bed", tree) as bed:
            bed.init()
            bed.code.update(dict.fromkeys(bed.names, old))
            bed.start()
            bed.wait_settled(WAIT_S)
            for one in steps(bed, old, given.hz):
                print(one, flush=True)


if __name__ == "__main__":
    main()
