"""What a worker's driver costs beside a plain process: memory, and the time until a restarted worker is ready again.

``python -m benchmarks.drivers [--n 10] [--drivers process container]``. One edge with the echo worker on loopback for
each driver, all at the same time, in turns. The driver `systemd` is not here: it needs a booted machine.

* ready again: `zsched restart`; from the end of the worker's own process until its node says *ready*.
* memory: PSS of all that stands between the daemon and the worker (driver, its keeper, the engine's processes).
"""

from __future__ import annotations

import argparse
import contextlib
import json
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import psutil

from benchmarks.common import machine
from benchmarks.record import progress
from zsched.host.clock import monotonic_s
from zsched_lab.fleet.containers import NoEngineError, container_host
from zsched_lab.fleet.testbed import TASK, Testbed, echo_fleet

MIB = 1 << 20
NODE = "edge1"
ENGINE_WORDS = ("conmon", "containerd-shim")
ENGINES = ("podman", "docker", *ENGINE_WORDS)
WAIT_S = 60.0


def worker_process(bed: Testbed) -> psutil.Process | None:
    """The worker's own process: of a driver the one that it has noted, else the daemon's child."""
    note = bed.folder / f"{NODE}-{TASK}.pid"
    with contextlib.suppress(OSError, IndexError, psutil.Error):
        return psutil.Process(int(note.read_text().split()[0]))
    for child in psutil.Process(bed.pid(NODE)).children(recursive=True):
        with contextlib.suppress(psutil.Error):
            if "zsched.tasks.echo" in child.cmdline() and "zsched.drivers" not in " ".join(child.cmdline()):
                return child
    return None


def between(bed: Testbed, fleet: str) -> dict[str, float]:
    """{program: MiB (PSS)} of the processes between a daemon and its worker."""
    found: dict[str, float] = {}
    ours = psutil.Process(bed.pid(NODE)).children(recursive=True)
    engines = [one for one in psutil.process_iter() if is_of_engine(one, fleet)]
    worker = worker_process(bed)
    for process in (*ours, *engines):
        with contextlib.suppress(psutil.Error):
            words = " ".join(process.cmdline())
            if process == worker or not any(one in words for one in ("zsched.drivers", "zsched-keeper", *ENGINES)):
                continue
            found[process.name()] = found.get(process.name(), 0.0) + process.memory_full_info().pss / MIB
    return found


def is_of_engine(process: psutil.Process, fleet: str) -> bool:
    """Whether an engine's own process keeps this fleet's container."""
    with contextlib.suppress(psutil.Error):
        words = process.cmdline()
        return bool(words) and Path(words[0]).name in ENGINE_WORDS and any(f"zsched-{fleet}-" in word for word in words)
    return False


def is_ready(bed: Testbed) -> bool:
    """Whether the worker on the edge is ready."""
    node = next(one for one in bed.status(NODE)["nodes"] if one["name"] == NODE)
    return bool(node["workers"]) and node["workers"][0]["state"] == "ready"


def ready_again(bed: Testbed) -> float:
    """Restart the worker; the seconds from its end until it is ready again."""
    old = bed.wait(lambda: worker_process(bed), WAIT_S, "a worker's process")
    assert old is not None
    words = ("restart", TASK, NODE, "--yes", "--node", NODE, "--runtime-dir", str(bed.folder))
    with subprocess.Popen([sys.executable, "-m", "zsched.cli", *words], stdout=subprocess.DEVNULL):
        bed.wait(lambda: not old.is_running() or old.status() == psutil.STATUS_ZOMBIE, WAIT_S, "the worker's end")
        began_s = monotonic_s()
        bed.wait(lambda: (new := worker_process(bed)) is not None and new.pid != old.pid, WAIT_S, "a new process")
        bed.wait(lambda: is_ready(bed), WAIT_S, "a worker that is ready again")
        return monotonic_s() - began_s


def main() -> int:
    """The table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--n", type=int, default=10)
    parser.add_argument("--drivers", nargs="+", choices=("process", "container"), default=["process", "container"])
    given = parser.parse_args()
    workers: dict[str, dict[str, Any]] = {"process": {"command": ["python", "-m", "zsched.tasks.echo"]}}
    host = None
    if "container" in given.drivers:
        try:
            host = container_host()
        except NoEngineError as error:
            print(f"no containers: {error}", file=sys.stderr)
        else:
            workers["container"] = {
                "driver": "container",
                "engine": host.engine,
                "image": host.image,
                "args": [sys.executable, "-m", "zsched.tasks.echo"],
                "mounts": list(host.mounts),
                "options": list(host.options),
            }
    print(machine())
    rows = []
    with contextlib.ExitStack() as stack:
        if host is not None:
            stack.callback(host.ask, "rmi", "--force", host.image)
        beds: dict[str, Testbed] = {}
        for name in (name for name in given.drivers if name in workers):
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix=f"zsched-{name}-")))
            tree = echo_fleet(robots=1, edges=1, task={"worker": {**workers[name], "max_failures": 100}})
            tree["fleet"] = name
            beds[name] = stack.enter_context(Testbed(folder, json.loads(json.dumps(tree))))
            beds[name].init()
            beds[name].start()
            beds[name].wait_whole()
        times: dict[str, list[float]] = {name: [] for name in beds}
        for turn in range(given.n):
            for name, bed in beds.items():
                times[name].append(ready_again(bed))
                progress(f"{turn + 1}/{given.n} {name}: ready again after {times[name][-1]:.2f} s")
        for name, bed in beds.items():
            parts = between(bed, name)
            told = ", ".join(f"{program} {mib:.1f}" for program, mib in sorted(parts.items()))
            low, high = statistics.median(times[name]), max(times[name])
            rows.append((name, str(given.n), f"{low:.2f}", f"{high:.2f}", f"{sum(parts.values()):.1f}", told))
    print("| driver | n | ready again p50, s | max, s | memory, MiB | of which |")
    print("| --- | ---: | ---: | ---: | ---: | --- |")
    print("\n".join(f"| {' | '.join(row)} |" for row in rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
