"""A task with a deadline: what a machine is worth to it, by its jobs' time there and the way."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import pytest

from support.allocations import allocation_of
from support.fleets import fleet_of, task_of, tuning_of
from support.profiles import load_of, profile_of
from zsched.core.gateway.gateway import Gateway
from zsched.core.scheduler.scoring import NOTHING_HELD, score
from zsched.core.scheduler.utility import LATE_WORTH, on_time, service_utility, timely_worth
from zsched.core.values.fleet import DEFAULT_BONUS, Demand, WorkerSpec
from zsched.core.values.in_force import InForce
from zsched.core.values.model import PeerState, ScoreForm, Tuning
from zsched.core.values.profile import Jobs

TUNING = tuning_of(cpu=1.0, memory=0.0, score=ScoreForm.SERVICE, deadline_ms=100.0)
EDGES = ("edge1", "edge2")
JOBS = Jobs(time_s=0.08, cpu_s=0.08, wait_s=0.0, age_s=0.08, done_hz=2.0, wanted_hz=2.0)


def worth(
    tuning: Tuning = TUNING,
    *,
    jobs: Jobs | None = JOBS,
    speeds: tuple[float, float] = (1.0, 1.0),
    used: tuple[float, float] = (1.0, 1.0),
    away_s: tuple[float | None, float | None] = (0.0, 0.0),
    runnable: tuple[float | None, float | None] = (None, None),
    away: Mapping[str, float] = NOTHING_HELD,
    candidates: tuple[str, ...] = EDGES,
    voter: str = "robot1",
) -> tuple[float, float]:
    """What the owner edge1 and the candidate edge2 are worth, behind the owner's settling."""
    spec = task_of(candidates=candidates, tuning=tuning, worker=WorkerSpec(command=("x",)), demand=Demand())
    gateway = Gateway(InForce(fleet_of(spec, of=(*candidates, "robot1"))))
    for sequence, now in ((1, 0.0), (2, 10.0)):
        for name, speed, cores, threads in zip(EDGES, speeds, used, runnable, strict=True):
            told = jobs or JOBS
            own = told.done_hz * told.cpu_s if name == "edge1" else 0.0
            load = load_of(cpu_cores=own, memory_mb=1.0, jobs=jobs if name == "edge1" else None)
            profile = profile_of(
                name,
                sequence=sequence,
                cpu_used_cores=cores,
                memory_mb=1000.0,
                memory_used_mb=100.0,
                workers=(load,),
                speed=speed,
                runnable=threads,
            )
            assert gateway.absorb(profile, now) is None
        gateway.learn_demand("merge", "edge1", now)
    allocation = allocation_of(tuning=tuning)
    states = dict.fromkeys((*candidates, "robot1"), PeerState.ALIVE)
    trips = {name: trip_s for name, trip_s in zip(EDGES, away_s, strict=True) if trip_s is not None} | dict(away)
    vector = score(spec, allocation, voter, gateway, states, 10.0, round_trips=trips)
    found = {one.candidate: one.value for one in vector.utilities}
    return found["edge1"], found["edge2"]


def test_by_service_both_machines_that_do_all_jobs_are_worth_the_same_but_for_what_is_free() -> None:
    owner, other = worth(replace(TUNING, deadline_ms=None), speeds=(1.0, 4.0))
    assert owner == pytest.approx(other, abs=0.02)


def test_with_a_deadline_the_machine_is_worth_more_whose_jobs_are_in_time() -> None:
    owner, other = worth(speeds=(1.0, 4.0))
    assert owner == pytest.approx(service_utility(3.16, 0.16, 4.0, share=timely_worth(on_time(0.08, 0.1))), abs=0.01)
    assert other > owner + 0.2


def test_the_way_counts_as_a_job_s_own_time_does() -> None:
    near, far = worth(away_s=(0.0, 0.3))
    assert far < LATE_WORTH + 0.05 < 0.4 < near
    assert worth(away_s=(0.05, 0.05))[0] < near


@pytest.mark.parametrize("known_s", [0.0, 0.03, 0.15])
def test_a_way_that_is_not_measured_yet_counts_as_the_longest_that_is(known_s: float) -> None:
    """A candidate is not better because a figure of it is missing, and an owner no worse than what is known."""
    assert worth(away_s=(known_s, None)) == worth(away_s=(known_s, known_s))
    assert worth(away_s=(None, known_s)) == worth(away_s=(known_s, known_s))


def test_of_ways_only_those_to_candidates_that_are_heard_count_for_others() -> None:
    """Neither what is no candidate, nor who is gone for a day, says how far away a candidate is."""
    assert worth(away_s=(0.03, None), away={"robot1": 9.0, "robot2": 9.0}) == worth(away_s=(0.03, 0.03))
    three = ("edge0", *EDGES)
    assert worth(away_s=(0.03, None), away={"edge0": 9.0}, candidates=three) == worth(away_s=(0.03, 0.03))


def test_a_robot_that_is_a_candidate_is_no_way_from_itself() -> None:
    assert worth(away_s=(0.03, None), voter="edge2") == worth(away_s=(0.03, 0.0), voter="edge2")


def test_a_candidate_with_nothing_free_stretches_the_job() -> None:
    owner, full = worth(used=(1.0, 3.8))
    assert full < LATE_WORTH + 0.01 < 0.4 < owner


@pytest.mark.parametrize("deadline_ms", [1.0, 10.0, 25.0])
def test_where_no_machine_keeps_the_deadline_the_one_that_does_more_of_the_jobs_leads_beyond_the_bonus(
    deadline_ms: float,
) -> None:
    held_up = replace(JOBS, time_s=0.5, wait_s=0.42, age_s=0.5, done_hz=0.2, wanted_hz=2.0)
    owner, other = worth(replace(TUNING, deadline_ms=deadline_ms), jobs=held_up, used=(4.0, 0.1))
    assert other > owner + DEFAULT_BONUS


SHORT_JOBS = Jobs(time_s=0.025, cpu_s=0.02, wait_s=0.005, age_s=0.025, done_hz=5.0, wanted_hz=5.0)
"""Beside four endless loops on four cores: the task uses 0.1 cores on the mean, and 0.8 while a job runs."""


def test_a_job_on_a_full_machine_runs_at_its_fair_share_however_little_the_task_needs_on_the_mean() -> None:
    busy, far = worth(jobs=SHORT_JOBS, used=(4.0, 0.1), runnable=(4.1, 0.1), away_s=(0.001, 0.15))
    assert busy > far


def test_a_job_that_takes_longer_than_a_fair_share_lets_expect_is_known_to_be_late_there() -> None:
    """Groups with weights of their own share differently, and a task with such short jobs lacks no work there."""
    slow = replace(SHORT_JOBS, time_s=0.15, wait_s=0.13, age_s=0.15)
    busy, far = worth(jobs=slow, used=(4.0, 0.1), runnable=(4.1, 0.1), away_s=(0.001, 0.05))
    assert busy < far
    assert busy < worth(jobs=SHORT_JOBS, used=(4.0, 0.1), runnable=(4.1, 0.1), away_s=(0.001, 0.05))[0] / 3


def test_a_job_that_waits_for_a_disk_is_as_late_on_a_faster_machine() -> None:
    at_disk = replace(JOBS, time_s=0.3, cpu_s=0.01, age_s=0.3, wait_s=0.0)
    owner, other = worth(jobs=at_disk, speeds=(1.0, 4.0))
    assert other == pytest.approx(owner, abs=0.02)


def test_a_task_whose_worker_tells_nothing_is_judged_by_service() -> None:
    assert worth(jobs=None) == worth(replace(TUNING, deadline_ms=None), jobs=None)


def test_the_paper_s_score_knows_no_deadline() -> None:
    paper = replace(TUNING, score=ScoreForm.PAPER)
    assert worth(paper, speeds=(1.0, 4.0)) == worth(replace(paper, deadline_ms=None), speeds=(1.0, 4.0))
