"""Builds occupancy grids from laser scans with known poses: what each lab robot runs, and the truth it is held against.

Knows: which cells a scan's rays cross (`zsched_lab.maps.log_odds` holds them). Does not know: files, messages, merging.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from zsched.tasks.map_merge.geometry import Pose2
from zsched.tasks.map_merge.grid import Grid
from zsched_lab.maps.laser_log import LaserLog, Scan
from zsched_lab.maps.log_odds import Box, LogOdds

RESOLUTION_M = 0.05
_Ints = npt.NDArray[np.int32]


class GridMapper(LogOdds):
    """One robot's grid, built scan by scan in the robot's own map frame.

    ``displacement`` is the pose of that map frame in the log's frame (the world): the robot does not know it, the lab
    does.
    """

    def __init__(
        self, *, resolution: float = RESOLUTION_M, displacement: Pose2 | None = None, frame_id: str = "map"
    ) -> None:
        super().__init__(resolution, frame_id)
        self._map_t_world = (displacement or Pose2()).inverse()

    def add(self, scan: Scan) -> None:
        """Work one scan in; a scan without echoes changes nothing."""
        if scan.ranges.size == 0:
            return
        ray_x, ray_y, end_x, end_y = self._cells(scan)
        window = Box(
            int(min(ray_x.min(), end_x.min())),
            int(min(ray_y.min(), end_y.min())),
            int(max(ray_x.max(), end_x.max())) + 1,
            int(max(ray_y.max(), end_y.max())) + 1,
        )
        hit = np.zeros(window.shape, dtype=np.bool_)
        hit[end_y - window.low_y, end_x - window.low_x] = True
        missed = np.zeros(window.shape, dtype=np.bool_)
        missed[ray_y - window.low_y, ray_x - window.low_x] = True
        self.update(window, hit, missed)

    def _cells(self, scan: Scan) -> tuple[_Ints, _Ints, _Ints, _Ints]:
        """The cells along all rays (x, y), sampled once per cell length, and the end cells (x, y)."""
        pose = self._map_t_world.compose(scan.pose)
        cos, sin = np.cos(pose.yaw + scan.angles), np.sin(pose.yaw + scan.angles)
        per_cell = 1.0 / self.resolution
        start_x, start_y = pose.x * per_cell, pose.y * per_cell
        length = scan.ranges * per_cell
        samples = np.ceil(length).astype(np.int64)
        first = np.cumsum(samples) - samples
        step = np.arange(int(samples.sum())) - np.repeat(first, samples)
        ray_x = np.floor(start_x + step * np.repeat(cos, samples)).astype(np.int32)
        ray_y = np.floor(start_y + step * np.repeat(sin, samples)).astype(np.int32)
        end_x = np.floor(start_x + length * cos).astype(np.int32)
        end_y = np.floor(start_y + length * sin).astype(np.int32)
        return ray_x, ray_y, end_x, end_y


def displacements(n: int, seed: int) -> tuple[Pose2, ...]:
    """The map frames of ``n`` robots in the world: anywhere within 5 m, turned by any angle; same seed, same frames."""
    generator = np.random.default_rng(seed)
    shifts = generator.uniform(-5.0, 5.0, size=(n, 2))
    yaws = generator.uniform(-math.pi, math.pi, size=n)
    return tuple(Pose2(x=float(x), y=float(y), yaw=float(yaw)) for (x, y), yaw in zip(shifts, yaws, strict=True))


def map_scans(
    scans: Iterable[Scan],
    *,
    resolution: float = RESOLUTION_M,
    displacement: Pose2 | None = None,
    frame_id: str = "map",
) -> Grid:
    """The grid of all ``scans`` in the frame given by ``displacement``."""
    mapper = GridMapper(resolution=resolution, displacement=displacement, frame_id=frame_id)
    for scan in scans:
        mapper.add(scan)
    return mapper.grid()


def truth_grid(log: LaserLog, *, resolution: float = RESOLUTION_M) -> Grid:
    """The ground truth: the grid of the whole log, in the log's frame."""
    return map_scans(log.scans, resolution=resolution, frame_id="world")
