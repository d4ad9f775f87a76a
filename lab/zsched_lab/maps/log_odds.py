"""A grid of log-odds that grows with what robots see. Knows: cells, hits and misses. Does not know: scans, poses.

Occupancy grid mapping by log-odds (Moravec & Elfes 1985; Thrun, Burgard & Fox, "Probabilistic Robotics", table 9.1)
with the inverse sensor model "end cell hit, cells before it missed"; each cell counts once per scan.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from zsched.tasks.map_merge.geometry import Pose2
from zsched.tasks.map_merge.grid import FREE, OCCUPIED, UNKNOWN, Grid, Mask

HIT, MISS, CLIP = 0.85, -0.4, 5.0
OCCUPIED_ABOVE, FREE_BELOW = 0.6, -0.3
STEP = 0.05
"""`HIT`, `MISS` and `CLIP` are multiples of it: in steps of it a log-odds fits into a byte."""
_GROWTH_CELLS = 128
"""Spare cells on each side when the array has to grow, so that it does not grow with every scan."""


class Box(NamedTuple):
    """A rectangle of cells; ``low`` inclusive, ``high`` exclusive, in cells of the map frame (may be negative)."""

    low_x: int
    low_y: int
    high_x: int
    high_y: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows, columns."""
        return self.high_y - self.low_y, self.high_x - self.low_x

    def union(self, other: Box) -> Box:
        """The smallest box with both in it."""
        return Box(*map(min, self[:2], other[:2]), *map(max, self[2:], other[2:]))

    def padded(self, cells: int) -> Box:
        """The box with so many cells more on each side."""
        return Box(self.low_x - cells, self.low_y - cells, self.high_x + cells, self.high_y + cells)


class LogOdds:
    """One robot's grid in its own map frame. The array grows as needed; a cell's place never changes."""

    def __init__(self, resolution: float, frame_id: str) -> None:
        self.resolution = resolution
        """Metres per cell."""
        self._frame_id = frame_id
        self._box = Box(0, 0, 0, 0)
        self._touched: Box | None = None
        self._log_odds: npt.NDArray[np.float32] = np.zeros((0, 0), dtype=np.float32)

    def update(self, window: Box, hit: Mask, missed: Mask) -> None:
        """Work in a scan that has seen the cells of ``window``; a cell that is hit is not missed."""
        self._cover(window)
        part = self._part(window)
        np.add(part, np.float32(HIT), out=part, where=hit)
        np.add(part, np.float32(MISS), out=part, where=missed & ~hit)
        np.clip(part, -CLIP, CLIP, out=part)

    def occupied(self, window: Box) -> Mask:
        """Which cells of ``window`` are walls; it may lie outside of what was seen."""
        found: Mask = np.zeros(window.shape, dtype=np.bool_)
        known = Box(*map(max, window[:2], self._box[:2]), *map(min, window[2:], self._box[2:]))
        if known.low_x < known.high_x and known.low_y < known.high_y:
            found[_slices(window, known)] = self._part(known) > OCCUPIED_ABOVE
        return found

    def grid(self, stamp_ns: int = 0) -> Grid:
        """The grid so far, cut to what was ever in a window (1 x 1 unknown before the first scan)."""
        touched = self._touched or Box(0, 0, 1, 1)
        cells = np.full(touched.shape, UNKNOWN, dtype=np.int8)
        if self._touched is not None:
            part = self._part(touched)
            cells[part < FREE_BELOW] = FREE
            cells[part > OCCUPIED_ABOVE] = OCCUPIED
        origin = Pose2(x=touched.low_x * self.resolution, y=touched.low_y * self.resolution)
        return Grid(data=cells, resolution=self.resolution, origin=origin, stamp_ns=stamp_ns, frame_id=self._frame_id)

    def state(self) -> tuple[npt.NDArray[np.int8], dict[str, object]]:
        """The log-odds in steps of `STEP` (rows, columns), and where they lie: for `restore`."""
        cells = np.rint(self._log_odds / STEP).astype(np.int8)
        return cells, {"shape": cells.shape, "box": self._box, "touched": self._touched}

    def restore(self, cells: npt.NDArray[np.int8], where: Mapping[str, Any]) -> None:
        """Go on from another grid's `state`.

        Raises:
            ValueError, TypeError, KeyError: it does not fit together; nothing has changed.
        """
        box = Box(*map(int, where["box"]))
        touched = None if where["touched"] is None else Box(*map(int, where["touched"]))
        if cells.shape != box.shape or (touched and box.union(touched) != box):
            raise ValueError(f"{cells.shape} cells in {box}, touched {touched}")
        self._box, self._touched = box, touched
        self._log_odds = cells.astype(np.float32) * np.float32(STEP)

    def _part(self, box: Box) -> npt.NDArray[np.float32]:
        return self._log_odds[_slices(self._box, box)]

    def _cover(self, window: Box) -> None:
        """Grow the array so that it covers ``window``, keeping what it holds."""
        self._touched = window if self._touched is None else self._touched.union(window)
        is_empty = self._log_odds.size == 0
        if not is_empty and self._box.union(window) == self._box:
            return
        spare, old, log_odds = window.padded(_GROWTH_CELLS), self._box, self._log_odds
        self._box = spare if is_empty else old.union(spare)
        self._log_odds = np.zeros(self._box.shape, dtype=np.float32)
        if not is_empty:
            self._part(old)[:] = log_odds


def _slices(outer: Box, inner: Box) -> tuple[slice, slice]:
    """Where ``inner`` lies in an array that covers ``outer``."""
    return (
        slice(inner.low_y - outer.low_y, inner.high_y - outer.low_y),
        slice(inner.low_x - outer.low_x, inner.high_x - outer.low_x),
    )
