"""A synthetic office and what robots see of it, in frames of their own. Knows: grids. Does not know: who merges."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from zsched.tasks.map_merge.compose import compose, extent_of
from zsched.tasks.map_merge.geometry import Pose2
from zsched.tasks.map_merge.grid import Grid

cv2.setNumThreads(1)  # as the worker does; more only fight with the other tests
RESOLUTION = 0.05
View = Callable[[tuple[float, float, float, float], Pose2], Grid]


def _office() -> Grid:
    """24 m x 16 m: outer walls, irregular rooms and furniture; nothing in it repeats."""
    width, height = 480, 320
    cells = np.zeros((height, width), dtype=np.uint8)
    generator = np.random.default_rng(5)
    cv2.rectangle(cells, (2, 2), (width - 3, height - 3), 100, 2)
    for _ in range(22):
        x, y = int(generator.integers(10, width - 60)), int(generator.integers(10, height - 60))
        w, h = int(generator.integers(14, 70)), int(generator.integers(14, 60))
        cv2.rectangle(cells, (x, y), (min(x + w, width - 8), min(y + h, height - 8)), 100, 2)
    for _ in range(60):
        x, y = int(generator.integers(10, width - 10)), int(generator.integers(10, height - 10))
        cv2.circle(cells, (x, y), int(generator.integers(2, 6)), 100, -1)
    return Grid(data=cells.astype(np.int8), resolution=RESOLUTION, frame_id="office")


@pytest.fixture(scope="session")
def office() -> Grid:
    """The whole office in its own (world) frame, origin at 0, 0."""
    return _office()


@pytest.fixture(scope="session")
def view(office: Grid) -> View:
    """``view((x0, y0, x1, y1), displacement)``: that part (m) of the office as a robot with that map frame has it."""

    def seen(rectangle: tuple[float, float, float, float], displacement: Pose2) -> Grid:
        x0, y0, x1, y1 = (round(value / RESOLUTION) for value in rectangle)
        part = Grid(
            data=office.data[y0:y1, x0:x1], resolution=RESOLUTION, origin=Pose2(x=x0 * RESOLUTION, y=y0 * RESOLUTION)
        )
        map_t_world = displacement.inverse()
        extent = extent_of(part, map_t_world, RESOLUTION)
        return compose([(part, map_t_world)], extent, RESOLUTION, stamp_ns=7, frame_id="map")

    return seen
