from __future__ import annotations

import numpy as np

from zsched.tasks.map_merge.geometry import Pose2
from zsched.tasks.map_merge.grid import Grid
from zsched_lab.explore.laser import Laser, LaserScan
from zsched_lab.explore.mapper import ScanMapper
from zsched_lab.explore.referee import Referee
from zsched_lab.explore.world import World, make_world
from zsched_lab.explore.worlds import load_world
from zsched_lab.maps.metrics import score_map


def drive_through(world: World, stops: list[Pose2], noise_m: float = 0.01) -> Grid:
    laser, mapper = Laser(world, np.random.default_rng(3), noise_m=noise_m), ScanMapper()
    for stop in stops:
        for _ in range(4):
            mapper.add(stop, laser.scan(stop))
    return mapper.grid()


def test_a_drive_round_the_turtlebot3_world_gives_its_map() -> None:
    world = load_world("turtlebot3")
    ring = [(-1.9, 0.0), (-1.5, 1.5), (-0.5, 1.7), (0.5, 1.7), (1.6, 1.0), (1.6, -1.0), (0.5, -1.7), (-1.5, -1.5)]
    ring += [(-0.5, 0.5), (0.5, 0.5), (0.5, -0.5), (-0.5, -0.5)]
    grid = drive_through(world, [Pose2(x=x, y=y, yaw=0.3 * i) for i, (x, y) in enumerate(ring)])
    score = score_map(grid, world.truth())
    assert score.coverage > 0.97
    assert score.wall_f1 > 0.95


def test_nothing_is_free_beyond_a_wall() -> None:
    """One room of two; the other one stays unknown, whatever the angle."""
    solid = np.zeros((60, 121), dtype=np.bool_)
    solid[:, 60] = True
    world = make_world("two rooms", solid, 0.05, (0.0, 0.0), (1.5, 1.5))
    stops = [Pose2(x=2.8, y=y, yaw=y) for y in np.linspace(0.3, 2.7, 12).tolist()]
    grid = drive_through(world, stops)
    free_x = grid.points(grid.free)[:, 0]
    assert free_x.max() < 3.05
    assert Referee(world).coverage(grid) > 0.95


def test_a_beam_without_echo_clears_its_way_and_builds_no_wall() -> None:
    mapper = ScanMapper()
    nothing = LaserScan(ranges=np.full(360, 3.5, dtype=np.float32), echo=np.zeros(360, dtype=np.bool_))
    mapper.add(Pose2(), nothing)
    grid = mapper.grid()
    assert not grid.occupied.any()
    assert grid.known_area_m2 == np.pi * 3.5**2 or abs(grid.known_area_m2 / (np.pi * 3.5**2) - 1.0) < 0.03


def test_a_growing_map_keeps_every_cell_where_it_was() -> None:
    world = load_world("office:1")
    laser, mapper = Laser(world, np.random.default_rng(3)), ScanMapper()
    start = world.starts(1)[0]
    mapper.add(start, laser.scan(start))
    before = mapper.grid()
    away = Pose2(x=start.x - 40.0, y=start.y + 40.0)  # the mapper does not know that nobody drives there
    mapper.add(away, LaserScan(ranges=np.full(360, 1.0, dtype=np.float32), echo=np.ones(360, dtype=np.bool_)))
    after = mapper.grid()
    for x, y in before.points(before.occupied)[::7].tolist():
        row, column = int((y - after.origin.y) / 0.05), int((x - after.origin.x) / 0.05)
        assert after.data[row, column] == 100


def test_before_the_first_scan_there_is_one_unknown_cell() -> None:
    grid = ScanMapper(frame_id="robot1/map").grid(stamp_ns=7)
    assert (grid.data.tolist(), grid.stamp_ns, grid.frame_id) == ([[-1]], 7, "robot1/map")


def test_the_referee_says_what_the_metrics_say() -> None:
    world = load_world("turtlebot3")
    grid = drive_through(world, [Pose2(x=-1.9, y=0.0), Pose2(x=-0.5, y=0.5)])
    shift = Pose2(x=1.0, y=-2.0, yaw=0.4)
    exact = score_map(grid, world.truth()).coverage
    assert 0.2 < exact < 0.9
    assert abs(Referee(world).coverage(grid) - exact) < 0.01
    moved = Grid(data=grid.data, resolution=grid.resolution, origin=shift.inverse().compose(grid.origin))
    assert abs(Referee(world).coverage(moved, shift) - exact) < 0.01
    assert Referee(world).coverage(moved) < exact - 0.1
