"""The occupancy grid as a value, and its cells as three levels: unknown, free, occupied.

Knows: cells, resolution, the grid's place in its map frame. Does not know: bytes (`cdr`), other robots, alignment.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from zsched.core.values.struct import Struct, replace
from zsched.tasks.map_merge.geometry import FloatArray, Pose2

Cells = npt.NDArray[np.int8]
Mask = npt.NDArray[np.bool_]

UNKNOWN, FREE, OCCUPIED = -1, 0, 100
OCCUPIED_FROM = 65
"""Cells from here on are walls (map_server's occupied_thresh); up to `FREE_TO` free; between: known, but neither."""
FREE_TO = 25
MAX_CELLS = 64_000_000
"""Largest grid taken or published, 400 m x 400 m at 0.05 m: a wrong origin or size must not take all memory."""
MAX_SIDE_CELLS = 30_000
"""Longest side; OpenCV's warp indexes with 16 bits."""
MAX_ORIGIN_M = 1e8
"""Farther than any projected coordinate on earth."""
RESOLUTION_RANGE_M = (0.005, 5.0)


class Grid(Struct, frozen=True, kw_only=True, eq=False):
    """An occupancy grid as in nav_msgs/msg/OccupancyGrid.

    ``data`` is int8 (height, width), row 0 at the origin: -1 unknown, 0 free .. 100 occupied. ``origin`` is the pose of
    cell (0, 0)'s outer corner in ``frame_id``; its yaw turns the whole grid. ``resolution`` in metres per cell.
    ``stamp_ns`` is the sender's time and only ever compared with stamps of the same sender.

    Raises:
        ValueError: a shape, resolution or origin that no map has.
    """

    data: Cells
    resolution: float
    origin: Pose2 = Pose2()
    stamp_ns: int = 0
    frame_id: str = "map"

    def __post_init__(self) -> None:
        if self.data.ndim != 2 or self.data.dtype != np.int8:
            raise ValueError(f"grid.data: {self.data.dtype} of {self.data.ndim} dimensions is not int8 of 2")
        if self.data.size > MAX_CELLS or max(self.data.shape) > MAX_SIDE_CELLS:
            raise ValueError(f"grid.data: {self.data.shape[1]} x {self.data.shape[0]} cells are too many")
        low, high = RESOLUTION_RANGE_M
        if not low <= self.resolution <= high:
            raise ValueError(f"grid.resolution: {self.resolution!r} is not in [{low:g}, {high:g}] m")
        if not self.origin.is_finite or max(abs(self.origin.x), abs(self.origin.y)) > MAX_ORIGIN_M:
            raise ValueError(f"grid.origin: {self.origin} is not finite and within {MAX_ORIGIN_M:g} m")

    @property
    def width(self) -> int:
        """Cells per row."""
        return int(self.data.shape[1])

    @property
    def height(self) -> int:
        """Rows."""
        return int(self.data.shape[0])

    @property
    def occupied(self) -> Mask:
        """Which cells are walls."""
        mask: Mask = self.data >= OCCUPIED_FROM
        return mask

    @property
    def free(self) -> Mask:
        """Which cells are free."""
        mask: Mask = (self.data >= FREE) & (self.data <= FREE_TO)
        return mask

    @property
    def known(self) -> Mask:
        """Which cells were seen at all."""
        mask: Mask = self.data >= FREE
        return mask

    @property
    def known_area_m2(self) -> float:
        """The seen area in square metres."""
        return float(np.count_nonzero(self.known)) * self.resolution**2

    def outline(self) -> FloatArray:
        """Points (N, 2) in the map frame whose rectangle, under any transform, holds every known cell.

        The outer corners of each row's first and last known cell; of cell (0, 0) when nothing is known.
        """
        known = self.known
        rows = np.flatnonzero(known.any(axis=1))
        if rows.size == 0:
            return self.origin.apply(np.array([[0.0, 0.0], [self.resolution, self.resolution]]))
        first = known[rows].argmax(axis=1)
        last = self.width - known[rows, ::-1].argmax(axis=1)
        corners = [(first, rows), (first, rows + 1), (last, rows), (last, rows + 1)]
        local = np.concatenate([np.stack(corner, axis=1) for corner in corners]) * self.resolution
        return self.origin.apply(local.astype(np.float64))

    def points(self, mask: Mask) -> FloatArray:
        """The centres (N, 2) of the masked cells in the map frame, in metres."""
        rows, columns = np.nonzero(mask)
        local = np.stack((columns + 0.5, rows + 0.5), axis=1) * self.resolution
        return self.origin.apply(local)


def crop_known(grid: Grid) -> Grid | None:
    """The same grid without its unknown margins; ``None`` when nothing in it is known."""
    known = grid.known
    rows = np.flatnonzero(known.any(axis=1))
    columns = np.flatnonzero(known.any(axis=0))
    if rows.size == 0:
        return None
    top, left = int(rows[0]), int(columns[0])
    corner = Pose2(x=left * grid.resolution, y=top * grid.resolution)
    return replace(
        grid, data=grid.data[top : int(rows[-1]) + 1, left : int(columns[-1]) + 1], origin=grid.origin.compose(corner)
    )


def same_resolution(a: float, b: float) -> bool:
    """Whether two resolutions are equal as far as a message's float32 can tell."""
    return math.isclose(a, b, rel_tol=1e-5)
