"""Plans ways on an occupancy grid: how far every cell is from the robot, and the way there.

Knows: a grid in the merged frame, walls grown by the robot's size. Does not know: robots, frontiers, time.

Cells of the map are taken together to `PLAN_CELL_M` (a wall in any of them is a wall). The distance is a wave from the
robot's cell over free cells that keep `INFLATION_M` from every wall: Dijkstra's algorithm for unit costs, as dilations
by crosses and squares in turn (an octagon for a circle: up to 8 % too short). Unknown cells are never driven on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from zsched.tasks.map_merge.geometry import Pose2
from zsched.tasks.map_merge.grid import Grid, Mask

PLAN_CELL_M = 0.1
INFLATION_M = 0.18
"""Half a Burger and a cell: drift and corners are in it."""
LONGEST_LEG_CELLS = 30
MARGIN_CELLS = 16
"""Unknown cells put round the map: its last rows border on what nobody has seen, and that is a frontier."""
START_RADIUS_M = 0.5
"""How far a robot that stands too near a wall (or on an unknown cell) may look for a cell from where it can drive."""

Field = npt.NDArray[np.float32]
Bytes = npt.NDArray[np.uint8]
Cell = tuple[int, int]
"""(row, column)."""
Point = tuple[float, float]

CROSS: Bytes = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], dtype=np.uint8)
SQUARE: Bytes = np.ones((3, 3), dtype=np.uint8)
SQUARE_TURNS = (2, 4)
"""Of five steps two are by a square: the octagon that comes nearest to a circle."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlanMap:
    """What a robot plans on: masks (rows, columns) of `side` metres a cell, in the merged frame.

    ``grid_pose``: where the outer corner of cell (0, 0) lies.
    """

    free: Mask
    occupied: Mask
    drivable: Mask
    side: float
    grid_pose: Pose2

    @property
    def unknown(self) -> Mask:
        """Neither free nor a wall."""
        mask: Mask = ~(self.free | self.occupied)
        return mask

    def cell(self, point: Point) -> Cell:
        """The cell of a point, the nearest one for a point outside."""
        x, y = self.grid_pose.inverse().apply_point(*point)
        row, column = math.floor(y / self.side), math.floor(x / self.side)
        return min(max(row, 0), self.free.shape[0] - 1), min(max(column, 0), self.free.shape[1] - 1)

    def point(self, cell: tuple[float, float]) -> Point:
        """The middle of a cell (or of a mean of cells)."""
        return self.grid_pose.apply_point((cell[1] + 0.5) * self.side, (cell[0] + 0.5) * self.side)


def plan_map(grid: Grid) -> PlanMap:
    """The grid with larger cells, and where a robot may drive on it."""
    times = max(1, round(PLAN_CELL_M / grid.resolution))
    occupied, free = (np.pad(_blocks(mask, times), MARGIN_CELLS) for mask in (grid.occupied, grid.free))
    free &= ~occupied
    side = grid.resolution * times
    clear: Field = cv2.distanceTransform((~occupied).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_3).astype(np.float32)
    drivable: Mask = free & (clear * np.float32(side) > INFLATION_M + side / 2)
    margin = -MARGIN_CELLS * side
    corner = grid.origin.compose(Pose2(x=margin, y=margin))
    return PlanMap(free=free, occupied=occupied, drivable=drivable, side=side, grid_pose=corner)


def _blocks(mask: Mask, times: int) -> Mask:
    """Whether any cell of each block of ``times`` x ``times`` is set; one more row of blocks for a remainder."""
    rows, columns = (-(-size // times) for size in mask.shape)
    padded = np.zeros((rows * times, columns * times), dtype=np.bool_)
    padded[: mask.shape[0], : mask.shape[1]] = mask
    return np.asarray(padded.reshape(rows, times, columns, times).any(axis=(1, 3)), dtype=np.bool_)


def distances(plan: PlanMap, start: Point) -> Field:
    """Metres from ``start`` to every cell, infinite where no way leads; all infinite when the start is shut in."""
    field = np.full(plan.drivable.shape, np.inf, dtype=np.float32)
    cell = _start_cell(plan, plan.cell(start))
    if cell is None:
        return field
    drivable = plan.drivable.astype(np.uint8)
    reached = np.zeros_like(drivable)
    reached[cell] = 1
    field[cell] = 0.0
    count, step = 1, 0
    while True:
        step += 1
        is_square = step % 5 in SQUARE_TURNS
        grown = grown_by(reached, SQUARE if is_square else CROSS) & drivable
        total = cv2.countNonZero(grown)
        # A cross may have to wait for the square that gets it through a diagonal gap.
        if total == count and is_square:
            return field
        if total != count:
            field[(grown ^ reached).view(np.bool_)] = step * plan.side
        reached, count = grown, total


def grown_by(mask: Bytes, kernel: Bytes) -> Bytes:
    """The mask (0, 1) dilated once."""
    return cv2.dilate(mask, kernel).astype(np.uint8, copy=False)


def _start_cell(plan: PlanMap, cell: Cell) -> Cell | None:
    """The nearest drivable cell to the robot's own within `START_RADIUS_M`."""
    if plan.drivable[cell]:
        return cell
    reach = math.ceil(START_RADIUS_M / plan.side)
    top, left = max(0, cell[0] - reach), max(0, cell[1] - reach)
    rows, columns = np.nonzero(plan.drivable[top : cell[0] + reach + 1, left : cell[1] + reach + 1])
    if rows.size == 0:
        return None
    nearest = int(np.argmin((rows + top - cell[0]) ** 2 + (columns + left - cell[1]) ** 2))
    return int(rows[nearest]) + top, int(columns[nearest]) + left


def way_to(plan: PlanMap, field: Field, goal: Cell) -> tuple[Point, ...]:
    """The corners of the way from the robot's side to ``goal``, downhill in ``field``; empty when there is no way."""
    if not math.isfinite(float(field[goal])):
        return ()
    cells = [goal]
    while field[cells[-1]] > 0.0:
        row, column = cells[-1]
        top, left = max(0, row - 1), max(0, column - 1)
        part = field[top : row + 2, left : column + 2]
        lowest = int(part.argmin())
        following = (top + lowest // part.shape[1], left + lowest % part.shape[1])
        if following == cells[-1] or field[following] >= field[cells[-1]]:
            return ()
        cells.append(following)
    return tuple(plan.point(cell) for cell in _straightened(plan, cells[::-1]))


def _straightened(plan: PlanMap, cells: list[Cell]) -> list[Cell]:
    """The same way with fewer corners: from each cell straight on as far as it can be driven."""
    kept, index = [cells[0]], 0
    while index < len(cells) - 1:
        reach = min(len(cells) - 1, index + LONGEST_LEG_CELLS)
        index = next(
            (far for far in range(reach, index + 1, -3) if _is_clear(plan, cells[index], cells[far])), index + 1
        )
        kept.append(cells[index])
    return kept


def _is_clear(plan: PlanMap, a: Cell, b: Cell) -> bool:
    """Whether the straight line between two cells is drivable."""
    count = 2 * max(abs(b[0] - a[0]), abs(b[1] - a[1])) + 1
    rows, columns = (np.rint(np.linspace(start, end, count)).astype(np.intp) for start, end in zip(a, b, strict=True))
    return bool(plan.drivable[rows, columns].all())
