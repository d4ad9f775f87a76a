"""Finds the frontiers of a merged map and chooses one: what is to be learnt there, how far it is, who else goes there.

Knows: a planning map, distances, other robots' claims. Does not know: time, motion, messages.

A frontier is a free cell beside an unknown one (Yamauchi, "A frontier-based approach for autonomous exploration", CIRA
1997). They are found by looking at every cell and taking neighbours together, where the paper lets random trees grow
(Umari & Mukhopadhyay, IROS 2017): both look for the same cells, and looking at all of them finds each one at once and
the same ones every time. As in that work the worth of a goal is

    utility = GAIN_PER_M2 * unknown area round it - way there

less for a goal that another robot claims and has a shorter way to, and more for the goal that the robot already has.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from zsched.tasks.map_merge.grid import Mask
from zsched_lab.explore.planner import INFLATION_M, SQUARE, Bytes, Cell, Field, PlanMap, Point, grown_by

MIN_LENGTH_M = 0.4
"""Shorter ones are chinks: nothing worth a way is behind them."""
PIECE_M = 2.0
"""Longer ones are cut into pieces of about this size: several robots can go to one."""
GAIN_SIDE_M = 3.0
"""Unknown area is counted in a square of this side round the goal, ..."""
GAIN_REACH_M = 1.5
"""... as far as light gets from the frontier without passing a known wall: behind one is nothing to be learnt here."""
GAIN_PER_M2 = 1.0
"""What a square metre of unknown area is worth in metres of way."""
CLAIM_RADIUS_M = 2.0
"""A goal so near another's claim is the same place."""
CLAIM_COST_M = 12.0
KEEP_BONUS_M = 1.5
"""What the present goal is worth more: a robot that turns round for half a metre gets nowhere."""
KEEP_RADIUS_M = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Claim:
    """Where a robot goes, in the merged frame, and how far it still has (m)."""

    robot: str
    x: float
    y: float
    way_m: float

    def contests(self, other: Claim) -> bool:
        """Whether both are for one place."""
        return math.dist((self.x, self.y), (other.x, other.y)) < CLAIM_RADIUS_M

    def goes_before(self, other: Claim) -> bool:
        """Whether this one's robot is nearer. Rounded: both robots must come to the same word on that."""
        return (round(self.way_m, 1), self.robot) < (round(other.way_m, 1), other.robot)


@dataclass(frozen=True, slots=True, kw_only=True)
class Frontier:
    """One piece of frontier: where to drive, the point in its middle, unknown area near it (m2), way there (m)."""

    cell: Cell
    point: Point
    gain_m2: float
    way_m: float


def find_frontiers(plan: PlanMap, field: Field, claimed: Sequence[Point] = ()) -> list[Frontier]:
    """Every piece of frontier that can be reached; unknown area near ``claimed`` points counts for nobody else."""
    unknown = plan.unknown
    edge: Mask = plan.free & grown_by(unknown.astype(np.uint8), SQUARE).astype(np.bool_)
    count, labels = cv2.connectedComponents(edge.astype(np.uint8), connectivity=8)
    if count <= 1:
        return []
    near = _nearest_way(plan, field)
    gains = _gains(plan, edge, unknown, claimed)
    rows, columns = np.nonzero(edge & np.isfinite(near))
    piece = max(1, round(PIECE_M / plan.side))
    lengths = np.bincount(labels.ravel(), minlength=count) * plan.side
    keys = (labels[rows, columns].astype(np.int64) << 32) | ((rows // piece) << 16) | (columns // piece)
    order = np.argsort(keys, kind="stable")
    cuts = np.flatnonzero(np.diff(keys[order])) + 1
    found = []
    for members in np.split(order, cuts):
        if members.size == 0 or lengths[labels[rows[members[0]], columns[members[0]]]] < MIN_LENGTH_M:
            continue
        middle = _middle(rows[members], columns[members])
        cell = (int(rows[members[middle]]), int(columns[members[middle]]))
        goal = _reachable(plan, field, cell)
        if goal is None:
            continue
        found.append(Frontier(cell=goal, point=plan.point(cell), gain_m2=float(gains[cell]), way_m=float(field[goal])))
    return found


def choose(
    robot: str,
    frontiers: Sequence[Frontier],
    claims: Collection[Claim],
    present: Point | None,
    avoided: Sequence[Point],
) -> Frontier | None:
    """The frontier of highest utility, ``None`` when there is none; ``avoided`` ones (radius 1 m) do not count."""
    usable = [one for one in frontiers if not any(math.dist(one.point, point) < KEEP_RADIUS_M for point in avoided)]
    return max(usable, key=lambda one: (utility(robot, one, claims, present), one.point), default=None)


def utility(robot: str, frontier: Frontier, claims: Collection[Claim], present: Point | None) -> float:
    """What going there is worth to ``robot``, in metres of way."""
    worth = GAIN_PER_M2 * frontier.gain_m2 - frontier.way_m
    if present is not None and math.dist(frontier.point, present) < KEEP_RADIUS_M:
        worth += KEEP_BONUS_M
    mine = Claim(robot=robot, x=frontier.point[0], y=frontier.point[1], way_m=frontier.way_m)
    if any(claim.contests(mine) and claim.goes_before(mine) for claim in claims):
        worth -= CLAIM_COST_M
    return worth


def _nearest_way(plan: PlanMap, field: Field) -> Field:
    """For each cell the shortest way to a cell so near that a robot standing there sees it."""
    reach = math.ceil((INFLATION_M + plan.side) / plan.side) + 1
    kernel: Bytes = np.ones((2 * reach + 1, 2 * reach + 1), dtype=np.uint8)
    far = np.where(np.isfinite(field), field, np.float32(1e9)).astype(np.float32)
    near = cv2.erode(far, kernel)
    return np.where(near < 1e8, near, np.float32(np.inf)).astype(np.float32)


def _gains(plan: PlanMap, edge: Mask, unknown: Mask, claimed: Sequence[Point]) -> Field:
    """For each cell the unknown area (m2) round it that hangs together with a frontier."""
    shut = plan.occupied.astype(np.uint8)
    lit = edge.astype(np.uint8)
    for _ in range(round(GAIN_REACH_M / plan.side)):
        lit = grown_by(lit, SQUARE) & (1 - shut)
    open_cells = (lit.astype(np.bool_) & unknown).astype(np.float32)
    side = round(GAIN_SIDE_M / plan.side) | 1
    for point in claimed:
        row, column = plan.cell(point)
        cv2.circle(open_cells, (column, row), side // 2, 0.0, -1)
    total = cv2.boxFilter(open_cells, -1, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT)
    return (total * plan.side**2).astype(np.float32)


def _middle(
    rows: np.ndarray[tuple[int], np.dtype[np.int64]], columns: np.ndarray[tuple[int], np.dtype[np.int64]]
) -> int:
    """The index of the cell that lies nearest to the mean of all."""
    return int(np.argmin((rows - rows.mean()) ** 2 + (columns - columns.mean()) ** 2))


def _reachable(plan: PlanMap, field: Field, cell: Cell) -> Cell | None:
    """The cell that can be reached, nearest to ``cell``."""
    reach = math.ceil((INFLATION_M + plan.side) / plan.side) + 1
    top, left = max(0, cell[0] - reach), max(0, cell[1] - reach)
    part = field[top : cell[0] + reach + 1, left : cell[1] + reach + 1]
    rows, columns = np.nonzero(np.isfinite(part))
    if rows.size == 0:
        return None
    nearest = int(np.argmin((rows + top - cell[0]) ** 2 + (columns + left - cell[1]) ** 2))
    return int(rows[nearest]) + top, int(columns[nearest]) + left
