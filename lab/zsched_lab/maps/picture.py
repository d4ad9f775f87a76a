"""A merged map, small enough for a terminal: robots' applications record it, the live view draws it.

Knows: blocks of cells, how a picture is kept in a record. Does not know: characters, colours.
"""

from __future__ import annotations

import base64
import zlib
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from zsched.tasks.map_merge.grid import Grid, Mask

SIDE = 160
"""Cells of the longer side at most: two for each dot of a wide terminal."""
UNKNOWN, FREE, WALL = 0, 1, 2


@dataclass(frozen=True, slots=True, kw_only=True)
class MapPicture:
    """What is known of a map, each cell standing for a block of the map's."""

    cells: npt.NDArray[np.uint8]
    """height x width of `UNKNOWN`, `FREE`, `WALL`; row 0 at the bottom."""
    known_m2: float

    @classmethod
    def of(cls, grid: Grid) -> Self:
        """The part of the map that is known; a block with a wall in it is a wall."""
        rows, columns = np.flatnonzero(grid.known.any(axis=1)), np.flatnonzero(grid.known.any(axis=0))
        if rows.size == 0:
            return cls(cells=np.zeros((0, 0), np.uint8), known_m2=0.0)
        part = (slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1))
        block = -(-max(grid.known[part].shape) // SIDE)
        cells = np.where(blocks(grid.occupied[part], block), WALL, blocks(grid.known[part], block) * FREE)
        return cls(cells=cells.astype(np.uint8), known_m2=grid.known_area_m2)

    def record(self) -> dict[str, Any]:
        """As JSON values."""
        packed = base64.b85encode(zlib.compress(self.cells.tobytes())).decode()
        return {"shape": list(self.cells.shape), "known_m2": round(self.known_m2, 1), "cells": packed}

    @classmethod
    def read(cls, record: dict[str, Any]) -> Self:
        """Of what `record` gave. Raises `ValueError`, `KeyError` or `zlib.error` for anything else."""
        cells = np.frombuffer(zlib.decompress(base64.b85decode(record["cells"])), np.uint8)
        return cls(cells=cells.reshape(record["shape"]), known_m2=float(record["known_m2"]))


def blocks(mask: Mask, side: int) -> Mask:
    """Which blocks of ``side`` x ``side`` cells have one that is set."""
    height, width = (-(-length // side) for length in mask.shape)
    padded = np.zeros((height * side, width * side), bool)
    padded[: mask.shape[0], : mask.shape[1]] = mask
    found: Mask = np.asarray(padded.reshape(height, side, width, side).any(axis=(1, 3)))
    return found
