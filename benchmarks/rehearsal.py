"""What `zsched rehearse` finds on the lab's fleet: the verb's own table, to be put beside `failover` and `detection`.

``python -m benchmarks.rehearsal [--rounds 3] [--robots 3] [--edges 3] [--timing wifi] [--hz 200] [--class latest]
[--apart]``. Real daemons, an application at one robot, a document that is agreed, and a supervisor that starts ended
daemons again. On loopback no link passes a network, and the verb leaves the cut out; ``--apart`` (as root): each node
in a network namespace of its own, and the owner's links are cut, too.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.common import Pinger, machine
from zsched_lab.fleet.netbed import Netbed
from zsched_lab.fleet.testbed import TASK, Testbed, echo_fleet

CLI = (sys.executable, "-m", "zsched.cli")
STEPS = ("move", "drain", "worker", "daemon")


def rehearse(bed: Testbed, rounds: int, steps: str) -> int:
    """Play it while the ended daemons are started again; the verb's exit code."""
    here = ("--runtime-dir", str(bed.folder), "--node", "robot1", "--yes")
    edges = [name for name in bed.names if name.startswith("edge")]
    bed.let_end(*edges)
    with subprocess.Popen([*CLI, "rehearse", TASK, "--steps", steps, "--rounds", str(rounds), *here]) as played:
        while played.poll() is None:
            for node in edges:
                if bed.has_ended(node):
                    bed.start(node)
                    bed.let_end(node)
            time.sleep(0.05)
    return played.returncode


def main() -> int:
    """Print the verb's table; its exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--robots", type=int, default=3)
    parser.add_argument("--edges", type=int, default=3)
    parser.add_argument("--timing", default="wifi", choices=["wifi", "wired"])
    parser.add_argument("--hz", type=float, default=200.0)
    parser.add_argument("--class", dest="stream_class", default="latest", choices=["latest", "reliable"])
    parser.add_argument("--apart", action="store_true", help="each node in a network namespace, links are cut, too")
    options = parser.parse_args()
    print(machine(), flush=True)
    os.environ["ZSCHED_RESTARTED_BY"] = "this benchmark"
    tree = echo_fleet(
        robots=options.robots, edges=options.edges, timing=options.timing, stream_class=options.stream_class
    )
    kind = Netbed if options.apart else Testbed
    with tempfile.TemporaryDirectory() as folder, kind(Path(folder), tree) as bed:
        bed.init()
        bed.start()
        bed.wait_whole()
        agreed = bed.folder / "agreed.yaml"
        agreed.write_text(bed.file.read_text())
        subprocess.run([*CLI, "apply", str(agreed), "--yes", "--runtime-dir", folder, "--node", "robot1"], check=True)
        if isinstance(bed, Netbed):
            answers = bed.probe("robot1", put="robot1/in", hz=options.hz, watch=["robot1/out"]).received
            bed.wait(lambda: len(answers) > 50, 20, "echoes")
            return rehearse(bed, options.rounds, ",".join((*STEPS, "link")))
        pinger = Pinger(bed, "robot1", hz=options.hz)
        bed.wait(lambda: len(pinger.received) > 50, 20, "echoes")
        code = rehearse(bed, options.rounds, ",".join(STEPS))
        pinger.stop()
    return code


if __name__ == "__main__":
    sys.exit(main())
