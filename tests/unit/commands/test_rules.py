"""What `zsched check` says of a task's settings: all of them, in words, and true."""

from __future__ import annotations

from dataclasses import replace

import pytest

from support.fleets import task_of, tuning_of
from zsched.commands.rules import told
from zsched.config.schema import LINK_LIMITS, SCHEDULING
from zsched.core.scheduler.ledger import left_after_s
from zsched.core.scheduler.utility import total_utility
from zsched.core.values.fleet import Demand, LinkLimits, TaskSpec, Timing
from zsched.core.values.model import PairReading, ScoreForm, Weights
from zsched.core.values.plan import ReadyWhen

TIMING = Timing()
RADIO = tuning_of(cpu=0.5, memory=0.2, network=0.3, score=ScoreForm.SERVICE, bonus=0.05)
SPEC = task_of(tuning=RADIO, price_s=0.3)
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
        (SPEC, "once its own one owes 0.3 s more (price_s)"),
        (SPEC, "half of it forgotten in 1000 s (memory_s), and will lose in 1.5 s"),
        (SPEC, "counts 0.05 more (bonus)"),
        (SPEC, "by 0.5 after about 0.28 s; by 0.1 after about 7.8 s"),
        (replace(SPEC, tuning=replace(RADIO, bonus=0.2)), "; by 0.1 never"),
        (SPEC, "below -80 dBm (link.nu_dbm)"),
        (replace(SPEC, gauge_limits=(("battery", 0.2),)), "the battery's charge below 20 % is left, or not taken"),
        (replace(SPEC, gauge_limits=(("gpu", 0.8),)), "above 80 % is not taken, an owner stays (limits.gpu)"),
        (
            replace(SPEC, gauge_limits=(("gpu", 0.8),), demand=Demand(gpu=0.3)),
            "the use of the freest GPU above 80 % is left, or not taken",
        ),
        (replace(SPEC, limits=LinkLimits(pair=PairReading.WEAKER)), "the weaker of the two ways counts"),
        (SPEC, "(objective: service)"),
        (SPEC, "by 1 % for cpu, 0.4 % for memory, 0.6 % for network (weights: cpu 0.5, memory 0.2, network 0.3)"),
        (replace(SPEC, tuning=replace(RADIO, score=ScoreForm.PAPER)), "the terms are added, each times its weight"),
        (SPEC, "smoothing and the price alone: sampling, gathering, the vote and the commit come on top"),
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
    text = words(task_of(price_s=0.3))
    assert "link.nu_dbm" in text
    assert "link.rho_dbm" not in text


def test_the_time_to_leave_grows_with_price_and_smoothing_and_falls_with_the_lead() -> None:
    by_price = [left_after_s(0.45, price_s, 0.3) for price_s in (0.0, 0.3, 1.0, 3.0)]
    assert by_price == sorted(set(by_price))
    assert left_after_s(0.45, 0.3, 3.0) > by_price[1]
    assert left_after_s(0.15, 0.3, 0.3) > by_price[1] > left_after_s(0.85, 0.3, 0.3)


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


def test_staying_costs_the_lead_beyond_the_bonus_each_second_and_that_of_the_seconds_ahead_counts_at_once() -> None:
    """0.05 of a second in a second: 0.075 s are ahead, and half a price that the others owe."""
    assert left_after_s(0.05, 0.3, 0.01) == pytest.approx(7.5, abs=0.1)
