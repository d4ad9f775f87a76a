"""What a job takes, where only its answers are seen."""

from __future__ import annotations

import pytest

from support.profiles import profile_of
from zsched.core.gateway.job_need import Heard, JobNeed, heard_of
from zsched.core.values.profile import AnswerTime


def heard(age_s: float) -> Heard:
    return Heard(age_s=age_s, counts=())


def test_time_that_is_no_cpu_time_is_a_wait_for_other_things_where_cpu_is_free() -> None:
    job = heard(0.3).job(0.1, 2.0, None, is_calm=True)
    assert (job.work_s, job.other_s) == pytest.approx((0.2, 0.2))
    assert job.age_s(2.0, 4.0) == pytest.approx(0.3), "as it was seen there"
    assert job.age_s(1.0, 4.0) == pytest.approx(0.4)
    assert job.age_s(2.0, 0.5) == pytest.approx(0.4)
    assert job.most_cores(1.0) is None, "it may work on several at once"


def test_on_a_full_machine_more_time_than_before_is_a_wait_for_a_cpu() -> None:
    late = heard(0.9)
    before = JobNeed(work_s=0.1, other_s=0.2, queue_ratio=1.0, is_serial=False)
    assert late.job(0.1, 1.0, before, is_calm=False) == before
    assert late.job(0.1, 1.0, None, is_calm=False).other_s == 0.0
    assert late.job(0.1, 1.0, before, is_calm=True).other_s == pytest.approx(0.8)


def test_a_worker_that_uses_several_cores_at_once_works_all_the_time_of_an_answer() -> None:
    job = heard(0.3).job(0.75, 1.0, None, is_calm=True)
    assert (job.work_s, job.other_s) == pytest.approx((0.3, 0.0))


def answer(age_s: float, count: float, owner: str = "edge1", task: str = "merge") -> AnswerTime:
    return AnswerTime(task=task, owner=owner, age_s=age_s, count=count)


def test_all_robots_answers_of_this_owner_count_and_one_bad_link_says_nothing_of_their_time() -> None:
    robots = [profile_of(f"robot{n}", answers=(answer(age_s, 2.0),)) for n, age_s in enumerate((0.1, 9.0, 0.2))]
    others = [profile_of("robot8", answers=(answer(5.0, 7.0, "edge2"), answer(5.0, 7.0, task="slam"))), profile_of()]
    assert heard_of("merge", "edge1", (*robots, *others)) == Heard(
        age_s=0.2, counts=(("robot0", 2.0), ("robot1", 2.0), ("robot2", 2.0))
    )
    assert heard_of("merge", "edge3", robots) is None


def test_a_robot_that_repeats_itself_counts_once() -> None:
    loud = profile_of("robot1", answers=(answer(9.0, 2.0),) * 5)
    others = [profile_of(f"robot{n}", answers=(answer(0.1, 2.0),)) for n in (2, 3)]
    told = heard_of("merge", "edge1", (loud, *others))
    assert told == Heard(age_s=0.1, counts=(("robot1", 2.0), ("robot2", 2.0), ("robot3", 2.0)))
