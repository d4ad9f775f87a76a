"""How long jobs wait for each other on a machine: whose waits count, and until when."""

from __future__ import annotations

import pytest

from zsched.core.gateway.job_need import JobNeed
from zsched.core.gateway.queueing import MEAN_S, SAME_RATE_RATIO, Queues
from zsched.core.values.struct import replace

TOLD = JobNeed(work_s=0.1, other_s=0.02, queue_ratio=1.2, is_serial=True)
HEARD = JobNeed(work_s=0.1, other_s=0.05, queue_ratio=1.0, is_serial=False)


def seen(job: JobNeed, *, hz: float = 5.0, for_s: float = 10.0, queues: Queues | None = None) -> Queues:
    """After so long on edge1, with two looks a second."""
    queues = queues or Queues()
    for _ in range(int(2 * for_s)):
        queues.count("merge", hz, 0.5)
        queues.note("merge", "edge1", job, 0.5)
    return queues


def test_a_machine_on_which_jobs_were_seen_to_wait_has_its_own_queue_and_another_one_the_owners() -> None:
    queues = seen(replace(TOLD, queue_ratio=3.0))
    assert queues.on("merge", "edge1", TOLD) == replace(TOLD, queue_ratio=3.0)
    assert queues.on("merge", "edge2", TOLD) == TOLD
    assert queues.on("slam", "edge1", TOLD) == TOLD


def test_what_a_worker_tells_of_its_other_waits_is_for_every_machine() -> None:
    queues = seen(TOLD)
    assert queues.on("merge", "edge1", replace(TOLD, other_s=0.5)).other_s == 0.5


def test_all_waits_that_are_only_heard_are_the_machines() -> None:
    queues = seen(replace(HEARD, other_s=0.4))
    assert queues.on("merge", "edge1", HEARD).other_s == pytest.approx(0.4)


def test_work_is_not_remembered() -> None:
    assert seen(TOLD).on("merge", "edge1", replace(TOLD, work_s=0.7)).work_s == 0.7


@pytest.mark.parametrize("ratio", [0.95 * SAME_RATE_RATIO, 1.05 * SAME_RATE_RATIO])
@pytest.mark.parametrize("is_more", [True, False])
def test_waits_count_while_jobs_come_about_as_often(ratio: float, is_more: bool) -> None:
    queues = seen(replace(TOLD, queue_ratio=3.0))
    for _ in range(int(20 * MEAN_S)):
        queues.count("merge", 5.0 * ratio if is_more else 5.0 / ratio, 0.5)
    counts = queues.on("merge", "edge1", TOLD).queue_ratio == 3.0
    assert counts is (ratio < SAME_RATE_RATIO)


def test_waits_of_another_rate_are_no_part_of_the_mean() -> None:
    queues = seen(replace(TOLD, queue_ratio=3.0))
    for _ in range(int(20 * MEAN_S)):
        queues.count("merge", 1.0, 0.5)
    assert seen(TOLD, hz=1.0, for_s=1.0, queues=queues).on("merge", "edge1", TOLD) == TOLD


def test_a_moment_says_little_beside_a_long_stay_and_a_first_moment_is_all_that_is_known() -> None:
    moment = replace(TOLD, queue_ratio=4.2)
    assert seen(moment, for_s=0.5).on("merge", "edge1", TOLD).queue_ratio == pytest.approx(4.2)
    queues = seen(moment, for_s=0.5, queues=seen(TOLD, for_s=3 * MEAN_S))
    assert queues.on("merge", "edge1", TOLD).queue_ratio == pytest.approx(1.2 + 3.0 * 0.5 / MEAN_S, rel=0.01)


def test_before_the_rate_is_known_nothing_is_remembered_and_no_look_of_no_length_divides_by_it() -> None:
    queues = Queues()
    queues.note("merge", "edge1", replace(TOLD, queue_ratio=3.0), 0.5)
    assert queues.on("merge", "edge1", TOLD) == TOLD
    queues.count("merge", 5.0, 0.0)
    queues.note("merge", "edge1", replace(TOLD, queue_ratio=3.0), 0.0)
    assert queues.on("merge", "edge1", TOLD).queue_ratio == 3.0


def test_a_task_of_the_same_name_that_comes_later_is_another_one() -> None:
    queues = seen(replace(TOLD, queue_ratio=3.0))
    queues.forget("merge")
    queues.count("merge", 5.0, 0.5)
    assert queues.on("merge", "edge1", TOLD) == TOLD
