"""Every adapter of the daemon at work inside the real unit's sandbox, without the daemon: what runs in the boot test.

Starts a worker that needs the compiled libraries, keeps its state, samples the machine, feeds the watchdog.
"""

from __future__ import annotations

import json
import os
import queue
import signal
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path

from zsched.core.values.durable import DurableState
from zsched.core.values.fleet import LinkSpec, NodeSpec, WorkerSpec
from zsched.core.values.model import NodeKind
from zsched.core.values.profile import LinkSource, WorkerState
from zsched.host.machine.device_profiler import DeviceProfiler
from zsched.host.radio.network_profiler import readers_for
from zsched.host.state_file import StateFile
from zsched.host.systemd import Notifier, watchdog_interval_s
from zsched.host.workers.supervisor import WorkerContext, WorkerSupervisor

WORKER = """
import json, os, pathlib, subprocess, time
done = {}
for name in ("numpy", "cv2", "onnxruntime", "zenoh", "msgpack"):
    try:
        module = __import__(name)
        if name == "numpy":
            module.linalg.inv(module.eye(64))
        if name == "cv2":
            module.resize(__import__("numpy").zeros((64, 64), "uint8"), (32, 32))
        done[name] = "ok"
    except Exception as error:
        done[name] = repr(error)
child = subprocess.Popen(["sleep", "1000"])
done["oom_score_adj"] = pathlib.Path("/proc/self/oom_score_adj").read_text().strip()
pathlib.Path(os.environ["RUNTIME_DIRECTORY"], "worker.txt").write_text(json.dumps(done))
while True:
    time.sleep(60)
"""


class Events:
    def __init__(self) -> None:
        self.calls: queue.Queue[tuple[str, str, int]] = queue.Queue()

    def on_started(self, task: str, pid: int, incarnation: int) -> None:
        del pid
        self.calls.put(("started", task, incarnation))

    def on_exited(self, task: str, incarnation: int, returncode: int, reason: str) -> None:
        print("exited", task, returncode, reason, flush=True)
        self.calls.put(("exited", task, incarnation))

    def on_failed(self, task: str, reason: str) -> None:
        print("failed", task, reason, flush=True)

    def on_reset(self, task: str) -> None:
        print("reset", task, flush=True)

    def on_stopped(self, task: str) -> None:
        print("stopped", task, flush=True)

    def on_compared(self, task: str, *, is_old: bool) -> None:
        print("compared", task, is_old, flush=True)


def load_state(file: StateFile) -> DurableState:
    result = file.load()
    if result.state is None:
        blank = DurableState(fleet="boot", node="edge1", incarnation=0, generation=0, hardware="", electorate="e")
        file.create(blank)
        return blank
    return result.state


def main() -> int:
    if "no fleet" in Path(sys.argv[sys.argv.index("--config") + 1]).read_text(encoding="utf-8"):
        return 78
    stop: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _: stop.append(number))
    notifier, interval_s, events, profiler = Notifier(), watchdog_interval_s() or 1.0, Events(), DeviceProfiler()
    spec = LinkSpec(source=LinkSource.NL80211, value="wlan0")
    (reader,) = readers_for(NodeSpec(name="edge1", kind=NodeKind.EDGE, links=(spec,)))
    with StateFile(Path(os.environ["STATE_DIRECTORY"]), fleet="boot", node="edge1") as file:
        state = replace(load_state(file), incarnation=load_state(file).incarnation + 1)
        file.save(state)
        context = WorkerContext(fleet="boot", node="edge1", incarnation=state.incarnation)
        workers = {"merge": WorkerSpec(command=("python", "-c", WORKER))}
        supervisor = WorkerSupervisor(specs=workers, context=context, events=events)
        supervisor.start("merge")
        notifier.ready("stand-in starting")
        sample: dict[str, object] = {}
        while not stop:
            pid = supervisor.pids().get("merge")
            measured = profiler.sample({"merge": (WorkerState.READY, pid)})
            sample = asdict(measured)
            link = reader.read()
            seen = {"incarnation": state.incarnation, "sample": sample, "link": link.source, "problem": reader.problem}
            Path(os.environ["RUNTIME_DIRECTORY"], "daemon.txt").write_text(json.dumps(seen), encoding="utf-8")
            has_load = any(load.cpu_cores is not None for load in measured.workers)  # there is none on a first look
            is_done = has_load and Path(os.environ["RUNTIME_DIRECTORY"], "worker.txt").exists()
            notifier.status(f"stand-in · incarnation {state.incarnation} · worker {'works' if is_done else 'starts'}")
            notifier.watchdog()
            time.sleep(min(0.2, interval_s))
        notifier.stopping("stand-in stopping")
        supervisor.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
