"""Builds a robot's growing occupancy grid from full-circle scans, touching only the cells that a scan can reach.

Knows: log-odds, scans with and without echo, poses in the robot's own map frame. Does not know: the truth, messages.

For every cell round the robot: which beam looks at it, and does it end behind it? Then the cell is free. The cells in
which echoes end are walls. A beam counts as far as the shortest of itself and its two neighbours: at a grazing angle
the middle one would look through the wall. Occupancy grid mapping by log-odds as in `zsched_lab.maps.mapping`, whose
values it shares; the poses are given (`zsched_lab.explore.body`: truth plus the drift that SLAM leaves).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from zsched.tasks.map_merge.geometry import Pose2
from zsched.tasks.map_merge.grid import FREE, OCCUPIED, UNKNOWN, Grid, Mask
from zsched_lab.explore.laser import RANGE_M, LaserScan
from zsched_lab.maps.mapping import CLIP, FREE_BELOW, HIT, MISS, OCCUPIED_ABOVE, RESOLUTION_M

_GROWTH_CELLS = 128
ONE_WALL_M = 0.25
"""Echoes of two neighbouring beams that lie so near each other are of one wall: at a grazing angle beams skip cells."""
_BETWEEN = np.array([0.2, 0.4, 0.6, 0.8])

STEP = 0.05
"""`HIT`, `MISS` and `CLIP` are multiples of it: in steps of it a log-odds fits into a byte."""

_Box = tuple[int, int, int, int]
"""Cells of the map frame: low x, low y (inclusive), high x, high y (exclusive)."""
_LogOdds = npt.NDArray[np.float32]


class ScanMapper:
    """One robot's grid in its own map frame; a cell's place never changes."""

    def __init__(self, *, resolution: float = RESOLUTION_M, frame_id: str = "map") -> None:
        self._resolution = resolution
        self._frame_id = frame_id
        self._box: _Box = (0, 0, 0, 0)
        self._touched: _Box | None = None
        self._log_odds: _LogOdds = np.zeros((0, 0), dtype=np.float32)

    def add(self, pose: Pose2, scan: LaserScan) -> None:
        """Work in one scan that was taken at ``pose`` (of the laser, in the map frame)."""
        per_cell = 1.0 / self._resolution
        reach = math.ceil(RANGE_M * per_cell) + 1
        middle_x, middle_y = math.floor(pose.x * per_cell), math.floor(pose.y * per_cell)
        window = (middle_x - reach, middle_y - reach, middle_x + reach + 1, middle_y + reach + 1)
        part = self._cover(window)
        missed = self._missed(pose, scan, window)
        hit = np.zeros_like(missed)
        x, y = _walls(pose, scan)
        hit[
            np.floor(y * per_cell).astype(np.int32) - window[1], np.floor(x * per_cell).astype(np.int32) - window[0]
        ] = True
        missed &= ~hit
        np.add(part, np.float32(HIT), out=part, where=hit)
        np.add(part, np.float32(MISS), out=part, where=missed)
        np.clip(part, -CLIP, CLIP, out=part)

    @property
    def resolution(self) -> float:
        """Metres per cell."""
        return self._resolution

    def walls(self, near: Pose2, reach_m: float) -> tuple[Mask, int, int]:
        """The wall cells in a square of ``reach_m`` each way round ``near``, and the square's lowest cell (x, y)."""
        reach = math.ceil(reach_m / self._resolution)
        low_x, low_y = (math.floor(value / self._resolution) - reach for value in (near.x, near.y))
        found: Mask = np.zeros((2 * reach + 1, 2 * reach + 1), dtype=np.bool_)
        left, low = max(low_x, self._box[0]), max(low_y, self._box[1])
        right, high = min(low_x + 2 * reach + 1, self._box[2]), min(low_y + 2 * reach + 1, self._box[3])
        if left < right and low < high:
            known = self._part((left, low, right, high)) > OCCUPIED_ABOVE
            found[low - low_y : high - low_y, left - low_x : right - low_x] = known
        return found, low_x, low_y

    def grid(self, stamp_ns: int = 0) -> Grid:
        """The grid so far, cut to what scans could reach (1 x 1 unknown before the first scan)."""
        low_x, low_y, high_x, high_y = self._touched or (0, 0, 1, 1)
        cells = np.full((high_y - low_y, high_x - low_x), UNKNOWN, dtype=np.int8)
        if self._touched is not None:
            part = self._part(self._touched)
            cells[part < FREE_BELOW] = FREE
            cells[part > OCCUPIED_ABOVE] = OCCUPIED
        origin = Pose2(x=low_x * self._resolution, y=low_y * self._resolution)
        return Grid(data=cells, resolution=self._resolution, origin=origin, stamp_ns=stamp_ns, frame_id=self._frame_id)

    def state(self) -> tuple[npt.NDArray[np.int8], dict[str, object]]:
        """The log-odds in steps of `STEP` (rows, columns), and where they lie: for `restore`."""
        cells = np.rint(self._log_odds / STEP).astype(np.int8)
        return cells, {"shape": cells.shape, "box": self._box, "touched": self._touched}

    def restore(self, cells: npt.NDArray[np.int8], where: Mapping[str, Any]) -> None:
        """Go on from another mapper's `state`.

        Raises:
            ValueError, TypeError, KeyError: it does not fit together; nothing has changed.
        """
        box = _box(where["box"])
        touched = None if where["touched"] is None else _box(where["touched"])
        if cells.shape != (box[3] - box[1], box[2] - box[0]) or (touched and _union(box, touched) != box):
            raise ValueError(f"{cells.shape} cells in {box}, touched {touched}")
        self._box, self._touched = box, touched
        self._log_odds = cells.astype(np.float32) * np.float32(STEP)

    def _missed(self, pose: Pose2, scan: LaserScan, window: _Box) -> npt.NDArray[np.bool_]:
        """Which cells of ``window`` a beam passes through."""
        resolution = np.float32(self._resolution)
        x = (np.arange(window[0], window[2], dtype=np.float32) + np.float32(0.5)) * resolution - np.float32(pose.x)
        y = (np.arange(window[1], window[3], dtype=np.float32) + np.float32(0.5)) * resolution - np.float32(pose.y)
        far = np.sqrt(x[None, :] ** 2 + y[:, None] ** 2)
        bearing = np.arctan2(y[:, None], x[None, :])
        beam = (
            np.rint((bearing - np.float32(pose.yaw)) * np.float32(1.0 / scan.step)).astype(np.int32) % scan.ranges.size
        )
        ends = np.minimum(np.minimum(np.roll(scan.ranges, 1), np.roll(scan.ranges, -1)), scan.ranges)
        missed: npt.NDArray[np.bool_] = far < (ends - np.float32(0.5) * resolution)[beam]
        return missed

    def _part(self, box: _Box) -> _LogOdds:
        rows = slice(box[1] - self._box[1], box[3] - self._box[1])
        return self._log_odds[rows, box[0] - self._box[0] : box[2] - self._box[0]]

    def _cover(self, window: _Box) -> _LogOdds:
        """Grow the array so that it covers ``window``, keeping what it holds; returns the window's part of it."""
        self._touched = window if self._touched is None else _union(self._touched, window)
        if self._log_odds.size == 0 or _union(self._box, window) != self._box:
            spare = (
                window[0] - _GROWTH_CELLS,
                window[1] - _GROWTH_CELLS,
                window[2] + _GROWTH_CELLS,
                window[3] + _GROWTH_CELLS,
            )
            grown = spare if self._log_odds.size == 0 else _union(self._box, spare)
            log_odds = np.zeros((grown[3] - grown[1], grown[2] - grown[0]), dtype=np.float32)
            old, old_box = self._log_odds, self._box
            self._log_odds, self._box = log_odds, grown
            if old.size:
                self._part(old_box)[:] = old
        return self._part(window)


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


def _box(raw: Any) -> _Box:
    low_x, low_y, high_x, high_y = (int(value) for value in raw)
    return low_x, low_y, high_x, high_y


def _union(a: _Box, b: _Box) -> _Box:
    return min(a[0], b[0]), min(a[1], b[1]), max(a[2], b[2]), max(a[3], b[3])
