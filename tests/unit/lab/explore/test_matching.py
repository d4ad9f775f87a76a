"""Scan matching on simulated scans: it takes odometry's drift away, spends the CPU that it is given, and says nothing
where there is nothing to see."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest

from zsched.core.values.errors import WireError
from zsched.tasks.map_merge.geometry import Pose2
from zsched_lab.explore.body import Body, Drift, Limits, Twist
from zsched_lab.explore.laser import Laser, LaserScan
from zsched_lab.explore.mapper import ScanMapper
from zsched_lab.explore.matching import LEAST_ROUNDS, ROUND, ScanMatcher
from zsched_lab.explore.slam_state import Slam, SlamSettings
from zsched_lab.explore.world import World
from zsched_lab.explore.worlds import load_world
from zsched_lab.paper.robots import ODOMETRY

SECONDS = 40


@pytest.fixture(scope="module")
def world() -> World:
    return load_world("office:3")


def drive(world: World, seconds: float, seed: int = 5) -> Iterator[tuple[LaserScan, Pose2, Pose2]]:
    """(scan, odometry, true pose in the map frame) five times a second: to and fro, turning, as a robot does."""
    start = world.starts(1)[0]
    body = Body(world, start, Limits(speed=0.5), ODOMETRY, np.random.default_rng(seed))
    laser = Laser(world, np.random.default_rng(seed + 1))
    for number in range(round(seconds * 5)):
        yield laser.scan(body.pose, number + 1), body.belief, start.inverse().compose(body.pose)
        turn = 1.2 if body.is_blocked or number % 40 > 30 else 0.0
        body.move(Twist(speed=-0.2 if body.is_blocked else 0.4, turn=turn), 0.2)


@pytest.fixture(scope="module")
def begun(world: World) -> Slam:
    """One that has seen a second; tests leave it as it is."""
    slam = Slam(SlamSettings(robot="robot1"))
    for scan, odometry, _ in drive(world, 1.0):
        slam.take(scan, odometry)
    return slam


def apart(a: Pose2, b: Pose2) -> float:
    return math.dist((a.x, a.y), (b.x, b.y))


def test_matching_takes_the_drift_of_odometry_away(world: World) -> None:
    slam = Slam(SlamSettings(robot="robot1"))
    odometry_error = pose_error = 0.0

    for scan, odometry, true in drive(world, SECONDS, seed=10):
        correction = slam.take(scan, odometry)
        odometry_error = max(odometry_error, apart(odometry, true))
        pose_error = max(pose_error, apart(correction.pose, true))

    assert correction.stamp_ns == slam.scans == SECONDS * 5
    assert odometry_error > 0.15  # else there was nothing to correct
    assert pose_error < 0.1
    assert correction.fit > 0.5


class Clock:
    """A CPU clock on which every look takes a millisecond."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        self.now += 0.001
        return self.now


def test_a_match_spends_the_cpu_that_it_is_given_and_what_went_before_counts(world: World) -> None:
    scan, odometry, _ = next(drive(world, 1.0))
    mapper = ScanMapper()
    mapper.add(odometry, scan)

    def rounds(cpu_s: float, before_s: float = 0.0) -> int:
        clock = Clock()
        clock.now = before_s
        matcher = ScanMatcher(np.random.default_rng(1), cpu_s=cpu_s, spent_s=clock)
        searched = ScanMatcher(np.random.default_rng(1), cpu_s=0.0, spent_s=Clock()).match(mapper, scan, odometry)
        window = searched.hypotheses - LEAST_ROUNDS * ROUND
        return (matcher.match(mapper, scan, odometry, 0.0).hypotheses - window) // ROUND

    assert rounds(0.0) == LEAST_ROUNDS
    assert 45 <= rounds(0.050) <= 50
    assert 25 <= rounds(0.050, before_s=0.020) <= 30
    assert rounds(0.050, before_s=9.0) == LEAST_ROUNDS


def test_where_there_is_nothing_to_see_odometry_is_believed(world: World) -> None:
    scan, _, _ = next(drive(world, 1.0))
    blind = LaserScan(ranges=scan.ranges, echo=np.zeros_like(scan.echo))
    predicted = Pose2(x=0.3, y=-0.1, yaw=0.2)
    matcher, mapper = ScanMatcher(np.random.default_rng(1)), ScanMapper()

    of_no_map = matcher.match(mapper, scan, predicted)
    mapper.add(Pose2(), scan)
    of_no_echo = matcher.match(mapper, blind, predicted)

    assert (of_no_map.pose, of_no_map.hypotheses) == (predicted, 0)
    assert (of_no_echo.pose, of_no_echo.fit) == (predicted, 0.0)


def test_without_drift_matching_does_no_harm(world: World) -> None:
    start = world.starts(1)[0]
    body = Body(world, start, Limits(), Drift(yaw=0.0, way=0.0), np.random.default_rng(1))
    laser, slam = Laser(world, np.random.default_rng(2)), Slam(SlamSettings(robot="robot1"))
    for number in range(40):
        correction = slam.take(laser.scan(body.pose, number + 1), body.belief)
        body.move(Twist(speed=0.3, turn=0.3), 0.2)
        assert apart(correction.pose, body.belief) < 0.15
    assert apart(correction.pose, start.inverse().compose(body.pose)) < 0.15


# --- moving ----------------------------------------------------------------------------------------------------------


def test_a_slam_that_moves_goes_on_in_the_same_map(world: World) -> None:
    scans = list(drive(world, 20.0))
    settings = SlamSettings(robot="robot1")
    old, new, cold = Slam(settings), Slam(settings), Slam(settings)
    for scan, odometry, _ in scans[:60]:
        old.take(scan, odometry)
    before = old.due_map(0.0)

    new.restore(old.snapshot())
    after = new.due_map(0.0)

    assert before is not None
    assert after is not None
    assert (before.data == after.data).all()
    assert (before.origin, new.scans) == (after.origin, 60)
    for scan, odometry, _ in scans[60:]:
        moved, begun = new.take(scan, odometry), cold.take(scan, odometry)
    true = scans[-1][2]
    assert apart(moved.pose, true) < 0.1
    assert apart(begun.pose, true) > apart(moved.pose, true)  # it believes odometry's first word for ever
    assert new.scans == len(scans)


@pytest.mark.parametrize(
    "damage",
    [
        lambda _: b"",
        lambda state: state[:20],
        lambda state: b"XXXX" + state[4:],
        lambda state: state[:-40],
        lambda state: state.replace(b'"robot": "robot1"', b'"robot": "robot2"'),
        lambda state: state.replace(b'"resolution": 0.05', b'"resolution": 0.10'),
        lambda state: state.replace(b'"last": [[', b'"last": [[1e999,'),
        lambda state: state.replace(b'"box": [', b'"box": [-9'),
        lambda state: state.replace(b'"shape": [', b'"shape": [99999999'),
    ],
)
def test_a_damaged_state_is_refused_and_changes_nothing(begun: Slam, damage: object) -> None:
    assert callable(damage)
    kept = begun.snapshot()

    with pytest.raises(WireError):
        begun.restore(damage(kept))

    assert begun.snapshot() == kept


def test_a_slam_that_has_seen_nothing_moves_too() -> None:
    new = Slam(SlamSettings(robot="robot1"))
    new.restore(Slam(SlamSettings(robot="robot1")).snapshot())
    assert new.due_map(0.0) is None


def test_maps_are_due_by_their_period_and_a_late_one_is_not_made_up(world: World) -> None:
    slam = Slam(SlamSettings(robot="robot1", map_period_s=2.0))
    assert slam.due_map(0.0) is None
    scan, odometry, _ = next(drive(world, 1.0))
    slam.take(scan, odometry)
    due = [t_s for t_s in (0.0, 0.5, 1.9, 2.0, 2.1, 4.1, 9.0, 9.1, 11.0) if slam.due_map(t_s) is not None]
    assert due == [0.0, 2.0, 4.1, 9.0, 11.0]
