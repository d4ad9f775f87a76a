"""A task's own speed on a machine: when it is noted, when it counts, when it is void."""

from __future__ import annotations

from dataclasses import replace

import pytest

from support.profiles import load_of, profile_of
from zsched.core.gateway.demand import COMPARED_S, RECENT_S, SETTLE_S, Demands
from zsched.core.gateway.task_speed import MOST_RATIO, TaskSpeeds
from zsched.core.values.fleet import Demand
from zsched.core.values.profile import Jobs, Profile, WorkerState

from .test_demand import TASK

NOTHING = replace(TASK, demand=Demand())


def profile(
    node: str = "edge2",
    *,
    cores: float = 0.0,
    others: float = 0.0,
    speed: float | None = None,
    wanted: float | None = None,
    jobs: Jobs | None = None,
    state: WorkerState = WorkerState.READY,
) -> Profile:
    """A machine of four cores, of which the task uses ``cores`` and others ``others``."""
    load = load_of(state=state, cpu_cores=cores, wanted_cores=wanted, jobs=jobs)
    return profile_of(node, cpu_cores=4.0, cpu_used_cores=cores + others, workers=(load,), speed=speed)


def jobs_of(cpu_s: float, *, wanted_hz: float = 5.0, done_hz: float = 5.0) -> Jobs:
    return Jobs(time_s=cpu_s, cpu_s=cpu_s, wait_s=0.0, age_s=cpu_s, done_hz=done_hz, wanted_hz=wanted_hz, backlog=0)


def stay(demands: Demands, one: Profile, begin: float, lasts_s: float = 2 * COMPARED_S) -> float:
    """The task is on the node of ``one``, which looks the same for so long; answers when that ends."""
    return stay_differing(demands, (one,), begin, lasts_s)


# --- what counts where ---------------------------------------------------------------------------------------------


def test_the_benchmark_counts_until_something_else_was_seen() -> None:
    speeds = TaskSpeeds()
    assert [speeds.of("merge", profile(speed=speed)) for speed in (None, 0.5, 2.0)] == [1.0, 0.5, 2.0]
    speeds.note("merge", profile(speed=2.0), 1.5)
    assert speeds.of("merge", profile(speed=2.0)) == 1.5
    assert speeds.of("merge", profile("edge1", speed=2.0)) == 2.0
    assert speeds.of("track", profile(speed=2.0)) == 2.0


def test_another_benchmark_of_the_machine_makes_it_void() -> None:
    speeds = TaskSpeeds()
    speeds.note("merge", profile(speed=2.0), 1.0)
    assert speeds.of("merge", profile(speed=3.0)) == 3.0


def test_what_was_seen_beside_others_counts_as_long_as_they_use_about_as_much() -> None:
    speeds = TaskSpeeds()
    speeds.note("merge", profile(others=2.0), 0.5)
    assert [speeds.of("merge", profile(others=others)) for others in (1.5, 1.7, 2.3, 2.5)] == [1.0, 0.5, 0.5, 1.0]
    assert speeds.of("merge", replace(profile(), cpu_used_cores=None)) == 1.0
    assert speeds.of("merge", profile(others=0.0), is_there=True) == 0.5, "until the task moves the need goes with it"


def test_others_from_whom_the_task_took_cpu_may_use_that_again_once_it_has_left() -> None:
    speeds = TaskSpeeds()
    speeds.note("merge", profile(cores=1.5, others=2.5), 0.5)
    assert [speeds.of("merge", profile(others=others)) for others in (2.0, 2.3, 3.5, 4.0)] == [1.0, 0.5, 0.5, 0.5]
    speeds.note("merge", profile(cores=0.5, others=2.5), 0.5)
    assert speeds.of("merge", profile(others=3.5)) == 1.0, "the machine was not full"


def test_what_was_seen_on_a_calm_machine_is_the_machine_s_own() -> None:
    speeds = TaskSpeeds()
    speeds.note("merge", profile(others=0.3), 0.5)
    assert speeds.of("merge", profile(others=3.0)) == 0.5


@pytest.mark.parametrize(("seen", "counts"), [(1e-9, 1.0 / MOST_RATIO), (1e9, MOST_RATIO)])
def test_a_figure_that_cannot_be_is_bounded(seen: float, counts: float) -> None:
    speeds = TaskSpeeds()
    speeds.note("merge", profile(), seen)
    assert speeds.of("merge", profile()) == counts


def test_beside_whom_nobody_has_measured_nothing_is_seen() -> None:
    speeds = TaskSpeeds()
    speeds.note("merge", replace(profile(), cpu_used_cores=None), 0.5)
    assert speeds.of("merge", profile()) == 1.0


def test_a_task_that_is_no_more_is_forgotten_alone() -> None:
    speeds = TaskSpeeds()
    for task in ("merge", "track"):
        speeds.note(task, profile(), 0.5)
    speeds.forget("merge")
    assert (speeds.of("merge", profile()), speeds.of("track", profile())) == (1.0, 0.5)


# --- when it is noted ----------------------------------------------------------------------------------------------


def test_a_task_that_is_short_where_it_came_for_more_than_it_needed_before_is_slow_there() -> None:
    """From both machines the need on each is the same, so neither looks better only from afar."""
    demands = Demands()
    home, away = profile("edge1", cores=1.5), profile(cores=3.6, others=0.4, wanted=4.0)
    left = replace(home, workers=(load_of(cpu_cores=0.0),), cpu_used_cores=0.0)
    at = stay(demands, home, 0.0)
    assert demands.at(NOTHING, away).cpu_cores == pytest.approx(1.5)
    at = stay(demands, away, at)
    needs = demands.at(NOTHING, left).cpu_cores, demands.at(NOTHING, away).cpu_cores
    assert needs == pytest.approx((1.5, 4.0))
    stay(demands, home, at)
    gone = replace(away, workers=(load_of(cpu_cores=0.0),), cpu_used_cores=0.4)
    assert (demands.at(NOTHING, home).cpu_cores, demands.at(NOTHING, gone).cpu_cores) == pytest.approx(needs)


def test_it_is_judged_once_its_use_has_settled_and_not_by_what_changes_later() -> None:
    demands = Demands()
    at = stay(demands, profile("edge1", cores=1.5), 0.0)
    short = profile(cores=3.6, others=0.4, wanted=4.0)
    stay(demands, short, at, SETTLE_S - 0.5)
    assert demands.at(NOTHING, short).cpu_cores == pytest.approx(1.5), "a burst at its start is no need"
    stay(demands, profile(cores=1.5), at + SETTLE_S - 0.5, COMPARED_S)
    assert demands.speed("merge", short) == 1.0
    stay(demands, short, at + SETTLE_S + COMPARED_S, COMPARED_S)
    assert demands.speed("merge", short) == 1.0, "so much later it is the task that has changed"
    assert demands.at(NOTHING, profile("edge1")).cpu_cores > 1.5


def test_a_worker_that_starts_again_on_the_same_machine_tells_nothing_of_it() -> None:
    demands = Demands()
    at = stay(demands, profile("edge1", cores=1.5), 0.0)
    demands.learn("merge", profile("edge1", cores=0.1, state=WorkerState.STARTING), at)
    stay(demands, profile("edge1", cores=3.6, others=0.4, wanted=4.0), at + 1.0)
    assert demands.speed("merge", profile("edge1")) == 1.0


def test_what_a_job_takes_tells_the_speed_whether_the_task_is_short_or_not() -> None:
    for cores, wanted in ((0.5, None), (3.6, 4.0)):
        demands = Demands()
        at = stay(demands, profile("edge1", cores=1.0, speed=2.0, jobs=jobs_of(0.1)), 0.0)
        there = profile(cores=cores, others=0.2, wanted=wanted, jobs=jobs_of(0.4))
        at = stay(demands, there, at)
        assert demands.speed("merge", there) == pytest.approx(0.5), "0.2 s of work in 0.4 s"
        job = demands.job("merge")
        assert job is not None
        assert job.work_s == pytest.approx(0.2)
        stay(demands, replace(there, workers=(load_of(cpu_cores=cores, jobs=jobs_of(0.8)),)), at)
        assert demands.speed("merge", there) == pytest.approx(0.5), "by then the jobs have grown"


@pytest.mark.parametrize(
    ("home", "away"),
    [
        pytest.param(profile("edge1", cores=1.0, others=2.9, jobs=jobs_of(0.2)), jobs_of(0.1), id="others slowed it"),
        pytest.param(profile("edge1", cores=2.0, jobs=jobs_of(0.4)), jobs_of(0.05), id="begins with an empty map"),
    ],
)
def test_a_job_that_takes_less_than_where_it_came_from_makes_no_machine_fast(home: Profile, away: Jobs) -> None:
    """Else the task needs too much everywhere else, by its own growth or once others are gone, and stays for that."""
    demands = Demands()
    at = stay(demands, home, 0.0)
    there = profile(cores=5.0 * away.cpu_s, jobs=away)
    at = stay(demands, there, at)
    assert demands.speed("merge", there) == 1.0
    grown = profile(cores=2.0, jobs=jobs_of(0.4))
    stay(demands, grown, at)
    assert demands.at(NOTHING, profile("edge1")).cpu_cores == pytest.approx(2.0)


def test_a_machine_that_was_slow_beside_others_is_as_fast_as_ever_once_the_task_was_there_alone() -> None:
    demands, calm = Demands(), profile("edge1", cores=0.5, jobs=jobs_of(0.1))
    at = stay(demands, calm, 0.0)
    for others, cpu_s, speed in ((2.0, 0.2, 0.5), (0.0, 0.1, 1.0)):
        there = profile(cores=5.0 * cpu_s, others=others, jobs=jobs_of(cpu_s))
        at = stay(demands, there, at)
        assert demands.speed("merge", there) == pytest.approx(speed)
        at = stay(demands, calm, at)
        assert demands.speed("merge", calm) == pytest.approx(1.0)


def test_more_jobs_of_the_same_kind_make_no_machine_slow_though_it_is_short() -> None:
    demands = Demands()
    at = stay(demands, profile("edge1", cores=0.2, jobs=jobs_of(0.1)), 0.0)
    there = profile(cores=0.9, others=3.1, jobs=jobs_of(0.1, wanted_hz=10.0, done_hz=9.0))
    stay(demands, there, at)
    assert demands.speed("merge", there) == 1.0
    assert demands.at(NOTHING, profile("edge1")).cpu_cores == pytest.approx(1.0)


def test_figures_from_long_before_it_was_seen_again_tell_nothing_of_the_machine() -> None:
    """A robot that was out of reach, or a task that nobody had: it may have changed since."""
    homes = profile("edge1", cores=0.5, jobs=jobs_of(0.1)), profile("edge1", cores=0.5)
    theres = profile(cores=2.0, jobs=jobs_of(0.4)), profile(cores=3.6, others=0.4, wanted=4.0)
    for home, there in zip(homes, theres, strict=True):
        for away_s, is_told in ((RECENT_S / 2, True), (RECENT_S + 1.0, False)):
            demands = Demands()
            at = stay(demands, home, 0.0)
            stay(demands, there, at + away_s)
            assert (demands.speed("merge", there) < 1.0) is is_told


def test_jobs_of_a_worker_that_has_been_silent_since_tell_nothing_of_the_next_machine() -> None:
    demands = Demands()
    at = stay(demands, profile("edge1", cores=0.5, jobs=jobs_of(0.1)), 0.0)
    at = stay(demands, profile("edge1", cores=0.0), at)
    there = profile(cores=2.0, jobs=jobs_of(0.4))
    stay(demands, there, at)
    assert demands.speed("merge", there) == 1.0


def test_a_machine_that_the_task_leaves_at_once_has_shown_how_slow_it_is() -> None:
    """The machine before is not fast by that: it is as it was."""
    demands, home = Demands(), profile("edge1", cores=0.5, jobs=jobs_of(0.1))
    at = stay(demands, home, 0.0)
    there = profile(cores=0.5, jobs=jobs_of(0.4))
    at = stay(demands, there, at, SETTLE_S - 1.0)
    stay(demands, home, at)
    assert (demands.speed("merge", home), demands.speed("merge", there)) == pytest.approx((1.0, 0.25))


def differing(node: str, *sizes_s: float) -> tuple[Profile, ...]:
    """A node as it looks while its jobs take each of these times."""
    return tuple(profile(node, cores=0.5, jobs=jobs_of(size_s)) for size_s in sizes_s)


def stay_differing(demands: Demands, ones: tuple[Profile, ...], begin: float, lasts_s: float = 2 * COMPARED_S) -> float:
    """The task is there for ``lasts_s``, and the node looks like each of ``ones`` for a second, in turns."""
    at = begin
    while at <= begin + lasts_s:
        demands.learn("merge", ones[int(at - begin) % len(ones)], at)
        at += 0.5
    return at


def test_no_machine_is_slower_for_jobs_that_differ() -> None:
    """Merging maps takes three times as long when robots meet: whichever machine it had come to seemed slow then."""
    demands, home, there = Demands(), *(differing(node, 0.1, 0.3, 0.15) for node in ("edge1", "edge2"))
    at = stay_differing(demands, home, 0.0)
    for lasts_s in (1.0, 4.5, 7.0, 2 * COMPARED_S):
        at = stay_differing(demands, there, at, lasts_s)
        assert demands.speed("merge", there[0]) == 1.0
        at = stay_differing(demands, home, at)
        assert demands.speed("merge", home[0]) == 1.0


def test_nor_for_jobs_that_grow_when_it_has_come() -> None:
    demands, home = Demands(), profile("edge1", cores=0.5, jobs=jobs_of(0.1))
    small, large = differing("edge2", 0.1, 0.4)
    at = stay(demands, home, 0.0)
    at = stay(demands, small, at, 2.0)
    stay(demands, large, at)
    assert demands.speed("merge", large) == 1.0
    assert demands.at(NOTHING, home).cpu_cores == demands.at(NOTHING, large).cpu_cores == pytest.approx(0.5)


def test_what_is_heavier_than_the_heaviest_before_is_the_machines_doing() -> None:
    demands, home, there = Demands(), differing("edge1", 0.1, 0.2), differing("edge2", 0.4, 0.8)
    stay_differing(demands, there, stay_differing(demands, home, 0.0))
    assert demands.speed("merge", there[0]) == pytest.approx(0.5), "at least: 0.2 of 0.4"


def test_what_jobs_took_more_than_a_minute_ago_is_forgotten() -> None:
    demands, home = Demands(), profile("edge1", cores=0.5, jobs=jobs_of(0.1))
    at = stay(demands, profile("edge1", cores=0.5, jobs=jobs_of(0.4)), 0.0)
    at = stay(demands, home, at, 61.0)
    there = profile(cores=0.5, jobs=jobs_of(0.4))
    stay(demands, there, at)
    assert demands.speed("merge", there) == pytest.approx(0.25)


def test_a_machine_that_has_the_task_again_at_once_is_not_judged_by_a_start_elsewhere() -> None:
    demands, home = Demands(), profile("edge1", cores=0.5, jobs=jobs_of(0.1))
    at = stay(demands, home, 0.0)
    at = stay(demands, profile(cores=0.1, jobs=jobs_of(0.02)), at, SETTLE_S - 1.0)
    stay(demands, home, at)
    assert demands.speed("merge", home) == 1.0


@pytest.mark.parametrize("idle_cores", [0.0, 0.01])
def test_a_task_that_came_idle_and_begins_to_work_makes_no_machine_slow(idle_cores: float) -> None:
    """It was drained at night, and back before its robots began; then the machine was an eighth as fast for good."""
    demands = Demands()
    at = stay(demands, profile("edge1", cores=idle_cores), 0.0)
    at = stay(demands, profile(cores=idle_cores), at, SETTLE_S)
    busy = profile(cores=0.95, wanted=1.0)
    demands.learn("merge", busy, at)
    assert demands.at(NOTHING, busy).cpu_cores == pytest.approx(1.0), "it needs that now"
    stay(demands, busy, at)
    assert demands.speed("merge", busy) == 1.0


def test_a_task_whose_input_has_stopped_makes_no_machine_fast() -> None:
    demands = Demands()
    at = stay(demands, profile("edge1", cores=1.5), 0.0)
    stay(demands, profile(cores=0.01), at)
    assert demands.speed("merge", profile()) == 1.0


def test_a_task_that_is_forgotten_takes_its_speeds_along() -> None:
    demands = Demands()
    at = stay(demands, profile("edge1", cores=1.5), 0.0)
    stay(demands, profile(cores=3.6, others=0.4, wanted=4.0), at)
    assert demands.speed("merge", profile(others=0.4)) < 1.0
    demands.forget("merge")
    assert demands.speed("merge", profile(others=0.4)) == 1.0
