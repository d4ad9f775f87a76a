"""Runs one real network on several camera streams at once: the load that the bench injects into a node.

Knows: how many streams, how fast, when to stop. Does not know: which node it loads, or why; its starter puts the
process into that node's share.

One session of the network (`zsched_lab.fleet.neural_load`) serves all streams, one thread each, as a detector on an
edge does for its robots' cameras. Streams do not wait for one another: N of them compete for the CPU like N busy
threads, while the threads inside one inference would mostly wait at its barriers. Every second one line of JSON goes to
stdout:
``{"t_s", "frames", "fps", "model", "streams"}``.

A stream's strength is the CPU that it takes, not its frames: it pauses after each frame for as long as that frame's own
CPU time asks for. So one number is the same load on every machine. What a full node keeps from it is never caught up.

    python -m zsched_lab.paper.cameras [--streams N] [--cores F] [--side PX]
"""

from __future__ import annotations

import argparse
import json
import sys
import threading
import time

from zsched.host.clock import monotonic_s
from zsched_lab.fleet.neural_load import Network, frames, load_network
from zsched_lab.fleet.signals import StopFlag

REPORT_S = 1.0
LAST_FRAME_S = 2.0


class Camera(threading.Thread):
    """One stream: infers frame after frame, and counts."""

    def __init__(self, network: Network, cores: float, side: int, stop: StopFlag) -> None:
        super().__init__(name="camera", daemon=True)
        self.frames = 0
        self._network, self._cores, self._side, self._stop_flag = network, cores, side, stop

    def run(self) -> None:
        """Until stopped."""
        pictures, due = frames(self._side), 0.0
        while not self._stop_flag.is_set:
            began, before = monotonic_s(), time.thread_time()
            self._network.infer(pictures[self.frames % len(pictures)])
            self.frames += 1
            due = next_frame(due, began, time.thread_time() - before, self._cores)
            time.sleep(max(due - monotonic_s(), 0.0))


def next_frame(due: float, began: float, cpu_s: float, cores: float) -> float:
    """When the next frame is due, after one that was due at ``due``, ``began`` later and took ``cpu_s``.

    >>> next_frame(10.0, 10.0, 0.05, 0.25), next_frame(10.0, 99.0, 0.05, 0.25), next_frame(10.0, 10.0, 0.05, 0.0)
    (10.2, 99.2, 10.0)
    """
    return max(due, began) + cpu_s / cores if cores > 0.0 else began


def watch(cameras: list[Camera], model: str, stop: StopFlag) -> int:
    """Report until stopped; returns the number of frames."""
    reported, before = monotonic_s(), 0
    while not stop.is_set:
        time.sleep(0.05)
        now = monotonic_s()
        if now - reported < REPORT_S:
            continue
        total = sum(camera.frames for camera in cameras)
        line = {"t_s": now, "frames": total, "fps": round((total - before) / (now - reported), 2), "model": model}
        sys.stdout.write(json.dumps(line | {"streams": len(cameras)}) + "\n")
        sys.stdout.flush()
        reported, before = now, total
    return sum(camera.frames for camera in cameras)


def main(arguments: list[str] | None = None) -> int:
    """Entry point: 0 after a stop signal."""
    parser = argparse.ArgumentParser(prog="python -m zsched_lab.paper.cameras")
    parser.add_argument("--streams", type=int, default=1)
    parser.add_argument("--cores", type=float, default=0.0, help="CPU that each stream takes, 0: all that it can get")
    parser.add_argument("--side", type=int, default=640, help="frame side in pixels (a multiple of 32)")
    given = parser.parse_args(arguments)
    if given.streams < 1 or given.cores < 0 or given.side < 32 or given.side % 32:
        parser.error("--streams must be >= 1, --cores >= 0 and --side a multiple of 32")
    stop = StopFlag()
    stop.install()
    network = load_network(threads=1)
    cameras = [Camera(network, given.cores, given.side, stop) for _ in range(given.streams)]
    for camera in cameras:
        camera.start()
    total = watch(cameras, network.name, stop)
    for camera in cameras:
        camera.join(LAST_FRAME_S)
    sys.stderr.write(f"cameras: {total} frames of {network.name}\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
