"""Wall and CPU time of the verbs that are asked most, process start included, on a fleet of six.

``python -m benchmarks.status [--n 40]``: `status`, `explain` and `history`. Beside them in the same run: a bare
interpreter, the floor under any Python command. The history has the moves that the run makes before it measures.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

from benchmarks.common import line, machine
from zsched_lab.fleet.testbed import TASK, Testbed, echo_fleet

LATE_S = 30.0


def spent_ms(command: list[str]) -> tuple[float, float]:
    """(wall time, CPU time of the process) of one run of ``command``, in milliseconds.

    The kernel tells its end: `subprocess` with a timeout looks every 50 ms, which would round each time up.
    """
    start = time.monotonic()
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        late = threading.Timer(LATE_S, os.kill, (process.pid, signal.SIGKILL))
        late.start()
        _, status, used = os.wait4(process.pid, 0)
        took_s = time.monotonic() - start
        late.cancel()
        process.returncode = os.waitstatus_to_exitcode(status)
    return took_s * 1000, (used.ru_utime + used.ru_stime) * 1000


def main() -> None:
    """Print the distributions, measured in turns."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--n", type=int, default=40)
    arguments = parser.parse_args()
    print(machine())
    with tempfile.TemporaryDirectory() as folder, Testbed(Path(folder), echo_fleet()) as bed:
        bed.init()
        bed.start()
        bed.wait_settled()
        zsched = [sys.executable, "-m", "zsched.cli"]
        here = ["--runtime-dir", folder, "--node", "robot1"]
        for target in ("edge1", "edge2", "edge3", "edge1"):
            move = [*zsched, "move", TASK, target, "--yes", *here]
            subprocess.run(move, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, timeout=60, check=False)
        status = [*zsched, "status", *here]
        commands = {
            "python -c pass": [sys.executable, "-c", "pass"],
            "zsched status": status,
            "zsched status --json": [*status, "--json"],
            "zsched status -v": [*status, "-v"],
            "zsched status --node edge3 (over the mesh)": [*status[:-1], "edge3"],
            "zsched explain": [*zsched, "explain", TASK, *here],
            "zsched history": [*zsched, "history", *here],
        }
        times: dict[str, list[tuple[float, float]]] = {name: [] for name in commands}
        for _ in range(arguments.n):
            for name, command in commands.items():
                times[name].append(spent_ms(command))
    for name, values in times.items():
        print(line(name, [wall for wall, _ in values], "ms", "200 ms" if "zsched" in name else "-"))
    for name, values in times.items():
        print(line(f"{name}, CPU", [cpu for _, cpu in values], "ms", "-"))


if __name__ == "__main__":
    main()
