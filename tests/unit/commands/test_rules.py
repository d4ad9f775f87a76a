"""What `zsched check` says of a task's settings: all of them, in words, and true."""

from __future__ import annotations

from dataclasses import replace

import pytest

from support.fleets import task_of, tuning_of
from zsched.commands.rules import LONGEST_S, left_after_s, told
from zsched.config.schema import LINK_LIMITS, SCHEDULING
from zsched.core.scheduler.utility import total_utility
from zsched.core.values.fleet import Demand, LinkLimits, TaskSpec, Timing
from zsched.core.values.model import PairReading, ScoreForm, Weights
from zsched.core.values.plan import ReadyWhen

TIMING = Timing()
RADIO = tuning_of(cpu=0.5, memory=0.2, network=0.3, score=ScoreForm.SERVICE, bonus=0.05)
SPEC = task_of(tuning=RADIO, patience=0.3)
GAUGED = task_of(tuning=replace(RADIO, weights=Weights.of({"cpu": 0.4, "battery": 0.4, "gpu": 0.2})))


def words(spec: TaskSpec) -> str:
    return "\n".join(told(spec, TIMING))


def test_every_setting_is_named_with_its_key() -> None:
    of_all = words(SPEC) + words(replace(SPEC, tuning=replace(RADIO, deadline_ms=80.0)))
    keys = [*SCHEDULING.items, *(f"link.{key}" for key in LINK_LIMITS.items)]
    assert [key for key in keys if f"({key}" not in of_all] == []


@pytest.mark.parametrize(
    ("spec", "said"),
    [
        (SPEC, "leads by more than 0.05 (bonus) and staying has cost 0.3 s of its work (patience)"),
        (replace(SPEC, patience=0.0), "leads by more than 0.05 (bonus) and that is seen once (patience: 0)"),
        (replace(SPEC, learns_patience=True), "at first, 0.33 to 3.7 s by what it has learnt; by 0.1"),
        (replace(SPEC, tuning=replace(RADIO, bonus=0.2)), "; by 0.1 never"),
        (SPEC, "below -80 dBm (link.nu_dbm)"),
        (replace(SPEC, gauge_limits=(("battery", 0.2),)), "the battery's charge below 20 % is left, or not taken"),
        (replace(SPEC, gauge_limits=(("gpu", 0.8),)), "above 80 % is not taken, an owner stays (limits.gpu)"),
        (
            replace(SPEC, gauge_limits=(("gpu", 0.8),), demand=Demand(gpu=0.3)),
            "the use of the freest GPU above 80 % is left, or not taken",
        ),
        (SPEC, "signals count as they are (link.foresee_s)"),
        (replace(SPEC, limits=LinkLimits(foresee_s=3.0)), "as they will be in 3 s, at most 6 dB away (link.foresee_s)"),
        (replace(SPEC, limits=LinkLimits(pair=PairReading.WEAKER)), "the weaker of the two ways counts"),
        (SPEC, "(objective: service)"),
        (SPEC, "staying has cost 0.3 s of its work (patience); a second costs the lead beyond the bonus"),
        (SPEC, "by 1 % for cpu, 0.4 % for memory, 0.6 % for network (weights: cpu 0.5, memory 0.2, network 0.3)"),
        (replace(SPEC, tuning=replace(RADIO, score=ScoreForm.PAPER)), "the terms are added, each times its weight"),
        (SPEC, "smoothing and patience alone: sampling, gathering, the vote and the commit come on top"),
        (replace(SPEC, tuning=replace(RADIO, deadline_ms=80.0)), "its fair share if that is more"),
        (GAUGED, "by 1 % for cpu, 1 % for battery, 0.5 % for gpu (weights: cpu 0.4, memory 0, network 0, battery 0.4"),
        (GAUGED, "the term of gpu is the use of the freest GPU, 1 at 0 % and 0 at 100 %; a machine where it is not"),
        (GAUGED, "not measured cannot have the task while another one has it"),
        (GAUGED, "the term of battery is the battery's charge, 1 at 100 % and 0 at 0 %; a machine where it is not"),
        (GAUGED, "not measured counts 1"),
    ],
)
def test_a_setting_is_told_by_what_it_does(spec: TaskSpec, said: str) -> None:
    assert said in words(spec), words(spec)


def test_a_floor_is_told_only_where_what_it_is_of_is_weighed() -> None:
    floors = replace(SPEC, cpu_floor_ratio=0.1)
    both, cpu, memory = (
        words(replace(floors, tuning=replace(RADIO, weights=Weights.of(weights))))
        for weights in ({"cpu": 0.5, "memory": 0.5}, {"cpu": 1.0}, {"memory": 1.0})
    )
    assert ["(memory_floor_ratio)" in text for text in (both, cpu, memory)] == [True, False, True]
    assert ["(cpu_floor_ratio)" in text for text in (both, cpu, memory)] == [True, True, False]
    assert "(cpu_floor_ratio: 0)" not in memory


def test_a_deadline_is_told_where_the_worker_tells_of_its_jobs() -> None:
    timed = replace(SPEC, tuning=replace(RADIO, deadline_ms=80.0))
    assert "by its worker's word of its jobs (CPU per job" in words(timed)
    foreign = replace(timed, worker=replace(timed.worker, ready_when=ReadyWhen.MATCHING))
    assert "(objective: service)" in words(foreign)


def test_a_task_that_does_not_weigh_the_network_is_told_of_its_reach_alone() -> None:
    text = words(task_of(patience=0.3))
    assert "link.nu_dbm" in text
    assert "link.rho_dbm" not in text


def test_the_time_to_leave_grows_with_patience_and_smoothing_and_falls_with_the_lead() -> None:
    by_patience = [left_after_s(0.5, 0.05, patience, TIMING) for patience in (0.0, 0.15, 0.5)]
    assert by_patience == sorted(set(by_patience))
    assert left_after_s(0.5, 0.05, 0.15, replace(TIMING, smoothing_s=3.0)) > by_patience[1]
    assert left_after_s(0.2, 0.05, 0.15, TIMING) > by_patience[1] > left_after_s(0.9, 0.05, 0.15, TIMING)


def test_a_lead_that_is_added_up_for_ever_is_told_as_an_hour() -> None:
    assert left_after_s(0.0501, 0.05, 1000.0, TIMING) == pytest.approx(LONGEST_S, abs=1.0)


def test_what_a_weight_does_is_what_the_score_does() -> None:
    """By how many percent the worth falls with a term, as it is told."""
    weights = Weights.of({"cpu": 0.5, "memory": 0.2, "network": 0.3})
    measured = frozenset({"cpu", "memory", "network"})
    terms = {"cpu": 0.8, "memory": 0.6, "network": 0.7}
    for name, told_falls in (("cpu", 1.0), ("memory", 0.4), ("network", 0.6)):
        values = []
        for one in (terms, {**terms, name: 0.99 * terms[name]}):
            cpu, memory, network = one["cpu"], one["memory"], one["network"]
            form = ScoreForm.SERVICE
            value = total_utility(weights, cpu=cpu, memory=memory, network=network, measured=measured, form=form)
            assert value is not None
            values.append(value)
        was, is_now = values
        assert 100.0 * (1.0 - is_now / was) == pytest.approx(told_falls, rel=0.01)


def test_the_lead_that_a_second_of_staying_costs_is_that_beyond_the_bonus() -> None:
    """The example of the fleet file's reference: 0.1 under a bonus of 0.05 reaches 0.3 in 6 s."""
    at_once = replace(TIMING, smoothing_s=0.001)
    assert left_after_s(0.1, 0.05, 0.3, at_once) == pytest.approx(6.0, abs=0.1)
