"""What a job takes, by its worker's word."""

from __future__ import annotations

import doctest
from dataclasses import replace

import pytest

from zsched.core.gateway import job_need
from zsched.core.gateway.job_need import MOST_QUEUE_RATIO, JobNeed, crowd, told_job
from zsched.core.values.profile import Jobs


@pytest.mark.parametrize("queueing", [0.3, 1.0, 3.0])
def test_jobs_that_come_irregularly_wait_the_longer_the_slower_the_machine_is(queueing: float) -> None:
    """Whichever of both machines it is seen on: five a second, of 0.1 s on the slow one and 0.05 s on the other."""

    def age_s(cpu_s: float) -> float:
        return cpu_s * (1.0 + queueing * crowd(5.0 * cpu_s))

    for speed in (1.0, 2.0):
        cpu_s = 0.1 / speed
        told = Jobs(time_s=cpu_s, cpu_s=cpu_s, wait_s=0.0, age_s=age_s(cpu_s), done_hz=5.0, wanted_hz=5.0)
        job = told_job(told, speed, None, is_calm=True)
        assert job.age_s(1.0, 4.0) == pytest.approx(age_s(0.1))
        assert job.age_s(2.0, 4.0) == pytest.approx(age_s(0.05))


def test_what_several_threads_wait_on_a_full_machine_is_no_work_elsewhere() -> None:
    """Jobs of four threads, 0.1 s each: their own word has no waits, so a full owner's crowd was taken along."""

    def seen(time_s: float, before: JobNeed | None, *, is_calm: bool) -> JobNeed:
        jobs = Jobs(time_s=time_s, cpu_s=0.4, age_s=time_s, done_hz=4.0, wanted_hz=4.0)
        return told_job(jobs, 2.0, before, is_calm=is_calm)

    alone = seen(0.1, None, is_calm=True)
    crowded = seen(0.25, alone, is_calm=False)
    assert (alone.work_s, crowded.work_s) == pytest.approx((0.2, 0.2))
    assert seen(0.25, None, is_calm=False).work_s == pytest.approx(0.5), "where nothing else is known"
    assert seen(0.25, crowded, is_calm=True).work_s == pytest.approx(0.5), "its jobs have become larger"


def test_a_serial_worker_is_busy_while_its_job_waits_for_other_things_as_well() -> None:
    told = Jobs(time_s=0.1, cpu_s=0.05, wait_s=0.0, age_s=0.2, done_hz=5.0, wanted_hz=5.0)
    job = told_job(told, 1.0, None, is_calm=True)
    assert (job.other_s, job.queueing) == pytest.approx((0.05, 1.0))
    assert job.age_s(2.0, 4.0) == pytest.approx(0.075 * (1.0 + crowd(0.375)))


def test_a_queue_under_a_load_is_at_most_the_usual_one() -> None:
    usual = JobNeed(work_s=0.1, other_s=0.0, queueing=1.0, hz=5.0)

    def seen(age_s: float) -> float:
        jobs = Jobs(time_s=0.2, cpu_s=0.1, wait_s=0.1, age_s=age_s, done_hz=5.0, wanted_hz=5.0)
        return told_job(jobs, 1.0, usual, is_calm=False).queueing

    assert seen(2.0) == 1.0
    assert seen(0.3) == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("is_calm", "work_s"),
    [(False, 0.1), (True, 0.25)],
)
def test_how_long_a_job_takes_alone_is_a_guess_until_it_was_seen_alone(is_calm: bool, work_s: float) -> None:
    """Four threads, 0.4 s of CPU a job."""
    jobs = Jobs(time_s=0.25, cpu_s=0.4, age_s=0.25, done_hz=2.0, wanted_hz=2.0)
    job = told_job(jobs, 1.0, None, is_calm=is_calm, threads=4.0)
    assert job.work_s == pytest.approx(work_s)
    assert job.is_guess is (work_s == 0.1)
    assert told_job(jobs, 1.0, job, is_calm=False).is_guess is job.is_guess
    assert told_job(jobs, 1.0, None, is_calm=False, threads=0.5).work_s == pytest.approx(0.25)


def test_how_irregularly_jobs_of_several_threads_come_is_seen_anew_on_every_calm_machine() -> None:
    """It only sank, so that inputs which came in a burst later were taken for a machine that is slow, for good."""

    def seen(age_s: float, before: JobNeed | None, *, is_calm: bool) -> JobNeed:
        jobs = Jobs(time_s=0.05, cpu_s=0.1, age_s=age_s, done_hz=4.0, wanted_hz=4.0)
        return told_job(jobs, 1.0, before, is_calm=is_calm)

    quiet = seen(0.05, None, is_calm=True)
    burst = seen(0.15, quiet, is_calm=True)
    assert quiet.queueing == 0.0
    assert burst.age_s(1.0, 4.0) == pytest.approx(0.15)
    assert seen(0.15, quiet, is_calm=False).queueing == 0.0, "on a full machine that may be a wait for a CPU"


def test_a_job_of_several_threads_that_waits_for_a_gpu_waits_as_long_on_every_machine() -> None:
    """0.15 s of 0.2 s were neither work nor a wait, so every machine promised 0.05 s, and none kept it."""
    jobs = Jobs(time_s=0.2, cpu_s=0.05, age_s=0.2, done_hz=4.0, wanted_hz=4.0)
    job = told_job(jobs, 1.0, None, is_calm=True)
    assert (job.work_s, job.other_s) == pytest.approx((0.05, 0.15))
    assert job.age_s(1.0, 4.0) == pytest.approx(0.2), "as it was seen there"
    assert job.age_s(0.5, 4.0) == pytest.approx(0.25)
    queued = told_job(replace(jobs, age_s=0.3), 1.0, None, is_calm=True)
    assert queued.age_s(1.0, 4.0) == pytest.approx(0.3), "behind another one that waits there"
    late = told_job(replace(jobs, time_s=0.35, age_s=0.35), 1.0, job, is_calm=False)
    assert (late.work_s, late.other_s) == pytest.approx((0.05, 0.15)), "more than that may be a wait for a CPU"
    assert told_job(jobs, 1.0, None, is_calm=False).other_s == 0.0


@pytest.mark.parametrize("time_s", [1e-9, 1e-3])
def test_whatever_is_told_an_age_stays_within_bounds(time_s: float) -> None:
    jobs = Jobs(time_s=time_s, cpu_s=time_s, wait_s=0.0, age_s=1e6, done_hz=1e6, wanted_hz=1e6)
    job = told_job(jobs, 1.0, None, is_calm=False)
    assert job.age_s(1.0, 4.0) == pytest.approx(MOST_QUEUE_RATIO * time_s)
    assert job.age_s(0.25, 4.0) <= 4.0 * MOST_QUEUE_RATIO * time_s * (1 + 1e-9)
    assert told_job(replace(jobs, wanted_hz=0.0, done_hz=0.0), 1.0, None, is_calm=False).age_s(0.1, 0.0) > 0.0


def test_the_worked_example_holds() -> None:
    assert doctest.testmod(job_need).failed == 0
