from __future__ import annotations

import itertools

import pytest

from zsched_lab.fleet.schedule import SchedulePolicy, make_schedule, push_schedule, random_schedule

NODES = ("edge1", "edge2", "edge3")


@pytest.mark.parametrize("duration_s", [30.0, 60.0, 75.0, 600.0])
@pytest.mark.parametrize("policy", list(SchedulePolicy))
def test_windows_are_in_order_and_inside_the_run(policy: SchedulePolicy, duration_s: float) -> None:
    windows = make_schedule(policy, duration_s, seed=4, nodes=NODES)

    assert windows
    assert windows[0].start_s > 0
    assert windows[-1].end_s <= duration_s
    assert all(a.end_s <= b.start_s for a, b in itertools.pairwise(windows))


def test_same_seed_same_schedule_other_seed_another() -> None:
    assert push_schedule(60.0, 1) == push_schedule(60.0, 1)
    assert push_schedule(60.0, 1) != push_schedule(60.0, 2)
    assert random_schedule(60.0, 1, NODES) == random_schedule(60.0, 1, NODES)
    assert random_schedule(60.0, 1, NODES) != random_schedule(60.0, 2, NODES)


def test_random_schedule_does_not_depend_on_the_order_of_the_nodes() -> None:
    assert random_schedule(60.0, 1, NODES) == random_schedule(60.0, 1, NODES[::-1])


def test_push_leaves_time_between_two_moves_in_the_default_run() -> None:
    windows = push_schedule(60.0, seed=1)

    assert len(windows) == 3
    assert all(window.target is None for window in windows)
    assert all(b.start_s - a.start_s >= 14.0 for a, b in itertools.pairwise(windows))
