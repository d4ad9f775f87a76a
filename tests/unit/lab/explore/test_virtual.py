from __future__ import annotations

import pytest

from zsched_lab.explore.agent import MAP_PERIOD_S, Agent, RobotSettings
from zsched_lab.explore.virtual import VirtualResult, VirtualRun, run_virtual
from zsched_lab.explore.world import World
from zsched_lab.explore.worlds import load_world
from zsched_lab.maps.metrics import score_map

SEEDS = (1, 2, 3, 4, 5)
LATE_S = 5.0


@pytest.fixture(scope="module")
def world() -> World:
    return load_world("turtlebot3")


@pytest.fixture(scope="module")
def fresh(world: World) -> list[VirtualResult]:
    return [run_virtual(VirtualRun(world=world, seed=seed)) for seed in SEEDS]


def test_three_robots_explore_the_turtlebot3_world(world: World, fresh: list[VirtualResult]) -> None:
    for result in fresh:
        assert result.time_s is not None
        assert result.merged is not None
        assert [share for _, share in result.coverage] == sorted(share for _, share in result.coverage)
        assert set(result.paths) == {"robot1", "robot2", "robot3"}
        for path in result.paths.values():
            assert all(world.room_m(pose.x, pose.y) > 0.0 for pose in path)
    score = score_map(fresh[0].merged, world.truth())
    assert score.coverage >= 0.9
    assert score.wall_f1 > 0.85


def test_the_seed_decides_everything(world: World, fresh: list[VirtualResult]) -> None:
    again = run_virtual(VirtualRun(world=world, seed=1))
    assert again.coverage == fresh[0].coverage
    assert again.paths == fresh[0].paths
    assert again.paths != fresh[1].paths


def test_a_late_merged_map_costs_more_than_its_lateness(world: World, fresh: list[VirtualResult]) -> None:
    """Else the robots would not plan on it. docs/evaluation/method.md has the figures of a larger world."""
    for seed, sooner in zip(SEEDS, fresh, strict=True):
        later = run_virtual(VirtualRun(world=world, seed=seed, delay_s=LATE_S))
        assert later.time_s is not None
        assert sooner.time_s is not None
        assert later.time_s > sooner.time_s + LATE_S
        assert later.way_m > sooner.way_m


@pytest.mark.parametrize("has_slam", [True, False])
def test_robots_are_not_in_step_wherever_they_are_mapped(world: World, *, has_slam: bool) -> None:
    """Maps that come together are merged together: how many merged maps there are hangs on the robots' phases."""
    first = []
    for index, start in enumerate(world.starts(3)):
        settings = RobotSettings(robot=f"robot{index + 1}", start=start, has_slam=has_slam)
        agent = Agent(settings, world, phase=index / 3)
        outputs = ((step / 100, agent.step(step / 100, step)) for step in range(100))
        first.append(next(now for now, out in outputs if (out.grid if has_slam else out.scan) is not None))

    assert first == pytest.approx([0.0, MAP_PERIOD_S / 3, 2 * MAP_PERIOD_S / 3], abs=0.01)


def test_merges_come_at_the_task_s_own_rate_and_only_with_something_new(world: World) -> None:
    """Robots send a map twice a second, each at a moment of its own: more than six merges a second have nothing new."""
    counts = {}
    for period_s in (0.5, 0.25, 0.05):
        plan = VirtualRun(world=world, seed=1, target=1.0, longest_s=10.0, merge_period_s=period_s)
        counts[period_s] = len(run_virtual(plan).coverage)
    assert counts[0.5] == 20
    assert 38 <= counts[0.25] <= 40
    assert 55 <= counts[0.05] <= 60


def test_maps_have_the_task_s_own_cells(world: World) -> None:
    result = run_virtual(VirtualRun(world=world, seed=1, longest_s=5.0, resolution_m=0.02))
    assert result.merged is not None
    assert result.merged.resolution == 0.02


def test_robots_stand_and_are_merged_until_the_warm_up_is_over(world: World, fresh: list[VirtualResult]) -> None:
    result = run_virtual(VirtualRun(world=world, seed=1, warm_up_s=5.0))
    for path in result.paths.values():
        assert {(pose.x, pose.y) for pose in path[:10]} == {(path[0].x, path[0].y)}, "twice a second, for 5 s"
        assert path[-1] != path[0]
    assert result.coverage[0][0] == -5.0
    assert result.time_s is not None
    assert fresh[0].time_s is not None
    assert 0.0 < result.time_s < fresh[0].time_s + 5.0, "times count from the drive on"


def test_without_any_merged_map_no_robot_moves(world: World) -> None:
    result = run_virtual(VirtualRun(world=world, seed=1, delay_s=100.0, longest_s=10.0))
    assert (result.time_s, result.merged, result.way_m, result.goals) == (None, None, 0.0, 0)


def test_more_robots_are_faster_than_one() -> None:
    place = load_world("turtlebot3")
    alone, three = (run_virtual(VirtualRun(world=place, seed=1, robots=n)).time_s for n in (1, 3))
    assert alone is not None
    assert three is not None
    assert three < 0.7 * alone
