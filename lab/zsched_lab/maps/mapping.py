"""Builds occupancy grids from laser scans with known poses: what each lab robot runs, and the truth it is held against.

Knows: the log-odds update and growing arrays. Does not know: files, messages or merging.

Occupancy grid mapping by log-odds (Moravec & Elfes 1985; Thrun, Burgard & Fox, "Probabilistic Robotics", table 9.1)
with the inverse sensor model "end cell hit, cells before it missed"; each cell counts once per scan.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from zsched.tasks.map_merge.geometry import Pose2
from zsched.tasks.map_merge.grid import FREE, OCCUPIED, UNKNOWN, Grid
from zsched_lab.robots.laser_log import LaserLog, Scan

RESOLUTION_M = 0.05
HIT, MISS, CLIP = 0.85, -0.4, 5.0
OCCUPIED_ABOVE, FREE_BELOW = 0.6, -0.3
_GROWTH_CELLS = 128
"""Spare cells on each side when the array has to grow, so that it does not grow with every scan."""

_Ints = npt.NDArray[np.int32]


@dataclass(slots=True)
class _Window:
    """A rectangle of cells; ``low`` inclusive, ``high`` exclusive, in cells of the map frame (may be negative)."""

    low_x: int
    low_y: int
    high_x: int
    high_y: int

    @property
    def shape(self) -> tuple[int, int]:
        return self.high_y - self.low_y, self.high_x - self.low_x

    def contains(self, other: _Window) -> bool:
        return (
            self.low_x <= other.low_x
            and self.low_y <= other.low_y
            and self.high_x >= other.high_x
            and self.high_y >= other.high_y
        )

    def union(self, other: _Window, pad: int = 0) -> _Window:
        return _Window(
            min(self.low_x, other.low_x - pad),
            min(self.low_y, other.low_y - pad),
            max(self.high_x, other.high_x + pad),
            max(self.high_y, other.high_y + pad),
        )

    def slices(self, inner: _Window) -> tuple[slice, slice]:
        """Where ``inner`` lies in an array that covers this window."""
        return (
            slice(inner.low_y - self.low_y, inner.high_y - self.low_y),
            slice(inner.low_x - self.low_x, inner.high_x - self.low_x),
        )


class GridMapper:
    """One robot's grid, built scan by scan in the robot's own map frame.

    ``displacement`` is the pose of that map frame in the log's frame (the world): the robot does not know it, the lab
    does. The array grows as needed; a cell's place in the map frame never changes.
    """

    def __init__(
        self, *, resolution: float = RESOLUTION_M, displacement: Pose2 | None = None, frame_id: str = "map"
    ) -> None:
        self._resolution = resolution
        self._map_t_world = (displacement or Pose2()).inverse()
        self._frame_id = frame_id
        self._array = _Window(0, 0, 0, 0)
        self._touched: _Window | None = None
        self._log_odds = np.zeros((0, 0), dtype=np.float32)

    def add(self, scan: Scan) -> None:
        """Work one scan in; a scan without echoes changes nothing."""
        if scan.ranges.size == 0:
            return
        ray_x, ray_y, end_x, end_y = self._cells(scan)
        window = _Window(
            int(min(ray_x.min(), end_x.min())),
            int(min(ray_y.min(), end_y.min())),
            int(max(ray_x.max(), end_x.max())) + 1,
            int(max(ray_y.max(), end_y.max())) + 1,
        )
        self._cover(window)
        hit = np.zeros(window.shape, dtype=np.bool_)
        hit[end_y - window.low_y, end_x - window.low_x] = True
        missed = np.zeros(window.shape, dtype=np.bool_)
        missed[ray_y - window.low_y, ray_x - window.low_x] = True
        missed &= ~hit
        part = self._log_odds[self._array.slices(window)]
        np.add(part, HIT, out=part, where=hit)
        np.add(part, MISS, out=part, where=missed)
        np.clip(part, -CLIP, CLIP, out=part)

    def grid(self, stamp_ns: int = 0) -> Grid:
        """The grid so far, cut to the cells that any ray ever touched (1 x 1 unknown before the first scan)."""
        touched = self._touched or _Window(0, 0, 1, 1)
        cells = np.full(touched.shape, UNKNOWN, dtype=np.int8)
        if self._touched is not None:
            part = self._log_odds[self._array.slices(touched)]
            cells[part < FREE_BELOW] = FREE
            cells[part > OCCUPIED_ABOVE] = OCCUPIED
        origin = Pose2(x=touched.low_x * self._resolution, y=touched.low_y * self._resolution)
        return Grid(data=cells, resolution=self._resolution, origin=origin, stamp_ns=stamp_ns, frame_id=self._frame_id)

    def _cells(self, scan: Scan) -> tuple[_Ints, _Ints, _Ints, _Ints]:
        """The cells along all rays (x, y), sampled once per cell length, and the end cells (x, y)."""
        pose = self._map_t_world.compose(scan.pose)
        cos, sin = np.cos(pose.yaw + scan.angles), np.sin(pose.yaw + scan.angles)
        per_cell = 1.0 / self._resolution
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

    def _cover(self, window: _Window) -> None:
        """Grow the array so that it covers ``window``, keeping what it holds."""
        self._touched = window if self._touched is None else self._touched.union(window)
        if self._log_odds.size and self._array.contains(window):
            return
        empty = not self._log_odds.size
        grown = window.union(window, _GROWTH_CELLS) if empty else self._array.union(window, _GROWTH_CELLS)
        log_odds = np.zeros(grown.shape, dtype=np.float32)
        if not empty:
            log_odds[grown.slices(self._array)] = self._log_odds
        self._array, self._log_odds = grown, log_odds


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
