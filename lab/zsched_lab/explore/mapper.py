"""Builds a robot's growing occupancy grid from full-circle scans, touching only the cells that a scan can reach.

Knows: scans with and without echo, poses in the robot's own map frame. Does not know: the truth, messages.

For every cell round the robot: which beam looks at it, and does it end behind it? Then the cell is free. The cells in
which echoes end are walls. A beam counts as far as the shortest of itself and its two neighbours: at a grazing angle
the middle one would look through the wall. The poses are given (`zsched_lab.explore.body`: truth plus the drift that
SLAM leaves); `zsched_lab.maps.log_odds` holds the cells.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from zsched.tasks.map_merge.geometry import Pose2
from zsched.tasks.map_merge.grid import Mask
from zsched_lab.explore.laser import RANGE_M, LaserScan
from zsched_lab.maps.log_odds import Box, LogOdds
from zsched_lab.maps.mapping import RESOLUTION_M

ONE_WALL_M = 0.25
"""Echoes of two neighbouring beams that lie so near each other are of one wall: at a grazing angle beams skip cells."""
_BETWEEN = np.array([0.2, 0.4, 0.6, 0.8])


class ScanMapper(LogOdds):
    """One robot's grid, built scan by scan."""

    def __init__(self, *, resolution: float = RESOLUTION_M, frame_id: str = "map") -> None:
        super().__init__(resolution, frame_id)

    def add(self, pose: Pose2, scan: LaserScan) -> None:
        """Work in one scan that was taken at ``pose`` (of the laser, in the map frame)."""
        per_cell = 1.0 / self.resolution
        window = _square(pose.x * per_cell, pose.y * per_cell, math.ceil(RANGE_M * per_cell) + 1)
        hit: Mask = np.zeros(window.shape, dtype=np.bool_)
        x, y = _walls(pose, scan)
        rows, columns = np.floor(y * per_cell).astype(np.int32), np.floor(x * per_cell).astype(np.int32)
        hit[rows - window.low_y, columns - window.low_x] = True
        self.update(window, hit, self._missed(pose, scan, window))

    def walls(self, near: Pose2, reach_m: float) -> tuple[Mask, int, int]:
        """The wall cells in a square of ``reach_m`` each way round ``near``, and the square's lowest cell (x, y)."""
        reach = math.ceil(reach_m / self.resolution)
        window = _square(near.x / self.resolution, near.y / self.resolution, reach)
        return self.occupied(window), window.low_x, window.low_y

    def _missed(self, pose: Pose2, scan: LaserScan, window: Box) -> npt.NDArray[np.bool_]:
        """Which cells of ``window`` a beam passes through."""
        resolution = np.float32(self.resolution)
        x, y = (
            (np.arange(low, high, dtype=np.float32) + np.float32(0.5)) * resolution - np.float32(at)
            for low, high, at in ((window.low_x, window.high_x, pose.x), (window.low_y, window.high_y, pose.y))
        )
        far = np.sqrt(x[None, :] ** 2 + y[:, None] ** 2)
        bearing = np.arctan2(y[:, None], x[None, :])
        beam = (
            np.rint((bearing - np.float32(pose.yaw)) * np.float32(1.0 / scan.step)).astype(np.int32) % scan.ranges.size
        )
        ends = np.minimum(np.minimum(np.roll(scan.ranges, 1), np.roll(scan.ranges, -1)), scan.ranges)
        missed: npt.NDArray[np.bool_] = far < (ends - np.float32(0.5) * resolution)[beam]
        return missed


def _square(x: float, y: float, reach: int) -> Box:
    """The cells of ``reach`` each way round a place in cells."""
    middle_x, middle_y = math.floor(x), math.floor(y)
    return Box(middle_x - reach, middle_y - reach, middle_x + reach + 1, middle_y + reach + 1)


def _walls(pose: Pose2, scan: LaserScan) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Points (x, y) of walls in the map frame: the echoes, and points between two neighbours that belong together."""
    angles = pose.yaw + np.arange(scan.ranges.size) * scan.step
    x, y = pose.x + scan.ranges * np.cos(angles), pose.y + scan.ranges * np.sin(angles)
    to_x, to_y = np.roll(x, -1) - x, np.roll(y, -1) - y
    is_one_wall = scan.echo & np.roll(scan.echo, -1) & (np.hypot(to_x, to_y) < ONE_WALL_M)
    shares = _BETWEEN[:, None]
    between_x = (x[is_one_wall] + shares * to_x[is_one_wall]).ravel()
    between_y = (y[is_one_wall] + shares * to_y[is_one_wall]).ravel()
    return np.concatenate((x[scan.echo], between_x)), np.concatenate((y[scan.echo], between_y))
