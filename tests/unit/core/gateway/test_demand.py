"""What a task needs where: by its use, by its own word, by the speeds of machines."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from support.fleets import fleet_of, task_of
from support.profiles import load_of, profile_of
from zsched.core.gateway.demand import HOLDS_ALL_S, UNSURE, Amount, Demands, Need
from zsched.core.gateway.gateway import Gateway
from zsched.core.gateway.job_need import crowd
from zsched.core.gateway.shortfall import STARVED_CPU_RATIO
from zsched.core.values.fleet import Demand
from zsched.core.values.in_force import InForce
from zsched.core.values.profile import Jobs, Profile, Renewal, WorkerLoad, WorkerState

TASK = task_of(demand=Demand(cpu_cores=0.4, memory_mb=250.0))
EVERY_S = 8.0


def profile(
    cores: float | None = 0.5,
    mb: float | None = 300.0,
    *,
    node: str = "edge1",
    cpu: float | None = 1.0,
    state: WorkerState = WorkerState.READY,
    wanted: float | None = None,
    speed: float | None = None,
    jobs: Jobs | None = None,
) -> Profile:
    return profile_of(
        node,
        cpu_used_cores=cpu,
        workers=(load_of(state=state, cpu_cores=cores, memory_mb=mb, wanted_cores=wanted, jobs=jobs),),
        speed=speed,
    )


def learnt(*profiles: Profile, there: Profile | None = None, every_s: float = EVERY_S) -> Need:
    """What is needed on ``there`` after one look at each of ``profiles``."""
    demands = Demands()
    for number, one in enumerate(profiles):
        demands.learn("merge", one, number * every_s)
    return demands.at(TASK, there or profile())


def test_before_any_measurement_the_fleet_file_s_figure_counts_on_every_machine() -> None:
    assert learnt() == learnt(there=profile(speed=4.0)) == TASK.demand


@pytest.mark.parametrize(
    ("used", "demand"),
    [
        ((0.5, 300.0), (0.5, 300.0)),
        ((0.1, 100.0), (0.4, 250.0)),
        ((0.9, 100.0), (0.9, 250.0)),
        ((None, 300.0), (0.4, 300.0)),
        ((0.5, None), (0.5, 250.0)),
    ],
)
def test_demand_is_the_larger_of_the_fleet_file_and_the_measurement(
    used: tuple[float | None, float | None], demand: tuple[float, float]
) -> None:
    assert learnt(profile(*used)) == Amount(cpu_cores=demand[0], memory_mb=demand[1])


def test_the_memory_of_a_task_that_has_just_come_is_the_least_that_it_needs() -> None:
    """A worker takes its memory by and by; more than was known counts at once."""
    settled, rising = profile(2.0, 900.0), profile(2.0, 100.0, node="edge2")
    assert learnt(settled, rising) == Amount(cpu_cores=2.0, memory_mb=900.0)
    assert learnt(settled, rising, rising, every_s=HOLDS_ALL_S) == Amount(cpu_cores=2.0, memory_mb=250.0)
    assert learnt(settled, profile(3.0, 1000.0, node="edge2")) == Amount(cpu_cores=3.0, memory_mb=1000.0)


def test_a_starved_owner_shows_the_least_that_its_task_needs() -> None:
    known = profile(1.5, 600.0)
    busy = profile(0.5, 600.0, cpu=4.0 * STARVED_CPU_RATIO)
    nearly = profile(0.5, 600.0, cpu=4.0 * STARVED_CPU_RATIO - 0.01)
    assert learnt(known, busy).cpu_cores == 1.5
    assert learnt(known, nearly).cpu_cores == 0.5
    assert learnt(profile(1.5, 600.0, cpu=4.0)).cpu_cores == 1.5, "it got that much, so it needs that much"


def test_where_threads_always_want_to_run_the_need_is_what_it_was_before_or_more_than_is_used() -> None:
    starved = profile(1.0, cpu=4.0, wanted=2.5)
    assert learnt(starved).cpu_cores == UNSURE * 1.0, "it never had enough"
    assert learnt(profile(2.0), profile(2.0), starved, starved).cpu_cores == 2.0
    assert learnt(profile(3.0), profile(3.0), starved).cpu_cores == UNSURE * 1.0, "so much it does not want any more"
    assert learnt(profile(0.4), profile(0.4), starved).cpu_cores == UNSURE * 1.0, "it needs more than before"
    assert learnt(profile(1.0, cpu=4.0, wanted=1.2)).cpu_cores == 1.2, "and not more than its threads would take"
    assert learnt(profile(1.0, cpu=2.0, wanted=1.0)).cpu_cores == 1.0, "it has all that it can take"


def test_a_task_that_rises_to_what_a_full_machine_gives_is_not_taken_for_content() -> None:
    """Its figures rise from nothing while the kernel has not told yet that its threads always want to run."""
    rising = [profile(cores, cpu=4.0) for cores in (0.5, 1.0, 1.5)]
    assert learnt(*rising, profile(2.0, cpu=4.0, wanted=4.0), every_s=1.0).cpu_cores == UNSURE * 2.0


@given(here=st.floats(0.1, 10.0), there=st.floats(0.1, 10.0), cores=st.floats(0.5, 4.0))
def test_a_machine_of_twice_the_speed_needs_half_the_cores(here: float, there: float, cores: float) -> None:
    for seen in (profile(cores, speed=here), profile(cores / UNSURE, cpu=4.0, wanted=64.0, speed=here)):
        need = learnt(seen, there=profile(node="edge2", speed=there)).cpu_cores
        assert need == pytest.approx(max(cores * here / there, TASK.demand.cpu_cores))


@pytest.mark.parametrize("state", [WorkerState.STOPPED, WorkerState.STARTING, WorkerState.FAILED])
def test_a_task_does_not_cost_less_because_its_worker_restarts(state: WorkerState) -> None:
    known, restarting = profile(1.5, 600.0), profile(0.0, 20.0, state=state)
    assert learnt(known, known, restarting) == Amount(cpu_cores=1.5, memory_mb=600.0)


def test_a_worker_that_is_ready_again_has_time_to_take_its_memory() -> None:
    """Otherwise the first look after its restart makes the task small, and another task comes to its machine."""
    demands, known, again = Demands(), profile(1.5, 600.0), profile(1.5, 20.0)
    demands.learn("merge", known, 0.0)
    demands.learn("merge", known, EVERY_S)
    demands.learn("merge", profile(0.0, 20.0, state=WorkerState.STARTING), 2 * EVERY_S)
    for after_s in (0.5, 0.5 + 0.9 * HOLDS_ALL_S):
        demands.learn("merge", again, 2 * EVERY_S + after_s)
        assert demands.at(TASK, again) == Amount(cpu_cores=1.5, memory_mb=600.0)
    demands.learn("merge", again, 2 * EVERY_S + 0.6 + HOLDS_ALL_S)
    assert demands.at(TASK, again) == Amount(cpu_cores=1.5, memory_mb=250.0), "from then on its use is its need"


def test_a_figure_that_was_not_measured_leaves_the_known_one() -> None:
    known = profile(1.5, 600.0)
    for without in (profile(None, None), profile(cpu=None), replace(known, workers=())):
        assert learnt(known, known, without) == Amount(cpu_cores=1.5, memory_mb=600.0)


# --- by the worker's own word --------------------------------------------------------------------------------------


def told(
    wanted_hz: float,
    *,
    cpu_s: float = 0.1,
    got: float = 1.0,
    other_s: float = 0.0,
    speed: float | None = None,
    used: float = 4.0,
) -> Profile:
    """A serial worker that gets ``got`` of a core when it runs, and skips what it cannot do."""
    time_s = other_s + cpu_s / got
    done_hz = min(wanted_hz, 1.0 / time_s)
    wait_s = max(time_s - cpu_s - other_s, 0.0)
    jobs = Jobs(time_s=time_s, cpu_s=cpu_s, wait_s=wait_s, age_s=time_s, done_hz=done_hz, wanted_hz=wanted_hz)
    return profile(done_hz * cpu_s, cpu=used, speed=speed, jobs=jobs, wanted=1.0 if got < 1.0 else None)


@given(got=st.floats(0.02, 1.0), wanted_hz=st.floats(4.1, 10.0), speed=st.floats(0.25, 4.0))
def test_a_starved_worker_s_need_is_what_it_is_without_the_load(got: float, wanted_hz: float, speed: float) -> None:
    """Known at once and exactly: nothing was ever seen of the task where it had enough."""
    need = learnt(told(wanted_hz, got=got, speed=speed), there=profile(speed=speed)).cpu_cores
    assert need == pytest.approx(wanted_hz * 0.1)


def test_cpu_time_that_rises_by_a_tenth_under_contention_raises_the_need_by_no_more() -> None:
    calm, beside = learnt(told(8.0)).cpu_cores, learnt(told(8.0, cpu_s=0.11, got=0.5)).cpu_cores
    assert calm < beside <= 1.11 * calm


@pytest.mark.parametrize(
    ("load", "need"),
    [
        (load_of(cpu_cores=0.5, runnable=0.5), 0.5),
        (load_of(cpu_cores=0.5, runnable=0.54), 0.5),
        (load_of(cpu_cores=0.5, runnable=0.8), 2.0),  # it waits
        (load_of(cpu_cores=0.5, runnable=0.3), 2.0),  # threads that nobody has counted
        (load_of(cpu_cores=0.5), 2.0),
        (load_of(cpu_cores=0.5, runnable=0.5, jobs=Jobs(time_s=0.1, cpu_s=0.1, done_hz=5.0, wanted_hz=9.0)), 2.0),
    ],
)
def test_a_need_falls_on_a_full_machine_only_where_the_worker_is_seen_to_wait_for_nothing(
    load: WorkerLoad, need: float
) -> None:
    demands = Demands()
    for second in range(10):
        demands.learn("merge", profile(2.0, cpu=2.5), float(second))
    for second in range(10, 20):
        demands.learn("merge", profile_of(cpu_used_cores=4.0, workers=(load,)), float(second))
    assert demands.at(TASK, profile(node="edge2")).cpu_cores == need


def test_a_need_that_was_told_falls_again_on_a_full_machine() -> None:
    """What is only used there would be the least of it."""
    before, after = told(9.0, got=0.5), told(5.0, got=0.5)
    assert learnt(before, *[after] * 4).cpu_cores == pytest.approx(0.5, abs=0.01)


def test_what_was_measured_where_the_task_had_enough_counts_more_than_its_worker_s_word() -> None:
    """Jobs are whole, so what a second of them tells is less exact."""
    had_enough, starved = profile(0.8, cpu=2.0), told(5.0, got=0.5)
    assert learnt(had_enough, had_enough, starved).cpu_cores == 0.8
    assert learnt(starved).cpu_cores == pytest.approx(0.5)


def test_samples_that_no_core_could_do_are_not_needed() -> None:
    """A camera's 30 pictures a second, of which one core does ten: class latest skips the rest, wherever it runs."""
    assert learnt(told(30.0, got=0.5)).cpu_cores == pytest.approx(1.0)
    assert learnt(told(30.0)).cpu_cores == pytest.approx(1.0)
    demands = Demands()
    demands.learn("merge", told(30.0, speed=1.0), 0.0, fastest=2.0)
    assert demands.at(TASK, profile(speed=1.0)).cpu_cores == pytest.approx(2.0), "a faster candidate does twice as many"


def test_jobs_that_wait_for_a_disk_need_no_other_machine() -> None:
    """Half of the jobs are skipped, and none of their time was spent waiting for a CPU."""
    at_disk = told(10.0, cpu_s=0.05, other_s=0.15)
    assert learnt(at_disk).cpu_cores == pytest.approx(max(5.0 * 0.05, TASK.demand.cpu_cores))
    both = told(10.0, cpu_s=0.1, other_s=0.1, got=0.25)
    assert learnt(both).cpu_cores == pytest.approx(5.0 * 0.1), "alone it would do five a second"


def test_a_job_that_also_waits_for_a_disk_lacks_a_quicker_core_on_a_machine_with_cpu_to_spare() -> None:
    """20 ms of CPU and 10 ms of other waits, 50 times a second: at speed 1 a third is skipped, at speed 2 nothing."""
    demands, slow = Demands(), told(50.0, cpu_s=0.02, other_s=0.01, speed=1.0, used=1.0)
    quick = told(50.0, cpu_s=0.01, other_s=0.01, speed=2.0, used=1.0)
    for look in range(40):
        demands.learn("merge", slow, look * EVERY_S, fastest=2.0)
    assert demands.at(TASK, slow).cpu_cores == pytest.approx(1.0)
    assert demands.at(TASK, quick).cpu_cores == pytest.approx(0.5), "which one thread has there"
    alike = Demands()
    for look in range(40):
        alike.learn("merge", slow, look * EVERY_S)
    assert alike.at(TASK, slow).cpu_cores == pytest.approx(0.02 / 0.03), "where nobody is quicker it lacks nothing"


@pytest.mark.parametrize("wanted", [None, 2.0])
def test_jobs_of_several_threads_lack_quicker_cores_on_a_machine_with_cpu_to_spare(wanted: float | None) -> None:
    """Two threads, 0.2 s of CPU a job, nine a second: at speed 1 half of them are skipped, and it stayed there."""
    jobs = Jobs(time_s=0.2, cpu_s=0.4, done_hz=5.0, wanted_hz=9.0)
    slow = profile(2.0, cpu=2.1, speed=1.0, wanted=wanted, jobs=jobs)
    needs = []
    for fastest in (4.0, 1.5, None):
        demands = Demands()
        for look in range(40):
            demands.learn("merge", slow, look * EVERY_S, fastest=fastest)
        needs.append(demands.at(TASK, slow).cpu_cores)
    assert needs == pytest.approx([3.6, 3.0, 2.0]), "as far as the quickest candidate would do them"


def test_what_jobs_of_several_threads_leave_undone_on_a_full_machine_shows_no_lack_of_quicker_cores() -> None:
    jobs = Jobs(time_s=0.2, cpu_s=0.4, done_hz=5.0, wanted_hz=9.0)
    demands = Demands()
    for look in range(10):
        demands.learn("merge", profile(2.0, cpu=4.0, speed=1.0, jobs=jobs), look * EVERY_S, fastest=4.0)
    assert demands.at(TASK, profile(speed=1.0)).cpu_cores == pytest.approx(2.0), "they may wait for a CPU"


def test_a_starved_job_s_thread_lacks_though_helpers_beside_it_use_a_lot() -> None:
    """Three of nine jobs a second are done, 0.1 s of CPU each; the other 0.7 cores are no jobs."""
    jobs = Jobs(time_s=1 / 3, cpu_s=0.1, wait_s=1 / 3 - 0.1, age_s=0.4, done_hz=3.0, wanted_hz=9.0)
    assert learnt(profile(1.0, cpu=4.0, wanted=2.0, jobs=jobs)).cpu_cores == pytest.approx(1.6)


@pytest.mark.parametrize("done_hz", [0.17, 0.5, 1.08])
def test_jobs_as_long_as_the_window_of_their_rates_need_no_more_than_their_thread_takes(done_hz: float) -> None:
    """Its rates swing, its use does not; by the need of one moment the task went round among machines alike."""
    jobs = Jobs(time_s=1.957, cpu_s=1.957, wait_s=0.0, age_s=2.0, done_hz=done_hz, wanted_hz=1.3)
    assert learnt(profile(1.0, cpu=1.0, jobs=jobs)).cpu_cores == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize("threads", [{"wanted": 4.0}, {"runnable": 2.82}])
def test_a_job_of_several_threads_that_was_only_seen_under_a_load_is_shared_by_them_elsewhere(
    threads: dict[str, float],
) -> None:
    """Its whole time counted as its work, so an idle machine looked as late as the full one, for good."""
    jobs = Jobs(time_s=0.3525, cpu_s=0.47, age_s=0.3525, done_hz=2.0, wanted_hz=2.0)
    load = load_of(cpu_cores=0.94, wanted_cores=threads.get("wanted"), runnable=threads.get("runnable"), jobs=jobs)
    demands = Demands()
    for second in range(30):
        demands.learn("merge", profile_of(cpu_used_cores=4.0, workers=(load,)), float(second))
    job = demands.job("merge")
    assert job is not None
    assert job.work_s == pytest.approx(0.47 / 4.0, rel=0.01)
    for second in range(30, 60):  # now it is seen alone, and takes 0.2 s
        alone = replace(jobs, time_s=0.2, age_s=0.2)
        there = profile_of(cpu_used_cores=1.0, workers=(replace(load, jobs=alone),))
        demands.learn("merge", there, float(second))
    for second in range(60, 90):
        demands.learn("merge", profile_of(cpu_used_cores=4.0, workers=(load,)), float(second))
    job = demands.job("merge")
    assert job is not None
    assert job.work_s == pytest.approx(0.2), "what was seen counts more than what was guessed"


def test_what_several_threads_leave_undone_counts_where_they_always_want_to_run() -> None:
    jobs = Jobs(time_s=0.5, cpu_s=1.0, done_hz=2.0, wanted_hz=4.0)
    assert learnt(profile(2.0, cpu=4.0, wanted=8.0, jobs=jobs)).cpu_cores == pytest.approx(4.0)
    assert learnt(profile(2.0, cpu=4.0, wanted=3.0, jobs=jobs)).cpu_cores == pytest.approx(3.0)
    assert learnt(profile(2.0, cpu=2.0, jobs=jobs)).cpu_cores == pytest.approx(2.0), "they wait for something else"
    assert learnt(profile(0.6, cpu=4.0, wanted=0.0, jobs=jobs)).cpu_cores == pytest.approx(0.6), "they want no CPU"
    catches_up = replace(jobs, done_hz=4.0, wanted_hz=2.0)
    assert learnt(profile(2.0, cpu=4.0, wanted=8.0, jobs=catches_up)).cpu_cores == pytest.approx(2.0)


def test_a_worker_that_catches_up_needs_less_than_it_uses() -> None:
    jobs = Jobs(time_s=0.1, cpu_s=0.1, wait_s=0.0, done_hz=9.0, wanted_hz=6.0)
    assert learnt(profile(0.9, cpu=4.0, jobs=jobs)).cpu_cores == pytest.approx(0.6)


def test_how_long_a_job_takes_elsewhere_is_its_cpu_by_speed_and_what_is_free_and_the_rest_as_it_was() -> None:
    demands = Demands()
    assert demands.job("merge") is None
    demands.learn("merge", told(2.0, cpu_s=0.1, other_s=0.05, got=0.5, speed=2.0), 0.0)
    job = demands.job("merge")
    assert job is not None
    assert job.age_s(speed=2.0, free_cores=1.0) == pytest.approx(0.15)
    assert job.age_s(speed=1.0, free_cores=4.0) == pytest.approx(0.25)
    assert job.age_s(speed=1.0, free_cores=0.5) == pytest.approx(0.45)
    assert job.age_s(speed=1.0, free_cores=-1.0) < 5.0, "no machine makes it endless"


def test_the_wait_for_a_turn_is_what_it_is_where_nothing_is_short() -> None:
    def queued(age_s: float, wait_s: float) -> Profile:
        jobs = Jobs(time_s=0.1 + wait_s, cpu_s=0.1, wait_s=wait_s, age_s=age_s, done_hz=3.0, wanted_hz=3.0)
        return profile(0.3, cpu=2.0, jobs=jobs)

    demands = Demands()

    def age_s() -> float:
        job = demands.job("merge")
        assert job is not None
        return job.age_s(1.0, 4.0)

    demands.learn("merge", queued(2.0, 0.4), 0.0)
    assert age_s() == pytest.approx(0.1 * (1.0 + crowd(0.3)))
    demands.learn("merge", queued(0.3, 0.0), EVERY_S)
    assert age_s() == pytest.approx(0.3)
    demands.learn("merge", queued(5.0, 0.4), 2 * EVERY_S)
    assert age_s() == pytest.approx(0.3)


def test_what_a_task_is_seen_to_get_counts_though_its_machine_s_figures_are_fine() -> None:
    """Half of its jobs are left undone beside two idle cores (it is pinned, or has a quota of its own)."""
    demands, pinned = Demands(), told(9.0, got=0.5, used=2.0)
    demands.learn("merge", pinned, 0.0)
    assert demands.given_ratio("merge", pinned) == pytest.approx(5 / 9)
    assert demands.given_ratio("merge", profile(0.0, cpu=1.5, node="edge2")) == 1.0
    assert demands.given_ratio("slam", pinned) == 1.0
    demands.learn("merge", told(9.0, used=2.0), 2 * EVERY_S)
    assert demands.given_ratio("merge", told(9.0, used=2.0)) == 1.0, "it gets all again"


def test_how_long_jobs_are_seen_to_take_counts_on_a_full_machine_where_the_task_is() -> None:
    """Where the load has ended the jobs that it held up count in their mean for some seconds."""
    demands, jobs = Demands(), Jobs(time_s=0.4, cpu_s=0.1, wait_s=0.3, age_s=0.5, done_hz=2.0, wanted_hz=2.0)
    full, calm = (profile(0.2, cpu=used, jobs=jobs) for used in (4.0, 0.3))
    demands.learn("merge", full, 0.0)
    assert demands.seen_s("merge", full) == 0.5
    assert demands.seen_s("merge", profile(0.2, cpu=4.0, jobs=replace(jobs, age_s=None))) == 0.4
    assert demands.seen_s("merge", calm) == 0.0
    assert demands.seen_s("merge", replace(full, node="edge2")) == 0.0
    assert demands.seen_s("merge", profile(0.2, cpu=4.0)) == 0.0


@pytest.mark.parametrize("is_moved", [True, False])
@pytest.mark.parametrize("is_idle", [True, False])
def test_the_job_of_a_worker_that_was_replaced_is_not_that_of_one_that_tells_none(
    *, is_moved: bool, is_idle: bool
) -> None:
    """How long it takes would be held against machines for ever."""
    demands, before = Demands(), told(9.0, used=2.0)
    (load,) = before.workers
    due = replace(load, renewal=Renewal.DUE, jobs=None if is_idle else load.jobs)
    demands.learn("merge", before, 0.0)
    demands.learn("merge", replace(before, workers=(due,)), EVERY_S)
    job = demands.job("merge")
    assert job is not None, "it runs still"
    after = profile(2.5, node="edge2" if is_moved else "edge1", cpu=3.0)
    demands.learn("merge", after, 2 * EVERY_S)
    assert demands.job("merge") is None
    demands.learn("merge", before, 4 * EVERY_S)
    demands.learn("merge", after, 5 * EVERY_S)
    demands.learn("merge", after, 6 * EVERY_S)
    assert demands.job("merge") is not None, "nothing has changed it since: a worker without work tells none"


@pytest.mark.parametrize("is_moved", [True, False])
@pytest.mark.parametrize("is_changed", [True, False])
def test_a_changed_program_is_not_held_to_what_the_one_before_needed(*, is_moved: bool, is_changed: bool) -> None:
    """On a machine without free CPU its use alone would never lower the need.

    A recipe that changes otherwise starts the same program again.
    """
    fleet = fleet_of(TASK, of=("edge1", "edge2", "robot1"), electors=("robot1",))
    before = profile(2.0, 600.0, cpu=3.0)
    light = profile(0.5, 200.0, node="edge2" if is_moved else "edge1", cpu=4.0, wanted=3.0)
    gateway = Gateway(InForce(fleet))
    due = replace(before, workers=tuple(replace(load, renewal=Renewal.DUE) for load in before.workers))
    starting = replace(before, workers=(load_of(state=WorkerState.STARTING),))
    for number, one in enumerate((before, before, due, due, starting, light)):
        assert gateway.absorb(replace(one, sequence=number), number * EVERY_S) is None
        gateway.learn_demand("merge", one.node, number * EVERY_S)
        if number == 0 and is_changed:
            gateway.expect_another("merge")
        if number == 3:
            assert gateway.demand(TASK, before).cpu_cores == 2.0, "what runs until then is the one before"
    assert gateway.demand(TASK, before).cpu_cores == (UNSURE * 0.5 if is_changed else 2.0)


def test_a_job_is_at_least_as_old_as_it_takes() -> None:
    """A clock that disagrees makes nobody's queue shorter than none."""
    demands = Demands()
    jobs = Jobs(time_s=0.1, cpu_s=0.1, wait_s=0.0, age_s=0.05, done_hz=3.0, wanted_hz=3.0)
    demands.learn("merge", profile(0.3, cpu=2.0, jobs=jobs), 0.0)
    assert getattr(demands.job("merge"), "queueing", 1.0) == 0.0


def test_a_job_of_several_threads_takes_elsewhere_what_it_takes_here() -> None:
    """How its threads share the work is not told, so all of its time is taken for work."""
    demands = Demands()
    demands.learn("merge", profile(2.0, jobs=Jobs(time_s=0.5, cpu_s=1.5, done_hz=2.0, wanted_hz=2.0)), 0.0)
    job = demands.job("merge")
    assert job is not None
    assert job.work_s == 0.5


@pytest.mark.parametrize(
    "jobs",
    [
        pytest.param(Jobs(time_s=0.1, cpu_s=0.1, done_hz=4.0, wanted_hz=8.0), id="undone, and no word of why"),
        pytest.param(Jobs(time_s=0.1, cpu_s=0.1, wait_s=0.0, done_hz=4.0, wanted_hz=4.0), id="all done"),
    ],
)
def test_who_needed_more_before_and_does_not_say_that_it_lacks_a_cpu_gets_its_share(jobs: Jobs) -> None:
    demands, before = Demands(), profile(0.6, cpu=1.0)
    now_on_full = profile(0.4, cpu=STARVED_CPU_RATIO * before.cpu_cores, jobs=jobs)
    for number, word in enumerate((before, before, now_on_full, now_on_full)):
        demands.learn("merge", word, number * EVERY_S)
    assert demands.at(TASK, now_on_full).cpu_cores == 0.6
    assert demands.given_ratio("merge", now_on_full) == 1.0
