"""Tells how much of the world a merged map knows: the lab's instrument, which no robot looks at.

Knows: the truth's known cells. Does not know: ways.

Coverage is the share of the truth's known cells that the map knows, as in `zsched_lab.maps.metrics`, but looked up cell
by cell: a millisecond, so that it can be taken of every map that comes.
"""

from __future__ import annotations

import numpy as np

from zsched.tasks.map_merge.geometry import Pose2
from zsched.tasks.map_merge.grid import Grid
from zsched_lab.explore.world import World

SAMPLED = 4
"""Every fourth cell is looked up: 20 000 of them tell the share to a thousandth."""


class Referee:
    """Holds maps against one world."""

    def __init__(self, world: World) -> None:
        truth = world.truth()
        self._points = truth.points(truth.known)[::SAMPLED]

    def coverage(self, merged: Grid, world_t_merged: Pose2 | None = None) -> float:
        """The share of the world that ``merged`` knows, in [0, 1]; its frame is the world's unless told otherwise."""
        points = self._points
        to_grid = (world_t_merged or Pose2()).compose(merged.origin).inverse()
        cells = np.floor(to_grid.apply(points) / merged.resolution).astype(np.int64)
        column, row = cells[:, 0], cells[:, 1]
        inside = (column >= 0) & (row >= 0) & (column < merged.width) & (row < merged.height)
        known = merged.known[row[inside], column[inside]]
        return float(np.count_nonzero(known) / len(points))
