"""Fleets come to rest soon after their faults: within bounds that a regression to three times as long would break."""

from __future__ import annotations

import pytest

from zsched.config.timing import PROFILES
from zsched_lab.sim.faults import play
from zsched_lab.sim.rest import AT_MOST_S, FEWEST, QUANTILES_S, quantile, spread, too_few, too_slow
from zsched_lab.sim.simulate import Job, with_enough_of_each
from zsched_lab.sim.swarm import plan


def test_every_profile_has_its_bounds_and_those_of_a_batch_are_the_narrower_ones() -> None:
    assert set(AT_MOST_S) == set(QUANTILES_S) == set(PROFILES)
    for name, bounds in QUANTILES_S.items():
        assert bounds[90] < bounds[99] < AT_MOST_S[name]


@pytest.mark.long
def test_fleets_keep_the_bound_of_most_schedules_and_three_times_as_long_would_not() -> None:
    seeds = [seed for seed in range(7000, 7200) if plan(seed).fleet.timing.name == "wifi"][: FEWEST[90]]
    results = [play(plan(seed)) for seed in seeds]
    assert [result.violation for result in results if result.violation] == []
    times = [result.settled_s for result in results if result.settled_s is not None]
    assert too_slow({"wifi": times}) == [], spread(times)
    assert too_slow({"wifi": [3.0 * one for one in times]}) != [], spread(times)


@pytest.mark.parametrize("percent", [90, 99])
def test_a_batch_is_too_slow_when_a_quantile_is_and_too_small_to_tell_when_it_is_small(percent: int) -> None:
    bound_s, count = QUANTILES_S["wan"][percent], FEWEST[percent]
    late = count - count * percent // 100
    times = [0.1] * (count - late) + [bound_s + 0.1] * late
    assert any(f"{percent} %" in one for one in too_slow({"wan": times}))
    assert not any(f"{percent} %" in one for one in too_slow({"wan": [0.1, *times[:-1]]}))
    assert not any(f"{percent} %" in one for one in too_slow({"wan": times[1:]}))


def test_a_profile_that_few_schedules_have_gets_further_ones_until_it_can_be_judged() -> None:
    most = [Job(seed=seed) for seed in range(1000) if plan(seed).fleet.timing.name != "wan"]
    rest = [Job(seed=seed) for seed in range(1000, 2000)]
    played = list(with_enough_of_each(iter([*most[:200], *rest]), 200, FEWEST[90]))
    assert [job.seed for job in played[:200]] == [job.seed for job in most[:200]], "those that were asked for"
    assert {job.profile for job in played[200:]} == {"wan"}
    assert len(played) == 200 + FEWEST[90]
    times = {name: [0.1 for job in played if job.profile == name] for name in PROFILES}
    assert too_few(times) == []
    assert too_few({**times, "wan": times["wan"][1:]}) == ["wan"]
    assert list(with_enough_of_each(iter(rest), 7, 0)) == rest[:7]


def test_a_quantile_is_the_time_of_the_first_schedule_beyond_it() -> None:
    assert [quantile([3.0, 1.0, 2.0, 4.0], percent) for percent in (0, 50, 90, 99)] == [1.0, 3.0, 4.0, 4.0]
