"""How soon a machine is measured again."""

from __future__ import annotations

from dataclasses import replace

import pytest

from zsched.core.profile.sampling import CHANGING_S, LOAD_CHANGE, REST_S, Sampling
from zsched.core.values.profile import DeviceSample, LinkSample, LinkSource, WorkerLoad, WorkerState

IDLE = DeviceSample(
    cpu_cores=4.0,
    cpu_used_cores=0.1,
    memory_mb=4096.0,
    memory_used_mb=1000.0,
    workers=(WorkerLoad(task="echo", state=WorkerState.READY, cpu_cores=0.0),),
)
WIRED = (LinkSample(source=LinkSource.WIRED),)
PERIOD_S = 0.2


def next_s(pace: Sampling, device: DeviceSample, now: float, *, is_watched: bool = False) -> float:
    return pace.next_s(device, WIRED, now, is_watched=is_watched)


def at_rest() -> Sampling:
    """Since time 100."""
    pace = Sampling(period_s=PERIOD_S)
    assert next_s(pace, IDLE, 100.0 - CHANGING_S) == PERIOD_S, "at first it must be seen that nothing changes"
    assert next_s(pace, IDLE, 99.9) == PERIOD_S
    assert next_s(pace, IDLE, 100.0) == REST_S
    return pace


CHANGES = {
    "load": replace(IDLE, cpu_used_cores=0.1 + LOAD_CHANGE * 4.0),
    "memory": replace(IDLE, memory_used_mb=1100.0),
    "another quota": replace(IDLE, cpu_cores=2.0),
    "a worker at work": replace(IDLE, workers=(replace(IDLE.workers[0], cpu_cores=0.06),)),
    "a worker that lacks a CPU": replace(IDLE, workers=(replace(IDLE.workers[0], wanted_cores=0.5),)),
    "a worker's state": replace(IDLE, workers=(replace(IDLE.workers[0], state=WorkerState.STARTING),)),
    "pressure": replace(IDLE, cpu_pressure=0.2),
    "not measured": replace(IDLE, cpu_used_cores=None),
}


@pytest.mark.parametrize("device", CHANGES.values(), ids=CHANGES)
def test_any_change_begins_the_quick_pace(device: DeviceSample) -> None:
    pace = at_rest()
    assert next_s(pace, device, 101.0) == PERIOD_S
    assert next_s(pace, device, 100.9 + CHANGING_S) == PERIOD_S


def test_a_change_that_stays_is_the_new_rest() -> None:
    pace = at_rest()
    loaded = CHANGES["load"]
    assert next_s(pace, loaded, 101.0) == PERIOD_S
    assert next_s(pace, loaded, 101.0 + CHANGING_S) == REST_S


def test_a_worker_whose_use_was_not_measured_is_not_at_work() -> None:
    unknown = replace(IDLE, workers=(replace(IDLE.workers[0], cpu_cores=None),))
    assert next_s(at_rest(), unknown, 101.0) == REST_S


def test_a_load_that_creeps_is_one_in_the_end() -> None:
    pace = at_rest()
    found = [next_s(pace, replace(IDLE, cpu_used_cores=0.1 + 0.15 * n), 100.0 + n) for n in range(1, 4)]
    assert found == [REST_S, REST_S, PERIOD_S]


def test_a_load_that_nobody_measures_is_no_change() -> None:
    blind, pace = replace(IDLE, cpu_used_cores=None), Sampling(period_s=PERIOD_S)
    assert next_s(pace, blind, 100.0) == PERIOD_S
    assert next_s(pace, blind, 100.0 + CHANGING_S) == REST_S


def test_work_that_is_told_begins_the_quick_pace() -> None:
    pace = at_rest()
    pace.hurry(101.0)
    assert next_s(pace, IDLE, 101.0) == PERIOD_S
    assert next_s(pace, IDLE, 101.0 + CHANGING_S) == REST_S


def test_a_radio_is_measured_often_at_all_times() -> None:
    pace = at_rest()
    assert pace.next_s(IDLE, (LinkSample(source=LinkSource.NL80211),), 101.0, is_watched=False) == PERIOD_S
