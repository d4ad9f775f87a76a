"""What a task needs where: by its use, by its own word, by the speeds of machines."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zsched.core.demand import SETTLE_S, STARVED_CPU_RATIO, UNSURE, Demands
from zsched.core.fleet import Demand, TaskSpec
from zsched.core.model import Profile, Tuning, Weights, WorkerLoad, WorkerState

TASK = TaskSpec(
    name="merge",
    candidates=("edge1", "edge2"),
    tuning=Tuning(weights=Weights(cpu=0.5, memory=0.5, network=0.0)),
    demand=Demand(cpu_cores=0.4, memory_mb=250.0),
)
EVERY_S = 2 * SETTLE_S


def profile(
    cores: float | None = 0.5,
    mb: float | None = 300.0,
    *,
    node: str = "edge1",
    cpu: float | None = 1.0,
    state: WorkerState = WorkerState.READY,
    wanted: float | None = None,
    speed: float | None = None,
) -> Profile:
    return Profile(
        node=node,
        incarnation=1,
        sequence=1,
        cpu_cores=4.0,
        cpu_used_cores=cpu,
        memory_mb=4000.0,
        memory_used_mb=1000.0,
        workers=(WorkerLoad(task="merge", state=state, cpu_cores=cores, memory_mb=mb, wanted_cores=wanted),),
        speed=speed,
    )


def learnt(*profiles: Profile, there: Profile | None = None, every_s: float = EVERY_S) -> Demand:
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
    assert learnt(profile(*used)) == Demand(cpu_cores=demand[0], memory_mb=demand[1])


def test_the_newest_measurement_replaces_the_older_ones() -> None:
    first = profile(2.0, 900.0)
    assert learnt(first, first, profile(0.5, 300.0)) == Demand(cpu_cores=0.5, memory_mb=300.0)


def test_what_a_task_uses_where_it_has_just_come_is_the_least_that_it_needs() -> None:
    """Its figures are smoothed and start from nothing; more than was known counts at once."""
    settled, rising = profile(2.0, 900.0), profile(0.3, 100.0, node="edge2")
    assert learnt(settled, rising) == Demand(cpu_cores=2.0, memory_mb=900.0)
    assert learnt(settled, rising, rising, every_s=SETTLE_S) == Demand(cpu_cores=0.4, memory_mb=250.0)
    assert learnt(settled, profile(3.0, 1000.0, node="edge2")) == Demand(cpu_cores=3.0, memory_mb=1000.0)


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


def test_a_machine_that_nobody_has_timed_counts_as_one_of_speed_1() -> None:
    assert learnt(profile(1.0, speed=2.0), there=profile(node="edge2")).cpu_cores == 2.0


@pytest.mark.parametrize("state", [WorkerState.STOPPED, WorkerState.STARTING, WorkerState.FAILED])
def test_a_task_does_not_cost_less_because_its_worker_restarts(state: WorkerState) -> None:
    known, restarting = profile(1.5, 600.0), profile(0.0, 20.0, state=state)
    assert learnt(known, known, restarting) == Demand(cpu_cores=1.5, memory_mb=600.0)


def test_a_figure_that_was_not_measured_leaves_the_known_one() -> None:
    known = profile(1.5, 600.0)
    for without in (profile(None, None), profile(cpu=None), replace(known, workers=())):
        assert learnt(known, known, without) == Demand(cpu_cores=1.5, memory_mb=600.0)


def test_only_another_figure_is_news() -> None:
    demands = Demands()
    assert demands.learn("merge", profile(1.5), 0.0)
    assert not demands.learn("merge", profile(1.5), 1.0)
    assert not demands.learn("merge", profile(1.5, node="edge2"), 2.0)
    assert demands.learn("merge", profile(1.6, node="edge2"), 3.0)
