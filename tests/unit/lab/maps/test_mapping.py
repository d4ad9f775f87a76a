"""The grid mapper: where rays end, what they clear, frames, growth."""

from __future__ import annotations

import math

import numpy as np
import pytest

from zsched.tasks.map_merge.geometry import Pose2
from zsched.tasks.map_merge.grid import Grid
from zsched_lab.maps.laser_log import Scan, load_log, malaga_path
from zsched_lab.maps.mapping import GridMapper, displacements, map_scans, truth_grid


def _scan(pose: Pose2, *beams: tuple[float, float]) -> Scan:
    angles = np.array([angle for angle, _ in beams], dtype=np.float64)
    ranges = np.array([distance for _, distance in beams], dtype=np.float64)
    return Scan(t_s=0.0, pose=pose, angles=angles, ranges=ranges)


def _at(grid: Grid, x: float, y: float) -> int:
    column = math.floor((x - grid.origin.x) / grid.resolution + 1e-9)
    row = math.floor((y - grid.origin.y) / grid.resolution + 1e-9)
    inside = 0 <= row < grid.height and 0 <= column < grid.width
    return int(grid.data[row, column]) if inside else -1


def test_ray_clears_its_way_and_marks_its_end() -> None:
    grid = map_scans([_scan(Pose2(x=0.01, y=0.01), (0.0, 2.0))])
    assert _at(grid, 2.01, 0.01) == 100
    assert all(_at(grid, x, 0.01) == 0 for x in np.arange(0.02, 1.98, 0.05))
    assert _at(grid, 2.1, 0.01) == -1
    assert _at(grid, 1.0, 0.2) == -1


def test_heading_and_beam_angle_add_up() -> None:
    grid = map_scans([_scan(Pose2(x=1.02, y=2.02, yaw=math.pi / 2), (math.pi / 2, 1.0))])
    assert _at(grid, 0.02, 2.02) == 100


def test_cell_counts_once_per_scan() -> None:
    """Two beams through one cell are one miss (-0.4): a hit (+0.85) before it leaves it between free and occupied."""
    wall = _scan(Pose2(x=0.01, y=0.01), (0.0, 1.0))
    beyond = _scan(Pose2(x=0.01, y=0.01), (0.0, 3.0), (0.001, 3.0))
    grid = map_scans([wall, beyond])
    assert _at(grid, 1.01, 0.01) == -1
    assert _at(map_scans([wall, beyond, beyond, beyond]), 1.01, 0.01) == 0


def test_end_cell_of_one_beam_is_not_cleared_by_another_of_the_same_scan() -> None:
    grid = map_scans([_scan(Pose2(x=0.01, y=0.01), (0.0, 1.0), (0.0, 2.0))])
    assert _at(grid, 1.01, 0.01) == 100


def test_evidence_is_clipped_so_that_a_moved_wall_is_forgotten() -> None:
    wall, gone = _scan(Pose2(x=0.01, y=0.01), (0.0, 1.0)), _scan(Pose2(x=0.01, y=0.01), (0.0, 3.0))
    assert _at(map_scans([wall] * 100 + [gone] * 14), 1.01, 0.01) == 0


def test_map_grows_and_cells_stay() -> None:
    mapper = GridMapper(frame_id="robot1/map")
    assert mapper.grid().data.tolist() == [[-1]]
    mapper.add(_scan(Pose2(x=0.01, y=0.01), (0.0, 2.0)))
    mapper.add(_scan(Pose2(x=-30.02, y=25.02), (math.pi, 2.0)))
    grid = mapper.grid(stamp_ns=5)
    assert (grid.stamp_ns, grid.frame_id) == (5, "robot1/map")
    assert _at(grid, 2.01, 0.01) == 100
    assert _at(grid, -32.02, 25.02) == 100
    assert grid.origin.x / 0.05 == pytest.approx(round(grid.origin.x / 0.05))


def test_scan_without_echo_changes_nothing() -> None:
    mapper = GridMapper()
    mapper.add(_scan(Pose2(x=100.0)))
    assert mapper.grid().data.size == 1


def test_displaced_frame_sees_the_same_world_elsewhere() -> None:
    displacement = Pose2(x=3.0, y=-1.0, yaw=0.7)
    grid = map_scans([_scan(Pose2(x=0.01, y=0.01), (0.0, 2.0))], displacement=displacement)
    (end,) = grid.points(grid.occupied)
    assert displacement.apply_point(*end) == pytest.approx((2.01, 0.01), abs=0.05)


def test_displacements_are_seeded_and_bounded() -> None:
    assert displacements(3, 7) == displacements(3, 7)
    assert displacements(3, 7) != displacements(3, 8)
    for pose in displacements(20, 1):
        assert max(abs(pose.x), abs(pose.y)) <= 5.0
        assert abs(pose.yaw) <= math.pi


def test_truth_of_the_shipped_log_is_a_map() -> None:
    grid = truth_grid(load_log(malaga_path()))
    assert 800 < grid.known_area_m2 < 2000
    assert 3000 < np.count_nonzero(grid.occupied) < 20000
