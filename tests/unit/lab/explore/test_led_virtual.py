"""The whole loop of robots that are led, in virtual time: SLAM, merging by estimate, navigation."""

from __future__ import annotations

from dataclasses import replace

import pytest

from zsched_lab.explore.body import Drift, Limits
from zsched_lab.explore.led import LedResult, LedRun, run_led
from zsched_lab.explore.worlds import load_world


def test_led_robots_find_each_other_and_cover_a_world_with_odometry_that_drifts() -> None:
    plan = LedRun(
        world=load_world("office:2:12"),
        seed=2,
        robots=2,
        duration_s=25.0,
        warm_up_s=4.0,
        min_agreeing=150,
        limits=Limits(speed=0.5),
        drift=Drift(yaw=0.02, way=0.02),
    )

    found = run_led(plan)

    assert found.placed == 2
    assert max(found.pose_error_m) < 0.4
    shares = [share for _, share in found.coverage]
    assert shares[0] < 0.3 < shares[-1]
    assert shares[0] < found.mean < shares[-1]
    held = [share for t_s, share in found.coverage if t_s <= 0.0]
    assert max(held) - min(held) < 0.05, "in the warm-up they stand"
    short = run_led(replace(plan, duration_s=4.0)).coverage
    assert short == found.coverage[: len(short)], "the same plan is the same run"


def test_the_mean_holds_each_map_until_the_next() -> None:
    seen = ((-1.0, 0.1), (2.0, 0.3), (6.0, 0.5))
    found = LedResult(coverage=seen, pose_error_m=(), placed=1, duration_s=10.0)
    assert found.mean == pytest.approx((2 * 0.1 + 4 * 0.3 + 4 * 0.5) / 10)
    assert LedResult(coverage=(), pose_error_m=(), placed=0, duration_s=10.0).mean == 0.0
