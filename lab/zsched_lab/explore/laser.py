"""A simulated 2-D laser: 360 beams all round, as TurtleBot3's LDS-01, cast into a known world.

Knows: the world's cells, noise by seed. Does not know: robots, maps.

A beam is sampled every half cell; the first sample inside a solid cell is its echo. So a range is right to half a cell
plus the noise. Beams that meet nothing within the range come back without an echo, and still say "nothing here".
Source: ROBOTIS e-manual, LDS-01 (360 beams, 5 Hz, 0.12-3.5 m, +-1.5 cm below half a metre, 5 % further away).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from zsched.tasks.map_merge.geometry import Pose2
from zsched.tasks.map_merge.grid import Mask
from zsched_lab.explore.world import World

BEAMS = 360
RANGE_M = 3.5
NOISE_M = 0.01
SCAN_PERIOD_S = 0.2

Ranges = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LaserScan:
    """One turn of the laser, counter-clockwise from straight ahead.

    ``ranges`` (m), one per beam, `RANGE_M` where ``echo`` is false; ``stamp_ns`` of the robot's own clock.
    """

    ranges: Ranges
    echo: Mask
    stamp_ns: int = 0

    @property
    def step(self) -> float:
        """The angle between two beams (rad)."""
        return math.tau / self.ranges.size


class Laser:
    """Casts scans into ``world``; same generator state, same noise."""

    def __init__(
        self, world: World, random: np.random.Generator, *, beams: int = BEAMS, noise_m: float = NOISE_M
    ) -> None:
        self._world = world
        self._random = random
        self._noise_m = noise_m
        self._solid = world.solid.ravel()
        self._reach = np.arange(1, math.ceil(2 * RANGE_M / world.resolution) + 1, dtype=np.float32) * np.float32(0.5)
        self._bearings = np.arange(beams, dtype=np.float64) * (math.tau / beams)

    def scan(self, pose: Pose2, stamp_ns: int = 0) -> LaserScan:
        """What the laser sees from ``pose`` (of the laser, in the world)."""
        world = self._world
        rows, columns = world.solid.shape
        angles = self._bearings + pose.yaw
        # In cells from here on. Clipped to the rim, which is solid: no beam leaves the world.
        x = (pose.x - world.origin_x) / world.resolution + np.cos(angles).astype(np.float32)[:, None] * self._reach
        y = (pose.y - world.origin_y) / world.resolution + np.sin(angles).astype(np.float32)[:, None] * self._reach
        column = np.clip(x, 0, columns - 1).astype(np.int32)
        row = np.clip(y, 0, rows - 1).astype(np.int32)
        hit = self._solid[row * np.int32(columns) + column]
        echo: Mask = hit.any(axis=1)
        clean = self._reach[hit.argmax(axis=1)] * np.float32(world.resolution)
        noise = self._random.normal(0.0, self._noise_m, echo.size).astype(np.float32)
        ranges = np.where(echo, np.clip(clean + noise, 0.0, RANGE_M), np.float32(RANGE_M)).astype(np.float32)
        return LaserScan(ranges=ranges, echo=echo, stamp_ns=stamp_ns)
