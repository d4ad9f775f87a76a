"""Lays grids over each other on one canvas that never jumps: fixed lattice, growing only.

Knows: where each grid's map frame lies in the world, how cells are resampled. Does not know: how that was found.

The canvas is a lattice of cells anchored at the world's origin; its extent grows by whole blocks and never shrinks, so
a viewer sees every cell stay where it is. A cell of the result is the strongest of the inputs: unknown < free <
occupied. A finer input is reduced by taking the strongest of the cells that share one (thin walls survive), a coarser
one by repeating cells.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import cv2
import numpy as np
import numpy.typing as npt

from zsched.core.values.struct import Struct, replace
from zsched.tasks.map_merge.geometry import FloatArray, Pose2
from zsched.tasks.map_merge.grid import MAX_CELLS, MAX_SIDE_CELLS, OCCUPIED, UNKNOWN, Cells, Grid, same_resolution

BLOCK_CELLS = 64
_NUDGE_CELLS = 2.0**-9
"""Half-way between two cells OpenCV takes the even one: a grid that lies off by half a cell would lose every other row.
This much to one side (more than single precision blurs an index) and it takes them all."""
Levels = npt.NDArray[np.uint8]
"""Cells shifted by one so that unknown is 0: what OpenCV can warp, dilate and pad without a special case."""


class Extent(Struct, frozen=True, kw_only=True):
    """A rectangle of lattice cells; ``low`` inclusive, ``high`` exclusive."""

    low_x: int
    low_y: int
    high_x: int
    high_y: int

    @property
    def width(self) -> int:
        """Cells per row."""
        return self.high_x - self.low_x

    @property
    def height(self) -> int:
        """Rows."""
        return self.high_y - self.low_y

    @property
    def is_too_large(self) -> bool:
        """Whether a grid of this extent would be refused as a message."""
        return max(self.width, self.height) > MAX_SIDE_CELLS or self.width * self.height > MAX_CELLS

    def union(self, other: Extent | None) -> Extent:
        """The smallest extent that covers both."""
        if other is None:
            return self
        return Extent(
            low_x=min(self.low_x, other.low_x),
            low_y=min(self.low_y, other.low_y),
            high_x=max(self.high_x, other.high_x),
            high_y=max(self.high_y, other.high_y),
        )

    def in_blocks(self) -> Extent:
        """The smallest extent of whole blocks that covers this one."""
        return Extent(
            low_x=self.low_x // BLOCK_CELLS * BLOCK_CELLS,
            low_y=self.low_y // BLOCK_CELLS * BLOCK_CELLS,
            high_x=-(-self.high_x // BLOCK_CELLS) * BLOCK_CELLS,
            high_y=-(-self.high_y // BLOCK_CELLS) * BLOCK_CELLS,
        )


def extent_of(grid: Grid, world_t_map: Pose2, resolution: float) -> Extent:
    """The lattice cells that the known cells of ``grid`` may touch when its map frame lies at ``world_t_map``.

    A turned grid's own rectangle would claim up to twice the cells, and everybody would have to carry them.
    """
    outline = world_t_map.apply(grid.outline()) / resolution
    # A corner that is on the lattice up to rounding must not claim the next row of cells.
    low = np.floor(outline.min(axis=0) + 1e-6)
    high = np.ceil(outline.max(axis=0) - 1e-6)
    return Extent(low_x=int(low[0]), low_y=int(low[1]), high_x=int(high[0]), high_y=int(high[1]))


def compose(
    layers: Iterable[tuple[Grid, Pose2]],
    extent: Extent,
    resolution: float,
    *,
    stamp_ns: int = 0,
    frame_id: str = "world",
) -> Grid:
    """Lay the grids (each with its map frame's pose in the world) over each other on ``extent``.

    Returns:
        A grid of exactly that extent, without yaw; its origin is a whole number of cells from the world's origin.
    """
    canvas = np.zeros((extent.height, extent.width), dtype=np.uint8)
    for grid, world_t_map in layers:
        part = extent_of(grid, world_t_map, resolution)
        rows = slice(part.low_y - extent.low_y, part.high_y - extent.low_y)
        columns = slice(part.low_x - extent.low_x, part.high_x - extent.low_x)
        region = canvas[rows, columns]
        np.maximum(region, _warp(grid, world_t_map, part, resolution), out=region)
    return Grid(
        data=_cells(canvas),
        resolution=resolution,
        origin=Pose2(x=extent.low_x * resolution, y=extent.low_y * resolution),
        stamp_ns=stamp_ns,
        frame_id=frame_id,
    )


def resample(grid: Grid, resolution: float) -> Grid:
    """The same grid with cells of ``resolution``, its axes (yaw) and outer corner kept; itself when nothing changes.

    Going coarser, every cell counts in exactly one larger cell: sampling the middles would lose thin walls, or shift
    them by half a cell.
    """
    if same_resolution(grid.resolution, resolution) or grid.data.size == 0:
        return grid
    if resolution > grid.resolution:
        cells = np.maximum(grid.data, UNKNOWN)
        for axis in (0, 1):
            cells = np.maximum.reduceat(cells, _first_cells(grid, resolution, axis), axis=axis)
        return replace(grid, data=cells, resolution=resolution)
    width = max(1, math.ceil(grid.width * grid.resolution / resolution - 1e-6))
    height = max(1, math.ceil(grid.height * grid.resolution / resolution - 1e-6))
    extent = Extent(low_x=0, low_y=0, high_x=width, high_y=height)
    # Seen from its own outer corner the grid lies straight on a lattice of the new resolution.
    levels = _warp(grid, grid.origin.inverse(), extent, resolution)
    return replace(grid, data=_cells(levels), resolution=resolution)


def _first_cells(grid: Grid, resolution: float, axis: int) -> npt.NDArray[np.int64]:
    """For each larger cell along ``axis`` the index of the first cell whose middle lies in it."""
    middles = (np.arange(grid.data.shape[axis]) + 0.5) * (grid.resolution / resolution)
    return np.flatnonzero(np.diff(np.floor(middles), prepend=-1.0))


def _levels(grid: Grid) -> Levels:
    return (np.clip(grid.data, UNKNOWN, OCCUPIED) + np.int8(1)).astype(np.uint8)


def _cells(levels: Levels) -> Cells:
    return (levels.astype(np.int16) - 1).astype(np.int8)


def _warp(grid: Grid, world_t_map: Pose2, extent: Extent, resolution: float) -> Levels:
    """The grid's levels on the lattice cells of ``extent``, by nearest cell."""
    if resolution > grid.resolution:
        grid = resample(grid, resolution)
    levels = _levels(grid)
    to_source = _cell_matrix(grid, world_t_map, extent, resolution)
    warped = cv2.warpAffine(
        levels,
        to_source,
        (extent.width, extent.height),
        flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=0,
    )
    return warped.astype(np.uint8, copy=False)


def _cell_matrix(grid: Grid, world_t_map: Pose2, extent: Extent, resolution: float) -> FloatArray:
    """The affine matrix (2, 3) from indices of cells of ``extent`` to indices of the grid's cells, centre to centre."""
    cell_to_world = np.array(
        [
            [resolution, 0.0, (extent.low_x + 0.5) * resolution],
            [0.0, resolution, (extent.low_y + 0.5) * resolution],
            [0.0, 0.0, 1.0],
        ]
    )
    world_to_grid = world_t_map.compose(grid.origin).inverse().matrix()
    per_cell = 1.0 / grid.resolution
    grid_to_cell = np.array([[per_cell, 0.0, -0.5], [0.0, per_cell, -0.5], [0.0, 0.0, 1.0]])
    matrix: FloatArray = grid_to_cell @ world_to_grid @ cell_to_world
    matrix[:2, 2] += _NUDGE_CELLS
    return matrix[:2]
