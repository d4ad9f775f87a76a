"""Robots that SLAM and navigation elsewhere lead: what they believe, when they stand, which way they follow."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zsched.core.values.errors import WireError
from zsched.tasks.map_merge.geometry import Pose2
from zsched_lab.explore.agent import Agent, RobotSettings
from zsched_lab.explore.body import Limits
from zsched_lab.explore.follower import BACK_S, Follower
from zsched_lab.explore.localizer import KEPT, LOST_S, Localizer
from zsched_lab.explore.messages import (
    Correction,
    decode_correction,
    decode_way,
    encode_correction,
    encode_way,
)
from zsched_lab.explore.navigate import SAVED_S, Budget
from zsched_lab.explore.world import World
from zsched_lab.explore.worlds import load_world

SECOND_NS = 1_000_000_000


@pytest.fixture(scope="module")
def world() -> World:
    return load_world("office:3")


# --- belief ----------------------------------------------------------------------------------------------------------


def test_a_correction_says_where_the_robot_was_and_odometry_what_came_since() -> None:
    localizer = Localizer()
    localizer.note(1, Pose2(x=1.0))
    assert localizer.belief(Pose2(x=1.5)) == Pose2(x=1.5)

    assert localizer.take(1, Pose2(x=1.0, y=2.0, yaw=math.pi / 2))

    belief = localizer.belief(Pose2(x=1.5))  # half a metre ahead of where it was, which is along y
    assert belief.x == pytest.approx(1.0)
    assert belief.y == pytest.approx(2.5)


def test_corrections_of_unknown_or_older_scans_count_for_nothing() -> None:
    localizer = Localizer()
    for stamp in range(1, KEPT + 10):
        localizer.note(stamp, Pose2())
    assert not localizer.take(1, Pose2(x=9.0))  # long forgotten
    assert localizer.take(KEPT, Pose2(x=1.0))
    assert not localizer.take(KEPT - 1, Pose2(x=9.0))
    assert not localizer.take(KEPT, Pose2(x=9.0))
    assert localizer.belief(Pose2()).x == 1.0


def test_a_robot_is_lost_before_the_first_correction_and_a_second_behind_the_last() -> None:
    localizer = Localizer()
    localizer.note(5 * SECOND_NS, Pose2())
    assert localizer.age_s(5 * SECOND_NS) is None
    assert localizer.is_lost(5 * SECOND_NS)
    localizer.take(5 * SECOND_NS, Pose2())
    assert not localizer.is_lost(round((5.0 + LOST_S) * SECOND_NS))
    assert localizer.is_lost(round((5.0 + LOST_S) * SECOND_NS) + 1)


def led_agent(world: World, hold_until_s: float | None = None) -> Agent:
    settings = RobotSettings(
        robot="robot1", start=world.starts(1)[0], has_slam=False, is_led=True, hold_until_s=hold_until_s
    )
    return Agent(settings, world)


def run(agent: Agent, start_s: float, seconds: float, *, is_corrected: bool) -> int:
    """Step ten times a second; corrections come at once, and say what odometry does. Returns the number of scans."""
    scans = 0
    for tick in range(round(seconds * 10)):
        now = start_s + tick / 10
        stamp_ns = round(now * SECOND_NS)
        scan = agent.step(now, stamp_ns).scan
        if scan is not None:
            scans += 1
            if is_corrected:
                agent.localizer.take(stamp_ns, agent.body.belief)
    return scans


def test_a_led_robot_drives_along_its_way_and_stands_a_second_after_the_last_correction(world: World) -> None:
    agent = led_agent(world)
    agent.follower.take_way(((1.0, 0.0), (30.0, 0.0)))
    run(agent, 0.0, 3.0, is_corrected=True)
    driven = agent.body.way_m
    assert driven > 0.5

    run(agent, 3.0, 5.0, is_corrected=False)
    stood = agent.body.way_m

    assert stood - driven < (LOST_S + 0.3) * agent.settings.limits.speed
    assert agent.stopped_s == pytest.approx(4.0, abs=0.35)
    run(agent, 8.0, 2.0, is_corrected=True)
    assert agent.body.way_m > stood + 0.3


def test_its_laser_looks_at_5_hz_also_while_it_stands(world: World) -> None:
    assert run(led_agent(world), 0.0, 4.0, is_corrected=False) == pytest.approx(20, abs=1)


def test_a_robot_that_is_held_stands_and_looks_and_that_is_no_stop(world: World) -> None:
    agent = led_agent(world, hold_until_s=2.0)
    agent.follower.take_way(((30.0, 0.0),))
    scans = run(agent, 0.0, 2.0, is_corrected=True)
    assert (agent.body.way_m, agent.stopped_s) == (0.0, 0.0)
    assert scans >= 9
    run(agent, 2.0, 1.0, is_corrected=True)
    assert agent.body.way_m > 0.1


# --- the way ---------------------------------------------------------------------------------------------------------


def test_a_follower_takes_corner_after_corner_and_stands_at_the_end() -> None:
    follower, here = Follower(Limits(speed=0.5)), Pose2()
    follower.take_way(((1.0, 0.0), (1.0, 1.0)))
    passed = []
    for tick in range(200):
        twist = follower.step(here, tick / 10)
        passed.append((round(here.x, 1), round(here.y, 1)))
        turned = Pose2(x=twist.speed * 0.1, yaw=twist.turn * 0.1)
        here = here.compose(turned)
    assert math.dist((here.x, here.y), (1.0, 1.0)) < 0.2
    assert any(math.dist(point, (1.0, 0.0)) < 0.2 for point in passed)
    assert follower.step(here, 99.0) == follower.step(here, 99.1)
    assert follower.step(here, 99.0).speed == 0.0


def test_the_same_way_told_again_is_gone_on_with() -> None:
    follower = Follower(Limits())
    way = ((1.0, 0.0), (1.0, 5.0))
    follower.take_way(way)
    follower.step(Pose2(x=0.95), 0.0)
    follower.take_way(way)
    assert follower.step(Pose2(x=1.0, y=0.5, yaw=math.pi / 2), 0.1).speed > 0.0
    follower.take_way(())
    assert follower.step(Pose2(), 0.2).speed == 0.0


def test_a_wall_is_left_backwards_for_a_moment() -> None:
    follower = Follower(Limits())
    follower.take_way(((5.0, 0.0),))
    assert follower.step(Pose2(), 1.0, is_blocked=True).speed < 0.0
    assert follower.step(Pose2(), 1.0 + BACK_S - 0.01).speed < 0.0
    assert follower.step(Pose2(), 1.0 + BACK_S).speed > 0.0


# --- messages --------------------------------------------------------------------------------------------------------


def test_corrections_and_ways_come_back_as_they_were() -> None:
    correction = Correction(stamp_ns=7, pose=Pose2(x=1.5, y=-2.0, yaw=0.3), fit=0.75)
    assert decode_correction(encode_correction(correction)) == correction
    assert decode_way(encode_way(7, [(1.0, 2.0), (3.5, -4.25)])) == ((1.0, 2.0), (3.5, -4.25))
    assert decode_way(encode_way(7, [])) == ()


@given(st.binary(max_size=80))
def test_any_bytes_are_a_message_or_refused(payload: bytes) -> None:
    for decode in (decode_correction, decode_way):
        try:
            decode(payload)
        except WireError:
            continue


# --- how often navigation looks again --------------------------------------------------------------------------------


def test_a_budget_allows_its_share_and_saves_little_up() -> None:
    budget, spent_s, allowed = Budget(0.1), 0.0, 0
    for tick in range(1, 1001):
        if budget.allows(tick * 0.05, spent_s):
            spent_s += 0.02  # what one look costs
            allowed += 1
    assert allowed * 0.02 == pytest.approx(0.1 * 50.0, rel=0.05)

    idle = Budget(0.1)
    idle.allows(0.0, 0.0)
    idle.allows(100.0, 0.0)  # nothing was used for 100 s, which is not made up
    spent_s = 0.0
    while idle.allows(100.0, spent_s):
        spent_s += 0.02
    assert spent_s <= 0.1 * SAVED_S + 0.02
    assert not Budget(0.0).allows(5.0, 0.0)
