"""Whether a worker lacks anything, and for how long a machine is remembered for what it did not keep."""

from __future__ import annotations

from dataclasses import replace

import pytest

from support.profiles import load_of, profile_of
from zsched.core.doubt import DOUBT_S, LONGEST_DOUBT_S, TRUST_S
from zsched.core.gateway.job_need import JobNeed
from zsched.core.gateway.shortfall import (
    LAGS_S,
    SHORT_RATIO,
    Shortfalls,
    is_short,
    shows_lack,
)
from zsched.core.values.profile import Jobs, Profile, WorkerLoad


def test_who_gets_less_than_its_threads_want_is_short() -> None:
    def load(cores: float | None, wanted: float | None) -> WorkerLoad:
        return load_of(cpu_cores=cores, wanted_cores=wanted)

    assert is_short(load(1.0, 4.0))
    assert is_short(load(0.8 * SHORT_RATIO, 0.9)), "whatever it wants"
    assert not is_short(load(3.99, 4.0))
    assert not is_short(load(1.0, None))
    assert is_short(load(None, 1.0))


@pytest.mark.parametrize(("done_hz", "expected"), [(8.9, True), (10 * SHORT_RATIO, False), (10.0, False)])
def test_who_leaves_a_tenth_of_its_jobs_undone_is_short(done_hz: float, expected: bool) -> None:
    jobs = Jobs(time_s=0.1, cpu_s=0.1, done_hz=done_hz, wanted_hz=10.0)
    assert is_short(load_of(cpu_cores=0.9, jobs=jobs)) is expected


def test_undone_jobs_alone_show_no_lack_of_cpu() -> None:
    jobs = Jobs(time_s=0.1, cpu_s=0.1, done_hz=1.0, wanted_hz=10.0)
    assert not shows_lack(load_of(jobs=jobs))
    assert shows_lack(load_of(jobs=jobs, wanted_cores=1.0))
    assert shows_lack(load_of(jobs=Jobs(time_s=0.1, cpu_s=0.1, wait_s=0.0)))
    assert not shows_lack(load_of(wanted_cores=1.0))


JOB = JobNeed(work_s=0.1, other_s=0.0, queueing=0.0, hz=4.0, is_serial=True)
HELD_UP = Jobs(time_s=0.2, cpu_s=0.1, wait_s=0.1, age_s=0.2, done_hz=4.0, wanted_hz=8.0)


def there(*, cores: float = 0.4, others: float = 1.0) -> Profile:
    """A machine of four cores on which half of the task's jobs are left undone."""
    load = load_of(cpu_cores=cores, jobs=HELD_UP)
    return profile_of("edge1", cpu_cores=4.0, cpu_used_cores=cores + others, workers=(load,))


def noted(shortfalls: Shortfalls, profile: Profile, age_s: float, now: float = 0.0) -> bool:
    return shortfalls.note("merge", profile, JOB, age_s, need_cores=0.8, speed=1.0, fair_cores=0.0, now=now)


def test_half_of_the_work_and_twice_the_time_is_remembered_while_others_use_as_much() -> None:
    shortfalls, without = Shortfalls(), (1.0, 1.0)
    assert shortfalls.of("merge", there()) == without
    assert noted(shortfalls, there(), 0.2)
    assert not noted(shortfalls, there(), 0.2), "the same again is no news"
    assert shortfalls.of("merge", there(cores=0.0)) == pytest.approx((0.5, 2.0))
    assert shortfalls.of("merge", there(cores=0.0, others=2.0)) == without
    assert shortfalls.of("merge", profile_of("edge2", cpu_used_cores=1.0)) == without
    assert shortfalls.of("merge", replace(there(cores=0.0), cpu_cores=8.0)) == without, "a larger machine"
    assert shortfalls.of("slam", there()) == without
    shortfalls.forget("merge")
    assert shortfalls.of("merge", there()) == without


def test_it_is_forgotten_when_the_machine_keeps_what_it_promises() -> None:
    shortfalls, fine = Shortfalls(), there(cores=0.8)
    noted(shortfalls, there(), 0.2)
    assert noted(shortfalls, fine, 0.1)
    assert shortfalls.of("merge", fine) == (1.0, 1.0)
    assert not noted(shortfalls, fine, 0.1)


# --- what no wait for CPU explains -----------------------------------------------------------------------------------

STUCK = replace(HELD_UP, wait_s=0.0)


def of_stuck(*, cores: float = 0.4, others: float = 0.0, wanted: float | None = None, jobs: Jobs = STUCK) -> Profile:
    """A machine of four cores whose worker leaves half of its jobs undone, and waits for no CPU."""
    load = load_of(cpu_cores=cores, wanted_cores=wanted, jobs=jobs)
    return profile_of("edge1", cpu_cores=4.0, cpu_used_cores=cores + others, workers=(load,))


def is_held(shortfalls: Shortfalls, now: float, profile: Profile | None = None) -> bool:
    """Whether anything is held against the machine, once the task has left it."""
    shortfalls.end_doubts("merge", now)
    return shortfalls.of("merge", profile or of_stuck(cores=0.0)) != (1.0, 1.0)


def test_a_worker_that_was_stuck_once_is_held_against_its_machine_for_a_minute() -> None:
    """It made an idle machine worth next to nothing for good: what others use there never changed."""
    shortfalls = Shortfalls()
    for step in range(5):
        noted(shortfalls, of_stuck(), 0.2, now=float(step))
    assert is_held(shortfalls, 4.0 + DOUBT_S - 0.1)
    assert not is_held(shortfalls, 4.0 + DOUBT_S)


def test_a_machine_that_disappoints_whenever_it_is_tried_is_tried_half_as_often_each_time() -> None:
    """A disk that is slow for good: else the task would go there each minute."""
    shortfalls, now, pauses = Shortfalls(), 0.0, []
    for _ in range(9):
        for _ in range(4):
            noted(shortfalls, of_stuck(), 0.2, now=now)
            noted(shortfalls, of_stuck(cores=0.8), 0.1, now=now + 0.5)
            noted(shortfalls, of_stuck(), 0.2, now=now + 1.0)  # that comes and goes while the task is there
            now += 1.0
        pauses.append(next(for_s for for_s in range(10, 7200, 10) if not is_held(shortfalls, now + for_s)))
        now += pauses[-1]
    assert pauses == [min(DOUBT_S * 2**count, LONGEST_DOUBT_S) for count in range(9)]


@pytest.mark.parametrize(("kept_s", "for_s"), [(TRUST_S - 10.0, 4 * DOUBT_S), (TRUST_S, 2 * DOUBT_S), (1e4, DOUBT_S)])
def test_a_machine_that_has_kept_its_word_for_long_is_doubted_for_less(kept_s: float, for_s: float) -> None:
    shortfalls = Shortfalls()
    for at in (0.0, DOUBT_S):  # a minute, then two
        assert not is_held(shortfalls, at)
        noted(shortfalls, of_stuck(), 0.2, now=at)
    fine, start = of_stuck(cores=0.8), 3 * DOUBT_S
    assert not is_held(shortfalls, start)
    for step in range(round(kept_s) + 1):
        noted(shortfalls, fine, 0.1, now=start + step)
    later = start + kept_s + 1.0
    noted(shortfalls, of_stuck(), 0.2, now=later)
    assert is_held(shortfalls, later + for_s - 1.0)
    assert not is_held(shortfalls, later + for_s)


def test_a_time_in_which_the_task_was_elsewhere_proves_nothing() -> None:
    shortfalls = Shortfalls()
    noted(shortfalls, of_stuck(), 0.2, now=0.0)
    elsewhere = replace(of_stuck(cores=0.8), node="edge2")
    for step in range(100):
        noted(shortfalls, elsewhere, 0.1, now=1.0 + step)
    assert not is_held(shortfalls, 101.0)
    noted(shortfalls, of_stuck(cores=0.8), 0.1, now=101.0)
    noted(shortfalls, of_stuck(cores=0.8), 0.1, now=3000.0)
    noted(shortfalls, of_stuck(), 0.2, now=3001.0)
    assert is_held(shortfalls, 3001.0 + 1.9 * DOUBT_S)


@pytest.mark.parametrize(
    ("jobs", "wanted", "others", "is_for_good"),
    [
        (HELD_UP, None, 1.0, True),
        (STUCK, 0.8, 1.0, True),
        (STUCK, 0.4, 0.0, False),
        (STUCK, None, 3.6, False),
        (replace(STUCK, wait_s=None), 0.4, 3.6, False),
    ],
    ids=["jobs wait", "threads wait", "threads want no more", "nor on a full machine", "several threads"],
)
def test_who_waits_for_a_cpu_is_held_up_by_others_for_as_long_as_they_are_there(
    jobs: Jobs, wanted: float | None, others: float, is_for_good: bool
) -> None:
    shortfalls = Shortfalls()
    noted(shortfalls, of_stuck(jobs=jobs, wanted=wanted, others=others), 0.4)
    left = of_stuck(cores=0.0, others=others)
    assert is_held(shortfalls, DOUBT_S - 1.0, left)
    assert is_held(shortfalls, 1e6, left) is is_for_good


@pytest.mark.parametrize(("others", "is_for_good"), [(3.6, True), (0.0, False)])
def test_where_the_kernel_does_not_tell_who_waits_a_full_machine_is_the_cause(others: float, is_for_good: bool) -> None:
    shortfalls = Shortfalls()
    noted(shortfalls, of_stuck(jobs=replace(STUCK, wait_s=None), others=others), 2.0)
    left = of_stuck(cores=0.0, others=others)
    assert is_held(shortfalls, 1.0, left)
    assert is_held(shortfalls, 1e6, left) is is_for_good


@pytest.mark.parametrize(("wait_s", "is_for_good"), [(0.0199, False), (0.0201, True)])
def test_a_tenth_of_a_job_s_time_is_a_wait(wait_s: float, *, is_for_good: bool) -> None:
    shortfalls = Shortfalls()
    noted(shortfalls, of_stuck(jobs=replace(STUCK, wait_s=wait_s), others=1.0), 0.2)
    assert is_held(shortfalls, 1e6, of_stuck(cores=0.0, others=1.0)) is is_for_good


def test_a_wait_beside_nobody_is_held_against_its_machine_for_an_hour() -> None:
    """A quota that somebody sets for a moment: no end of others' use would ever tell that it is gone."""
    alone, others = of_stuck(jobs=HELD_UP, others=0.3), of_stuck(jobs=HELD_UP, others=0.41)
    for first, last, ends in ((alone, alone, True), (alone, others, False), (others, alone, True)):
        shortfalls = Shortfalls()
        noted(shortfalls, first, 0.2, now=0.0)
        noted(shortfalls, last, 0.2, now=10.0)
        left = of_stuck(cores=0.0, others=0.3)
        assert is_held(shortfalls, 9.9 + LONGEST_DOUBT_S, left)
        assert is_held(shortfalls, 10.0 + LONGEST_DOUBT_S, left) is not ends


def test_what_a_wait_explains_stays_while_a_doubt_of_another_time_ends() -> None:
    shortfalls = Shortfalls()
    noted(shortfalls, of_stuck(), 0.2, now=0.0)
    noted(shortfalls, of_stuck(jobs=HELD_UP, others=1.0), 0.2, now=1.0)
    assert is_held(shortfalls, 1e6, of_stuck(cores=0.0, others=1.0))


def test_of_a_task_or_a_node_that_is_no_more_nothing_is_remembered() -> None:
    for is_of_task in (True, False):
        shortfalls = Shortfalls()
        noted(shortfalls, of_stuck(), 0.2, now=0.0)
        if is_of_task:
            shortfalls.forget("merge")
        else:
            shortfalls.keep(("edge2",))
        noted(shortfalls, of_stuck(), 0.2, now=1000.0)
        assert not is_held(shortfalls, 1000.0 + DOUBT_S), "it would wait for twice as long"


def test_jobs_that_were_to_take_long_may_end_for_some_seconds_after_the_load_has() -> None:
    """Others leave the machine at once; jobs' mean age follows."""
    shortfalls = Shortfalls()
    full, free = there(others=3.6), there(cores=0.8)
    noted(shortfalls, full, 0.25, now=0.0)
    noted(shortfalls, free, 0.2, now=0.1)
    assert shortfalls.of("merge", free)[1] == 1.0
    noted(shortfalls, free, 0.2, now=5 * LAGS_S)
    assert shortfalls.of("merge", free)[1] == pytest.approx(2.0, rel=0.02), "it is the machine after all"


def test_a_machine_of_which_nobody_knows_what_is_used_is_not_judged() -> None:
    unknown = profile_of("edge1", cpu_used_cores=None, workers=(load_of(cpu_cores=0.4, jobs=HELD_UP),))
    assert not noted(Shortfalls(), unknown, 0.9)
    assert not noted(Shortfalls(), profile_of("edge1"), 0.9)
