"""A differential-drive robot: how it moves, where it bumps, and where it believes to be.

Knows: kinematics, limits, the world's walls, drift by seed. Does not know: maps, goals, other robots.

Robots pass through each other and do not see each other: the lab measures maps and schedules, not traffic.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from zsched.tasks.map_merge.geometry import Pose2, wrap_angle
from zsched_lab.explore.world import World

RADIUS_M = 0.105
"""TurtleBot3 Burger (ROBOTIS e-manual: 138 mm x 178 mm)."""
STEP_S = 0.05
LONGEST_S = 0.5
"""A robot whose process was held up drives on for at most this long; then its base's watchdog stops it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """What the base can do: m/s and rad/s. TurtleBot3 Burger: 0.22 and 2.84; TurtleBot 2: 0.65 and 3.14."""

    speed: float = 0.5
    turn: float = 2.0

    def __post_init__(self) -> None:
        if not (0.0 < self.speed <= 5.0 and 0.0 < self.turn <= 10.0):
            raise ValueError(f"limits: {self.speed} m/s not in (0, 5], or {self.turn} rad/s not in (0, 10]")


@dataclass(frozen=True, slots=True, kw_only=True)
class Drift:
    """What SLAM does not correct, as random walks over the way: rad and m per square root of a metre."""

    yaw: float = 0.001
    way: float = 0.003


@dataclass(frozen=True, slots=True, kw_only=True)
class Twist:
    """A velocity command: m/s forward, rad/s counter-clockwise."""

    speed: float = 0.0
    turn: float = 0.0


class Body:
    """One robot's body. ``pose`` is the truth in the world; ``belief`` what its SLAM says, in its own map frame.

    The map frame is where the robot started: its pose in the world is the start pose.
    """

    def __init__(self, world: World, start: Pose2, limits: Limits, drift: Drift, random: np.random.Generator) -> None:
        self._world = world
        self._limits = limits
        self._drift = drift
        self._random = random
        self.pose = start
        self.belief = Pose2()
        self.is_blocked = False
        """Whether the last move ended at a wall."""
        self.way_m = 0.0

    def move(self, twist: Twist, seconds: float) -> None:
        """Drive by ``twist`` (cut to the limits) for ``seconds``, in steps; a wall stops the way, not the turn."""
        limits = self._limits
        speed = min(max(twist.speed, -limits.speed), limits.speed)
        turn = min(max(twist.turn, -limits.turn), limits.turn)
        self.is_blocked = False
        left = min(seconds, LONGEST_S)
        while left > 1e-9:
            step = min(STEP_S, left)
            left -= step
            self._step(speed * step, turn * step)

    def _step(self, way: float, angle: float) -> None:
        ahead = Pose2(x=way * math.cos(angle / 2), y=way * math.sin(angle / 2), yaw=angle)
        there = self.pose.compose(ahead)
        room = self._world.room_m(there.x, there.y)
        if way and room < RADIUS_M and room <= self._world.room_m(self.pose.x, self.pose.y):
            self.is_blocked = True
            way, ahead = 0.0, Pose2(yaw=angle)
            there = self.pose.compose(ahead)
        self.pose = there
        self.way_m += abs(way)
        self.belief = self.belief.compose(self._believed(ahead, abs(way)))

    def _believed(self, ahead: Pose2, way: float) -> Pose2:
        if not way:
            return ahead
        root = math.sqrt(way)
        yaw = self._drift.yaw * root * float(self._random.standard_normal())
        along = self._drift.way * root * float(self._random.standard_normal())
        scale = 1.0 + along / way
        return Pose2(x=ahead.x * scale, y=ahead.y * scale, yaw=wrap_angle(ahead.yaw + yaw))
