"""Whether a worker lacks anything, and for how long a machine is remembered for what it did not keep."""

from __future__ import annotations

from dataclasses import replace

import pytest

from support.profiles import load_of, profile_of
from zsched.core.gateway.job_need import JobNeed
from zsched.core.gateway.shortfall import LAGS_S, SHORT_RATIO, Shortfalls, is_short, shows_lack
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
