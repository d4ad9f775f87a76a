"""Drives along a way: towards its next corner, first turning, then driving; off a wall backwards.

Knows: a way's points, the pose, the limits, time as an argument. Does not know: maps, who made the way.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from zsched.tasks.map_merge.geometry import Pose2, wrap_angle
from zsched_lab.explore.body import Limits, Twist

Point = tuple[float, float]
CORNER_M = 0.15
TURN_FIRST_RAD = 0.9
BACK_S = 0.6
"""After a bump it backs off for this long, ..."""
BACK_SPEED = -0.3
"""... at this share of its speed."""


def next_corner(way: Sequence[Point], at: int, here: Pose2) -> int:
    """Which corner of the way comes next for a robot that was on its way to corner ``at``."""
    while at < len(way) - 1 and math.dist((here.x, here.y), way[at]) < CORNER_M:
        at += 1
    return at


def towards(point: Point, here: Pose2, limits: Limits) -> Twist:
    """The velocity to a point: a robot that looks far off it turns first."""
    error = wrap_angle(math.atan2(point[1] - here.y, point[0] - here.x) - here.yaw)
    turn = max(-limits.turn, min(limits.turn, 2.5 * error))
    if abs(error) > TURN_FIRST_RAD:
        return Twist(turn=turn)
    return Twist(speed=limits.speed * max(0.2, math.cos(error)), turn=turn)


class Follower:
    """Follows the newest way that it was given."""

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._way: tuple[Point, ...] = ()
        self._next = 0
        self._back_until_s = float("-inf")

    def take_way(self, way: tuple[Point, ...]) -> None:
        """The points ahead, in the frame of the poses that `step` is given; none: stand."""
        if way != self._way:
            self._way, self._next = way, 0

    def step(self, here: Pose2, now: float, *, is_blocked: bool = False) -> Twist:
        """The velocity of this moment; at the way's end it stands."""
        if is_blocked and now >= self._back_until_s:
            self._back_until_s = now + BACK_S
        if now < self._back_until_s:
            return Twist(speed=BACK_SPEED * self._limits.speed)
        if not self._way:
            return Twist()
        self._next = next_corner(self._way, self._next, here)
        if self._next == len(self._way) - 1 and math.dist((here.x, here.y), self._way[-1]) < CORNER_M:
            return Twist()
        return towards(self._way[self._next], here, self._limits)
