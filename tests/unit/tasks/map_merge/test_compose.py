"""The canvas: whole cells, growing only, strongest cell wins, every resolution."""

from __future__ import annotations

import math

import numpy as np
import pytest

from zsched.tasks.map_merge.compose import Extent, compose, extent_of, resample
from zsched.tasks.map_merge.geometry import Pose2
from zsched.tasks.map_merge.grid import OCCUPIED, Grid, crop_known


def _grid(data: list[list[int]], *, resolution: float = 0.05, origin: Pose2 | None = None) -> Grid:
    return Grid(data=np.array(data, dtype=np.int8), resolution=resolution, origin=origin or Pose2())


def test_compose_on_the_lattice_copies_cells_exactly(office: Grid) -> None:
    shift = Pose2(x=-40 * 0.05, y=17 * 0.05)
    extent = extent_of(office, shift, 0.05)
    assert (extent.width, extent.height) == (office.width, office.height)
    merged = compose([(office, shift)], extent, 0.05)
    assert np.array_equal(merged.data, office.data)
    assert (merged.origin.x, merged.origin.y) == pytest.approx((-2.0, 0.85))


@pytest.mark.parametrize("quarter", [1, 2, 3])
def test_compose_turned_by_a_quarter_is_a_rotation_of_the_cells(office: Grid, quarter: int) -> None:
    turn = Pose2(yaw=quarter * math.pi / 2)
    merged = compose([(office, turn)], extent_of(office, turn, 0.05), 0.05)
    assert np.array_equal(merged.data, np.rot90(office.data, -quarter))  # row 0 is at the bottom of the map


def test_origin_yaw_counts_like_a_turned_frame(office: Grid) -> None:
    pose = Pose2(x=1.0, y=-2.0, yaw=0.3)
    turned = Grid(data=office.data, resolution=0.05, origin=pose)
    extent = extent_of(office, pose, 0.05)
    assert extent_of(turned, Pose2(), 0.05) == extent
    a = compose([(turned, Pose2())], extent, 0.05)
    b = compose([(office, pose)], extent, 0.05)
    assert np.array_equal(a.data, b.data)


def test_strongest_cell_wins() -> None:
    extent = Extent(low_x=0, low_y=0, high_x=3, high_y=1)
    merged = compose([(_grid([[-1, 0, 100]]), Pose2()), (_grid([[0, 100, 0]]), Pose2())], extent, 0.05)
    assert merged.data.tolist() == [[0, 100, 100]]


def test_finer_grid_keeps_its_thin_walls() -> None:
    fine = np.zeros((40, 40), dtype=np.int8)
    fine[:, 17] = 100  # a wall of 1 cm
    coarse = resample(Grid(data=fine, resolution=0.01), 0.05)
    assert coarse.data.shape == (8, 8)
    assert (coarse.data.max(axis=1) == 100).all()
    assert int((coarse.data[4] == 100).sum()) <= 2


@pytest.mark.parametrize("factor", [2, 3, 4, 5])
def test_every_cell_counts_in_exactly_one_larger_cell(factor: int) -> None:
    generator = np.random.default_rng(factor)
    fine = generator.choice(np.array([-1, 0, 100], dtype=np.int8), size=(6 * factor, 7 * factor))
    coarse = resample(Grid(data=fine, resolution=0.05), 0.05 * factor)
    assert np.array_equal(coarse.data, fine.reshape(6, factor, 7, factor).max(axis=(1, 3)))


def test_resample_keeps_the_place_under_yaw(office: Grid) -> None:
    turned = Grid(data=office.data, resolution=0.05, origin=Pose2(x=3.0, y=1.0, yaw=1.0))
    coarse = resample(turned, 0.1)
    assert coarse.origin == turned.origin
    walls, kept = turned.points(turned.occupied), coarse.points(coarse.occupied)
    assert np.allclose(walls.mean(axis=0), kept.mean(axis=0), atol=0.1)


def test_extent_in_blocks_covers_and_never_shrinks() -> None:
    extent = Extent(low_x=-1, low_y=5, high_x=64, high_y=65).in_blocks()
    assert extent == Extent(low_x=-64, low_y=0, high_x=64, high_y=128)
    inner = Extent(low_x=0, low_y=0, high_x=1, high_y=1)
    assert inner.union(extent) == extent == extent.union(None)


def test_crop_known_cuts_margins_and_keeps_the_place() -> None:
    data = np.full((10, 12), -1, dtype=np.int8)
    data[3:5, 4:9] = 0
    origin = Pose2(x=1.0, y=2.0, yaw=0.5)
    grid = Grid(data=data, resolution=0.1, origin=origin)
    cropped = crop_known(grid)
    assert cropped is not None
    assert cropped.data.shape == (2, 5)
    assert np.allclose(cropped.points(cropped.known), grid.points(grid.known))
    assert crop_known(Grid(data=np.full((3, 3), -1, dtype=np.int8), resolution=0.1)) is None


@pytest.mark.parametrize("offset_m", [0.0, 0.0125, 0.025, 0.0375, -0.025])
@pytest.mark.parametrize("yaw", [0.0, math.pi / 2, math.pi])
def test_walls_of_one_cell_survive_whatever_part_of_a_cell_the_grid_lies_off(offset_m: float, yaw: float) -> None:
    data = np.zeros((41, 41), dtype=np.int8)
    data[1::2] = OCCUPIED
    grid = Grid(data=data, resolution=0.05, origin=Pose2(x=offset_m, y=offset_m))
    pose = Pose2(yaw=yaw)
    merged = compose([(grid, pose)], extent_of(grid, pose, 0.05), 0.05)
    assert np.count_nonzero(merged.data == OCCUPIED) == np.count_nonzero(data == OCCUPIED)
