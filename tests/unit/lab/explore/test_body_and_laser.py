from __future__ import annotations

import math

import numpy as np
import pytest

from zsched.tasks.map_merge.geometry import Pose2
from zsched_lab.explore.body import LONGEST_S, RADIUS_M, Body, Drift, Limits, Twist
from zsched_lab.explore.laser import BEAMS, RANGE_M, Laser
from zsched_lab.explore.world import World, make_world

NO_DRIFT = Drift(yaw=0.0, way=0.0)


@pytest.fixture(scope="module")
def hall() -> World:
    """10 m x 4 m of nothing."""
    return make_world("hall", np.zeros((80, 200), dtype=np.bool_), 0.05, (0.0, 0.0), (2.0, 2.0))


def body(world: World, start: Pose2, drift: Drift = NO_DRIFT, seed: int = 1) -> Body:
    return Body(world, start, Limits(speed=0.5, turn=1.0), drift, np.random.default_rng(seed))


def drive(one: Body, twist: Twist, seconds: float) -> None:
    for _ in range(round(seconds / 0.1)):
        one.move(twist, 0.1)


def test_it_drives_straight_and_turns_on_the_spot_within_its_limits(hall: World) -> None:
    one = body(hall, Pose2(x=1.0, y=2.0))
    drive(one, Twist(speed=9.0), 4.0)
    assert (one.pose.x, one.pose.y) == pytest.approx((3.0, 2.0))
    drive(one, Twist(turn=9.0), 1.0)
    assert (one.pose.x, one.pose.y, one.pose.yaw) == pytest.approx((3.0, 2.0, 1.0))
    assert one.way_m == pytest.approx(2.0)


def test_a_wall_stops_the_way_but_not_the_turn(hall: World) -> None:
    one = body(hall, Pose2(x=9.0, y=2.0))
    drive(one, Twist(speed=0.5), 5.0)
    assert one.is_blocked
    assert 0.0 <= hall.room_m(one.pose.x, one.pose.y) - RADIUS_M < 0.06
    stood = one.pose
    drive(one, Twist(turn=1.0), 1.0)
    assert (one.pose.x, one.pose.y) == (stood.x, stood.y)
    assert one.pose.yaw == pytest.approx(1.0)
    drive(one, Twist(turn=-1.0), 1.0)
    drive(one, Twist(speed=-0.5), 1.0)
    assert one.pose.x == pytest.approx(stood.x - 0.5)
    assert one.is_blocked is False


def test_a_robot_that_was_held_up_does_not_jump(hall: World) -> None:
    one = body(hall, Pose2(x=1.0, y=2.0))
    one.move(Twist(speed=0.5), 60.0)
    assert one.pose.x - 1.0 == pytest.approx(0.5 * LONGEST_S)


def test_without_drift_belief_is_the_truth_seen_from_the_start(hall: World) -> None:
    start = Pose2(x=3.0, y=2.0, yaw=2.0)
    one = body(hall, start)
    drive(one, Twist(speed=0.3, turn=0.5), 6.0)
    believed = start.compose(one.belief)
    assert (believed.x, believed.y, believed.yaw) == pytest.approx((one.pose.x, one.pose.y, one.pose.yaw))


def test_drift_grows_with_the_root_of_the_way_and_follows_the_seed(hall: World) -> None:
    def off(seed: int, seconds: float) -> float:
        one = body(hall, Pose2(x=5.0, y=1.5), Drift(yaw=0.0, way=0.05), seed)
        drive(one, Twist(speed=0.5, turn=1.0), seconds)
        believed = Pose2(x=5.0, y=1.5).compose(one.belief)
        return math.dist((believed.x, believed.y), (one.pose.x, one.pose.y))

    assert off(1, 10.0) == off(1, 10.0)
    assert off(1, 10.0) != off(2, 10.0)
    short = np.sqrt(np.mean([off(seed, 10.0) ** 2 for seed in range(20)]))
    long = np.sqrt(np.mean([off(seed, 40.0) ** 2 for seed in range(20)]))
    assert 1.4 < long / short < 2.8  # the root of four, by 20 samples


def test_beams_measure_the_walls_of_a_hall(hall: World) -> None:
    laser = Laser(hall, np.random.default_rng(1), noise_m=0.0)
    scan = laser.scan(Pose2(x=2.0, y=1.0, yaw=math.pi / 2))
    degree = BEAMS // 360
    assert scan.ranges.size == BEAMS
    assert scan.ranges[0] == pytest.approx(3.0, abs=0.03)  # ahead is +y
    assert scan.ranges[90 * degree] == pytest.approx(2.0, abs=0.03)  # left is -x
    assert scan.ranges[180 * degree] == pytest.approx(1.0, abs=0.03)
    assert not scan.echo[270 * degree]  # right is +x: 8 m
    assert scan.ranges[270 * degree] == RANGE_M
    slanted = scan.ranges[150 * degree]
    assert slanted == pytest.approx(1.0 / math.cos(math.radians(30.0)), abs=0.04)
