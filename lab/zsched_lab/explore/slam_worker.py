"""SLAM of one robot as a task of zsched: it may move, and takes map and pose along.

Knows: the worker library, the task's keys. Does not know: how scans are matched, where it runs.

    in   {prefix}/*/scan                 scans with the robot's raw odometry (`zsched_lab.explore.messages`)
    out  {prefix}/{epoch}/<robot>/pose   where the robot was at each scan
         {prefix}/{epoch}/<robot>/map    nav_msgs/msg/OccupancyGrid, CDR

On a planned move the new owner fetches map and pose from the old one before its first scan. After a crash it begins a
new map where odometry says the robot is.
"""

from __future__ import annotations

import argparse
import sys
import threading

import cv2

from zsched.core.values.errors import WireError
from zsched.host.clock import monotonic_s
from zsched.tasks.map_merge.cdr import encode_grid
from zsched.worker import Received, Worker
from zsched_lab.explore.messages import decode_scan, encode_correction
from zsched_lab.explore.slam import QUEUE
from zsched_lab.explore.slam_state import Slam, SlamSettings


def run(settings: SlamSettings) -> None:
    """Match scans until told to stop."""
    slam, lock, robot = Slam(settings), threading.Lock(), settings.robot
    with Worker.from_env(standalone=f"slam_{robot}") as worker:
        poses = worker.publisher(f"{{prefix}}/{{epoch}}/{robot}/pose", latest=True, keep_last=1)
        maps = worker.publisher(f"{{prefix}}/{{epoch}}/{robot}/map", latest=True, keep_last=1)

        def on_scan(received: Received) -> None:
            if received.key.split("/")[-2] != robot:
                return
            try:
                scan, odometry = decode_scan(received.payload.to_bytes())
            except WireError as error:
                sys.stderr.write(f"slam_worker: {robot}: {error}\n")
                return
            with lock:
                correction, grid = slam.take(scan, odometry), slam.due_map(monotonic_s())
            poses.put(encode_correction(correction))
            if grid is not None:
                maps.put(encode_grid(grid))

        def snapshot() -> bytes:
            with lock:
                return slam.snapshot()

        def restore(state: bytes) -> None:
            with lock:
                slam.restore(state)

        worker.on_snapshot(restore)
        # a worker is ready for a robot that takes what it may send: the other robots' relays have this task, too
        worker.subscribe("{prefix}/*/scan", on_scan, keep_last=QUEUE)
        worker.offer_snapshot(snapshot)
        worker.ready()
        while worker.wait(1.0):
            pass


def main(arguments: list[str] | None = None) -> int:
    """Entry point: 0 after a stop signal, 2 on wrong usage."""
    cv2.setNumThreads(1)
    parser = argparse.ArgumentParser(prog="python -m zsched_lab.explore.slam_worker", description="SLAM as a task.")
    parser.add_argument("--robot", "--name", required=True, help="the robot whose scans are matched")
    parser.add_argument("--match", type=float, default=0.0, metavar="CORES", help="CPU that matching takes (the least)")
    parser.add_argument("--map-period", type=float, default=2.0, metavar="S", help="from map to map (2)")
    given = parser.parse_args(arguments)
    if not (0.0 <= given.match <= 64.0 and 0.1 <= given.map_period <= 60.0):
        parser.error("--match must be in [0, 64] and --map-period in [0.1, 60]")
    run(SlamSettings(robot=given.robot, cores=given.match, map_period_s=given.map_period))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
