"""Navigates for a robot on another node: takes its poses and the merged map, publishes the way to its next goal.

Knows: the robot's keys, this node's data endpoint. Does not know: zsched, the world, how the robot drives.

    python -m zsched_lab.explore.navigate --robot robot1 --endpoint tcp/127.0.0.1:7460 [--cores 0.01] [--first 3 0]

    in   <robot>/pose               where SLAM found the robot (`zsched_lab.explore.slam --match`)
         <robot>/bump               it has met a wall
         <robot>/global_map         the merged map
         <robot>/map                its own map, on which it plans until the merger has placed it
         <robot>/map_merge/tf       where the merger has placed the robot's map frame
         explore/*/claim            where the others go
    out  <robot>/way                the corners ahead, in the robot's map frame
         explore/<robot>/claim      where it goes, 2 Hz

It plans on every new map and at every goal, and besides as often as ``--cores`` of CPU allow: a planner that has the
time looks again. A robot whose map the merger has not placed yet goes on by its own map, and claims nothing: its map
must grow to be placed. The robot is started with ``--led``.
"""

from __future__ import annotations

import argparse
import time

import cv2
import zenoh

from zsched.core.values.errors import WireError
from zsched.host.clock import monotonic_s
from zsched.tasks.map_merge.cdr import CdrError, decode_grid
from zsched.tasks.map_merge.geometry import Pose2
from zsched_lab.explore.agent import CLAIM_PERIOD_S
from zsched_lab.explore.body import Limits
from zsched_lab.explore.explorer import Explorer, avoid_s
from zsched_lab.explore.messages import (
    Correction,
    decode_claim,
    decode_correction,
    encode_claim,
    encode_way,
    pose_of_map,
)
from zsched_lab.fleet import application
from zsched_lab.fleet.signals import StopFlag

POLL_S = 0.05
AGAIN_S = 1.0
"""A way is sent again this often, changed or not: the robot may have missed it."""
SAVED_S = 1.0
"""CPU that was not used for longer than this is not caught up."""


class Budget:
    """Whether a share of a CPU allows more work now: ``cores`` of the time, none saved up for over `SAVED_S`."""

    def __init__(self, cores: float) -> None:
        self._cores = cores
        self._at_s: float | None = None
        self._left_s = 0.0
        self._spent_s = 0.0

    def allows(self, now: float, spent_s: float) -> bool:
        """At ``now``, with ``spent_s`` of CPU used in all (both in s, and only rising)."""
        if self._at_s is not None:
            self._left_s += self._cores * (now - self._at_s) - (spent_s - self._spent_s)
            self._left_s = min(self._left_s, self._cores * SAVED_S)
        self._at_s, self._spent_s = now, spent_s
        return self._left_s > 0.0


class Navigator:
    """One robot's navigation on one session."""

    def __init__(
        self, robot: str, session: zenoh.Session, cores: float, limits: Limits, first: tuple[float, float] | None
    ) -> None:
        """Declare everything."""
        self._robot = robot
        self._explorer = Explorer(robot, limits, avoid_s(limits), first)
        self._budget = Budget(cores)
        ring = zenoh.handlers.RingChannel
        self._poses = session.declare_subscriber(f"{robot}/pose", ring(1))
        self._bumps = session.declare_subscriber(f"{robot}/bump", ring(1))
        self._own_maps = session.declare_subscriber(f"{robot}/map", ring(1))
        self._maps = session.declare_subscriber(f"{robot}/global_map", ring(1))
        self._transforms = session.declare_subscriber(f"{robot}/map_merge/tf", ring(1))
        self._claims = session.declare_subscriber("explore/*/claim", ring(16))
        self._way = session.declare_publisher(f"{robot}/way")
        self._claim = session.declare_publisher(f"explore/{robot}/claim")
        self._correction: Correction | None = None
        self._merged_t_map: Pose2 | None = None
        """``None``: it is not placed yet."""
        self._is_blocked = False
        self._told: tuple[tuple[float, float], ...] | None = None
        self._next_way_s = self._next_claim_s = float("-inf")

    def turn(self, now: float) -> None:
        """Do what is due at ``now``."""
        is_new = self._listen(now)
        if self._correction is None:
            return
        if self._budget.allows(now, time.process_time()):
            self._explorer.look_again()
            is_new = True
        if is_new:
            self._explorer.step(self._correction.pose, now, is_blocked=self._is_blocked)
            self._is_blocked = False
        self._tell(now, self._correction.stamp_ns, self._merged_t_map or Pose2())

    def _tell(self, now: float, stamp_ns: int, merged_t_map: Pose2) -> None:
        way = self._explorer.way
        if way != self._told or now >= self._next_way_s:
            self._told, self._next_way_s = way, now + AGAIN_S
            map_t_merged = merged_t_map.inverse()
            self._way.put(encode_way(stamp_ns, [map_t_merged.apply_point(x, y) for x, y in way]))
        if now >= self._next_claim_s and self._merged_t_map is not None:
            self._next_claim_s = now + CLAIM_PERIOD_S
            self._claim.put(encode_claim(self._robot, self._explorer.claim))

    def _listen(self, now: float) -> bool:
        """Take what has come; returns whether there is a new pose."""
        is_new = False
        while (sample := self._transforms.try_recv()) is not None:
            self._take_transforms(bytes(sample.payload))
        while (sample := self._maps.try_recv()) is not None:
            self._take_map(bytes(sample.payload), is_own=False)
        while (sample := self._own_maps.try_recv()) is not None:
            self._take_map(bytes(sample.payload), is_own=True)
        while (sample := self._claims.try_recv()) is not None:
            self._take_claim(bytes(sample.payload), now)
        while self._bumps.try_recv() is not None:
            self._is_blocked = True
        while (sample := self._poses.try_recv()) is not None:
            is_new |= self._take_pose(bytes(sample.payload))
        return is_new

    def _take_pose(self, payload: bytes) -> bool:
        try:
            self._correction = decode_correction(payload)
        except WireError:
            return False
        return True

    def _take_map(self, payload: bytes, *, is_own: bool) -> None:
        if is_own == (self._merged_t_map is not None):
            return
        try:
            self._explorer.take_map(decode_grid(payload))
        except CdrError:
            return
        if is_own:
            self._explorer.take_transform(Pose2())

    def _take_transforms(self, payload: bytes) -> None:
        pose = pose_of_map(payload, self._robot)
        if pose is not None:
            self._merged_t_map = pose
            self._explorer.take_transform(pose)

    def _take_claim(self, payload: bytes, now: float) -> None:
        try:
            robot, claim = decode_claim(payload)
        except WireError:
            return
        self._explorer.hear_claim(robot, None if self._merged_t_map is None else claim, now)


def main(arguments: list[str] | None = None) -> int:
    """Entry point: 0 after a stop signal, 1 when the data endpoint never answered, 2 on wrong usage."""
    cv2.setNumThreads(1)
    parser = argparse.ArgumentParser(prog="python -m zsched_lab.explore.navigate", description="Navigate for a robot.")
    parser.add_argument("--robot", "--name", required=True, help="the robot that is led")
    parser.add_argument("--endpoint", required=True, help="this node's data endpoint, e.g. tcp/127.0.0.1:7460")
    parser.add_argument("--cores", type=float, default=0.0, help="plan again as often as this CPU allows (0: do not)")
    parser.add_argument("--speed", type=float, default=Limits().speed, help="m/s at most of the robot (0.5)")
    parser.add_argument(
        "--first", type=float, nargs=2, metavar=("X", "Y"), help="drive there first (m, in the robot's map frame)"
    )
    given = parser.parse_args(arguments)
    first = None if given.first is None else (given.first[0], given.first[1])
    if first is not None and not all(abs(value) <= 100.0 for value in first):
        parser.error("--first: give two distances of at most 100 m")
    if not (0.0 <= given.cores <= 64.0 and 0.0 < given.speed <= 5.0):
        parser.error("--cores must be in [0, 64] and --speed in (0, 5]")

    def work(session: zenoh.Session, stop: StopFlag) -> None:
        navigator = Navigator(given.robot, session, given.cores, Limits(speed=given.speed), first)
        while not stop.is_set:
            navigator.turn(monotonic_s())
            time.sleep(POLL_S)

    return application.run(f"explore.navigate: {given.robot}", given.endpoint, work)


if __name__ == "__main__":
    raise SystemExit(main())
