from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from zsched.tasks.map_merge.geometry import Pose2
from zsched.tasks.map_merge.grid import FREE, OCCUPIED, UNKNOWN, Cells, Grid
from zsched_lab.explore.body import Limits, Twist
from zsched_lab.explore.explorer import AVOID_M, AVOID_S, CLAIM_LIFE_S, Explorer, State, avoid_s
from zsched_lab.explore.frontier import Claim, Frontier, choose, find_frontiers
from zsched_lab.explore.planner import INFLATION_M, distances, plan_map, way_to

SIDE = 0.05


def room(width_m: float = 6.0, height_m: float = 4.0) -> Cells:
    """A closed and wholly known room, from the origin on."""
    data: Cells = np.full((round(height_m / SIDE), round(width_m / SIDE)), FREE, dtype=np.int8)
    data[:2, :] = data[-2:, :] = OCCUPIED
    data[:, :2] = data[:, -2:] = OCCUPIED
    return data


def grid_of(data: Cells, origin: Pose2 | None = None) -> Grid:
    return Grid(data=data, resolution=SIDE, origin=origin or Pose2())


def open_to_the_right() -> Cells:
    """A room whose right third nobody has seen."""
    data = room()
    data[:, 80:] = UNKNOWN
    return data


def open_on_both_sides() -> Cells:
    data = room(12.0)
    data[:, :60] = data[:, -60:] = UNKNOWN
    return data


# --- ways ------------------------------------------------------------------------------------------------------------


def test_distance_is_the_way_round_a_wall() -> None:
    data = room()
    data[:60, 58:62] = OCCUPIED  # open above 3 m
    plan = plan_map(grid_of(data))
    field = distances(plan, (1.0, 1.0))
    goal = plan.cell((5.0, 1.0))
    shortest = 2 * math.dist((1.0, 1.0), (2.8, 3.2)) + 0.6
    assert field[plan.cell((1.0, 3.0))] == pytest.approx(2.0, abs=0.2)
    assert 0.88 * shortest < float(field[goal]) < 1.15 * shortest
    way = way_to(plan, field, goal)
    assert math.dist(way[0], (1.0, 1.0)) < 0.15
    assert math.dist(way[-1], (5.0, 1.0)) < 0.15
    assert sum(math.dist(a, b) for a, b in itertools.pairwise(way)) < 1.1 * shortest
    walls = grid_of(data).points(grid_of(data).occupied)
    line = [
        (a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]))
        for a, b in itertools.pairwise(way)
        for share in np.linspace(0.0, 1.0, 20).tolist()
    ]
    nearest = min(float(np.hypot(walls[:, 0] - x, walls[:, 1] - y).min()) for x, y in line)
    assert nearest > INFLATION_M - 0.05


def test_no_way_leads_through_a_wall_or_over_unknown_cells() -> None:
    for between in (OCCUPIED, UNKNOWN):
        data = room()
        data[:, 58:62] = between
        plan = plan_map(grid_of(data))
        field = distances(plan, (1.0, 1.0))
        assert not math.isfinite(float(field[plan.cell((5.0, 1.0))]))
        assert way_to(plan, field, plan.cell((5.0, 1.0))) == ()


def test_a_robot_beside_a_wall_finds_its_way_out_and_one_far_off_the_map_does_not() -> None:
    plan = plan_map(grid_of(room()))
    assert math.isfinite(float(distances(plan, (0.15, 2.0))[plan.cell((3.0, 2.0))]))
    assert not np.isfinite(distances(plan, (-9.0, 2.0))).any()


def test_a_turned_map_is_planned_on_in_its_own_frame() -> None:
    turned = Pose2(x=3.0, y=-2.0, yaw=0.7)
    straight, plan = plan_map(grid_of(room())), plan_map(grid_of(room(), turned))
    start, goal = turned.apply_point(1.03, 1.03), turned.apply_point(5.03, 3.03)
    there = float(distances(plan, start)[plan.cell(goal)])
    assert there == float(distances(straight, (1.03, 1.03))[straight.cell((5.03, 3.03))])
    end = way_to(plan, distances(plan, start), plan.cell(goal))[-1]
    assert math.dist(end, goal) < 0.15


# --- frontiers -------------------------------------------------------------------------------------------------------


def test_a_room_that_is_known_has_no_frontier() -> None:
    plan = plan_map(grid_of(room()))
    assert find_frontiers(plan, distances(plan, (1.0, 1.0))) == []


def test_the_border_to_the_unknown_is_a_frontier_with_its_way_and_gain() -> None:
    plan = plan_map(grid_of(open_to_the_right()))
    found = find_frontiers(plan, distances(plan, (1.0, 2.0)))
    assert found
    for one in found:
        assert one.point[0] == pytest.approx(3.95, abs=0.15)
        assert one.way_m == pytest.approx(math.dist((1.0, 2.0), one.point), rel=0.15, abs=0.2)
        assert 1.0 < one.gain_m2 < 7.0
        assert plan.drivable[one.cell]


def test_what_lies_behind_a_wall_is_no_gain() -> None:
    data = np.full((80, 240), UNKNOWN, dtype=np.int8)
    data[:, :120] = room()
    data[30:45, 100:118] = UNKNOWN  # a dark corner at the wall, and wide unknown land behind the wall
    plan = plan_map(grid_of(data))
    found = find_frontiers(plan, distances(plan, (1.0, 2.0)))
    assert found
    assert max(one.gain_m2 for one in found) <= 0.75 * 0.9 + 0.1


def frontier(x: float, way_m: float, gain_m2: float = 3.0) -> Frontier:
    return Frontier(cell=(0, 0), point=(x, 0.0), gain_m2=gain_m2, way_m=way_m)


def test_near_and_rich_goals_come_first_and_the_present_one_is_kept() -> None:
    near, far, rich = frontier(0.0, 2.0), frontier(10.0, 4.0), frontier(20.0, 4.0, gain_m2=9.0)
    assert choose("robot1", [near, far], (), None, ()) is near
    assert choose("robot1", [near, far, rich], (), None, ()) is rich
    slightly = frontier(10.0, 3.0)
    assert choose("robot1", [near, slightly], (), (10.0, 0.0), ()) is slightly
    assert choose("robot1", [near, far], (), None, [(0.1, 0.0)]) is far
    assert choose("robot1", [], (), None, ()) is None


def test_a_claimed_goal_is_left_to_who_is_nearer() -> None:
    near, far = frontier(0.0, 2.0), frontier(10.0, 6.0)
    closer = Claim(robot="robot2", x=0.3, y=0.0, way_m=1.0)
    farther = Claim(robot="robot2", x=0.3, y=0.0, way_m=3.0)
    assert choose("robot1", [near, far], [closer], None, ()) is far
    assert choose("robot1", [near, far], [farther], None, ()) is near


# --- the explorer ----------------------------------------------------------------------------------------------------


def explorer(data: Cells | None) -> Explorer:
    one = Explorer("robot1", Limits())
    one.take_transform(Pose2())
    if data is not None:
        one.take_map(grid_of(data))
    return one


def test_without_a_merged_map_or_a_place_in_it_the_robot_stands() -> None:
    one = explorer(None)
    assert one.step(Pose2(x=1.0, y=2.0), 0.0).speed == 0.0
    assert (one.state, one.claim) == (State.WAITING, None)
    unplaced = Explorer("robot1", Limits())
    unplaced.take_map(grid_of(open_to_the_right()))
    twist = unplaced.step(Pose2(x=1.0, y=2.0), 0.0)
    assert (twist.speed, twist.turn, unplaced.state) == (0.0, 0.0, State.WAITING)


def test_it_drives_to_the_frontier_and_claims_it() -> None:
    one = explorer(open_to_the_right())
    twist = one.step(Pose2(x=1.0, y=2.0), 0.0)
    assert one.state is State.DRIVING
    assert twist.speed > 0.0
    assert one.claim is not None
    assert one.claim.x == pytest.approx(3.95, abs=0.15)


def test_its_own_pose_is_taken_through_the_mergers_transform() -> None:
    one = explorer(open_to_the_right())
    one.take_transform(Pose2(x=1.0, y=2.0, yaw=math.pi))  # the robot looks away from the frontier
    twist = one.step(Pose2(), 0.0)
    assert twist.speed == 0.0
    assert abs(twist.turn) > 1.0


def test_a_first_drive_is_driven_straight_and_then_it_chooses_by_itself() -> None:
    one = Explorer("robot1", Limits(), first=(2.0, 0.0))
    assert one.step(Pose2(x=1.0), 0.0).speed == 0.0, "not before it has a map"
    one.take_transform(Pose2(x=3.0, y=2.0, yaw=math.pi))  # the frontier is behind it
    one.take_map(grid_of(open_to_the_right()))
    assert list(one.way[0]) == pytest.approx([1.0, 2.0]), "in the merged frame"

    assert one.step(Pose2(x=1.0), 0.0) == Twist(speed=Limits().speed)
    assert (one.claim, one.goals) == (None, 0)
    one.step(Pose2(x=1.7), 1.0)

    assert one.state is State.DRIVING
    assert one.claim is not None
    assert one.way[-1][0] > 2.0


def test_a_wholly_known_map_leaves_it_idle() -> None:
    one = explorer(room())
    assert one.step(Pose2(x=1.0, y=2.0), 0.0).speed == 0.0
    assert (one.state, one.claim) == (State.IDLE, None)


def test_on_a_map_that_does_not_change_it_stands_where_it_has_been_and_tries_again_later() -> None:
    """The same map comes again and again: that is what a stale merger looks like from here."""
    one = explorer(open_to_the_right())
    one.step(Pose2(x=1.0, y=2.0), 0.0)
    goal = one.goal
    assert goal is not None
    seen: dict[State, float] = {}
    now = 0.0
    while now < AVOID_S - 1.0:
        now += 0.1
        one.take_map(grid_of(open_to_the_right()))
        one.step(Pose2(x=3.8, y=one.goal[1] if one.goal else 2.0), now)
        seen[one.state] = now
    assert State.IDLE in seen
    while one.state is State.IDLE:
        now += 0.1
        one.step(Pose2(x=3.8, y=2.0), now)
        assert now < 3 * AVOID_S, "it never tried again"


@pytest.mark.parametrize("speed", [1.0, 0.22])
def test_a_slow_robot_avoids_for_as_long_as_it_needs_to_get_away(speed: float) -> None:
    slow_s = avoid_s(Limits(speed=speed))
    one = Explorer("robot1", Limits(speed=speed), slow_s)
    one.take_transform(Pose2())
    one.take_map(grid_of(open_to_the_right()))
    one.step(Pose2(x=1.0, y=2.0), 0.0)
    one.step(Pose2(x=1.0, y=2.0), 1.0, is_blocked=True)
    idle_until, now = 0.0, 1.0
    while now < 60.0:
        now += 0.5
        one.look_again()
        one.step(Pose2(x=3.8, y=one.goal[1] if one.goal else 2.0), now)
        if one.state is State.IDLE:
            idle_until = now
            if now > slow_s + 2.0:
                break
        elif idle_until:
            break
    assert idle_until == pytest.approx(1.0 + slow_s, abs=3.0)
    assert slow_s * speed >= AVOID_M


def test_it_backs_off_a_wall_and_takes_another_goal() -> None:
    one = explorer(open_on_both_sides())
    at = Pose2(x=5.0, y=2.0)
    one.step(at, 0.0)
    first = one.goal
    assert one.step(at, 0.1, is_blocked=True).speed < 0.0
    for tick in range(2, 20):
        one.step(at, tick / 10)
    assert first is not None
    assert one.goal is not None
    assert math.dist(first, one.goal) > 1.0


@pytest.mark.parametrize("gap_m", [0.1, 0.3, 0.5])
def test_two_that_plan_in_step_do_not_swap_goals_for_ever(gap_m: float) -> None:
    """Both went to one place, both gave way, both came back: twice a second, and neither got anywhere."""
    poses = {"robot1": Pose2(x=5.9, y=2.0), "robot2": Pose2(x=5.9, y=2.0 + gap_m)}
    robots = {name: Explorer(name, Limits()) for name in poses}
    for round_number in range(12):
        now = round_number * 0.5
        for name, one in robots.items():
            one.take_transform(Pose2())
            one.take_map(grid_of(open_on_both_sides()))
            one.step(poses[name], now)
        claims = [one.claim for one in robots.values() if one.claim is not None]
        for one in robots.values():
            for claim in claims:
                one.hear_claim(claim.robot, claim, now)

    assert max(one.goals for one in robots.values()) <= 2
    left, right = sorted(one.goal for one in robots.values() if one.goal is not None)
    assert math.dist(left, right) > 3.0, "one to each side"


def test_anothers_claim_sends_it_to_the_other_side_and_expires() -> None:
    at = Pose2(x=5.0, y=2.0)
    alone = explorer(open_on_both_sides())
    alone.step(at, 0.0)
    assert alone.goal is not None
    assert alone.goal[0] < 6.0
    together = explorer(open_on_both_sides())
    claims = [Claim(robot=f"robot{2 + i}", x=3.05, y=y, way_m=0.5) for i, y in enumerate((0.7, 2.0, 3.3))]
    for claim in claims:
        together.hear_claim(claim.robot, claim, 0.0)
    together.step(at, 0.0)
    assert together.goal is not None
    assert together.goal[0] > 6.0
    late = explorer(open_on_both_sides())
    for claim in claims:
        late.hear_claim(claim.robot, claim, 0.0)
    late.step(at, CLAIM_LIFE_S + 0.1)
    assert late.goal is not None
    assert late.goal[0] < 6.0
    dropped = explorer(open_on_both_sides())
    for claim in claims:
        dropped.hear_claim(claim.robot, claim, 0.0)
        dropped.hear_claim(claim.robot, None, 0.0)
    dropped.step(at, 0.1)
    assert dropped.goal is not None
    assert dropped.goal[0] < 6.0
