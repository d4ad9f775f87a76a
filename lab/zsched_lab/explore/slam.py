"""Maps for a robot on another node: takes its scans, publishes its map (the paper places SLAM on the edges).

Knows: the robot's keys, this node's data endpoint. Does not know: zsched, other robots, the world.

    python -m zsched_lab.explore.slam --robot robot1 --endpoint tcp/127.0.0.1:7460

    in   <robot>/scan    scans with the pose that the robot believes (`zsched_lab.explore.messages`)
    out  <robot>/map     nav_msgs/msg/OccupancyGrid, CDR, 2 Hz once there was a scan
         <robot>/pose    with --match: where the robot was at each scan (`zsched_lab.explore.matching`)

With ``--match CORES`` the scans' poses are raw odometry, and matching takes so much CPU at their 5 Hz. At most
`QUEUE` scans wait then, as many as before gmapping; what comes while they do pushes the oldest out.

The robot is started with ``--slam-on NODE``, and its relay picks ``<robot>/map`` up as ever. Run it inside the node's
control group: its CPU is then part of what that node has in use. It ends on SIGTERM or SIGINT.
"""

from __future__ import annotations

import argparse
import sys
import time

import cv2
import zenoh

from zsched.core.values.errors import WireError
from zsched.host.clock import monotonic_s
from zsched.tasks.map_merge.__main__ import metres_per_cell
from zsched.tasks.map_merge.cdr import encode_grid
from zsched_lab.explore.agent import MAP_PERIOD_S
from zsched_lab.explore.mapper import ScanMapper
from zsched_lab.explore.messages import decode_scan, encode_correction
from zsched_lab.explore.slam_state import Slam, SlamSettings
from zsched_lab.fleet import application
from zsched_lab.fleet.signals import StopFlag
from zsched_lab.maps.mapping import RESOLUTION_M

POLL_S = 0.02
WAITING_SCANS = 16
"""Scans kept while this process has no CPU; then the oldest are lost, as in any SLAM that falls behind."""


QUEUE = 5
"""Scans that wait for a matcher that has no CPU: slam_gmapping subscribes with a queue of 5."""


def match(settings: SlamSettings, session: zenoh.Session, stop: StopFlag) -> None:
    """Match scans until stopped."""
    slam, robot = Slam(settings), settings.robot
    scans = session.declare_subscriber(f"{robot}/scan", zenoh.handlers.RingChannel(QUEUE))
    maps = session.declare_publisher(f"{robot}/map", congestion_control=zenoh.CongestionControl.BLOCK_FIRST)
    poses = session.declare_publisher(f"{robot}/pose")
    while not stop.is_set:
        sample = scans.try_recv()
        if sample is None:
            time.sleep(POLL_S)
            continue
        try:
            scan, odometry = decode_scan(bytes(sample.payload))
        except WireError as error:
            sys.stderr.write(f"explore.slam: {robot}: {error}\n")
            continue
        poses.put(encode_correction(slam.take(scan, odometry)))
        if (grid := slam.due_map(monotonic_s())) is not None:
            maps.put(encode_grid(grid))


def serve(robot: str, session: zenoh.Session, stop: StopFlag, resolution_m: float = RESOLUTION_M) -> None:
    """Map until stopped; ``resolution_m`` in metres per cell."""
    mapper = ScanMapper(resolution=resolution_m, frame_id=f"{robot}/map")
    scans = session.declare_subscriber(f"{robot}/scan", zenoh.handlers.RingChannel(WAITING_SCANS))
    publisher = session.declare_publisher(f"{robot}/map", congestion_control=zenoh.CongestionControl.BLOCK_FIRST)
    stamp_ns: int | None = None
    next_map: float | None = None
    """From the first scan on: the robots' maps keep the phases of their scans."""
    while not stop.is_set:
        while (sample := scans.try_recv()) is not None:
            try:
                scan, pose = decode_scan(bytes(sample.payload))
            except WireError as error:
                sys.stderr.write(f"explore.slam: {robot}: {error}\n")
                continue
            mapper.add(pose, scan)
            stamp_ns = scan.stamp_ns
        now = monotonic_s()
        if stamp_ns is not None and (next_map is None or now >= next_map):
            publisher.put(encode_grid(mapper.grid(stamp_ns)))
            next_map = max((now if next_map is None else next_map) + MAP_PERIOD_S, now)
        time.sleep(POLL_S)


def main(arguments: list[str] | None = None) -> int:
    """Entry point: 0 after a stop signal, 1 when the data endpoint never answered, 2 on wrong usage."""
    cv2.setNumThreads(1)
    parser = argparse.ArgumentParser(prog="python -m zsched_lab.explore.slam", description="Map for a robot.")
    parser.add_argument("--robot", "--name", required=True, help="the robot whose scans are mapped")
    parser.add_argument("--endpoint", required=True, help="this node's data endpoint, e.g. tcp/127.0.0.1:7460")
    parser.add_argument("--resolution", type=metres_per_cell, default=RESOLUTION_M, help="m per cell of the map (0.05)")
    parser.add_argument("--match", type=float, metavar="CORES", help="match scans, with so much CPU (poses are given)")
    parser.add_argument("--map-period", type=float, default=2.0, metavar="S", help="with --match: from map to map (2)")
    given = parser.parse_args(arguments)
    if given.match is not None and not (0.0 <= given.match <= 64.0 and 0.1 <= given.map_period <= 60.0):
        parser.error("--match must be in [0, 64] and --map-period in [0.1, 60]")

    def work(session: zenoh.Session, stop: StopFlag) -> None:
        if given.match is not None:
            settings = SlamSettings(
                robot=given.robot,
                resolution_m=given.resolution,
                cores=given.match,
                map_period_s=given.map_period,
            )
            match(settings, session, stop)
            return
        serve(given.robot, session, stop, given.resolution)

    return application.run(f"explore.slam: {given.robot}", given.endpoint, work)


if __name__ == "__main__":
    raise SystemExit(main())
