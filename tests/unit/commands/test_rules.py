"""What `zsched check` says of a task's settings: all of them, in words, and true."""

from __future__ import annotations

from dataclasses import replace

import pytest

from support.fleets import task_of, tuning_of
from zsched.commands.look.check import told
from zsched.config.schema import LINK_LIMITS, SCHEDULING
from zsched.core.scheduler.ledger import left_after_s
from zsched.core.values.fleet import TaskSpec, Timing
from zsched.core.values.model import Reach, ScoreForm
from zsched.core.values.plan import ReadyWhen

TIMING = Timing()
RADIO = tuning_of(cpu=0.5, memory=0.2, network=0.3, score=ScoreForm.SERVICE, bonus=0.05)
SPEC = task_of(tuning=RADIO, price_s=0.3)


def words(spec: TaskSpec) -> str:
    return "\n".join(told(spec, TIMING))


def test_every_setting_that_differs_from_its_default_is_named_with_its_key() -> None:
    beside = (("plan", 0.2), ("watch", -0.3))
    most = replace(SPEC, prefer=(("edge1", 0.1),), beside=beside, priority=2)
    of_all = words(replace(most, tuning=replace(RADIO, deadline_ms=80.0)))
    keys = [*SCHEDULING.items, *(f"link.{key}" for key in LINK_LIMITS.items)]
    assert [key for key in keys if f"({key}" not in of_all] == ["objective"]


@pytest.mark.parametrize(
    ("spec", "said"),
    [
        (SPEC, "once its own one owes 0.3 s more (price_s)"),
        (SPEC, "half of it forgotten in 1000 s (memory_s), and will lose in 1.5 s"),
        (SPEC, "leads by 0.05 when all is equal (bonus)"),
        (SPEC, "0.5 in 0.28 s, 0.2 in 1.8 s, 0.1 in 7.8 s"),
        (replace(SPEC, tuning=replace(RADIO, bonus=0.2)), "0.1 never"),
        (SPEC, "below -80 dBm (link.nu_dbm), or -77 while its own one is reached"),
        (replace(SPEC, gauge_limits=(("battery", 0.2),)), "the battery's charge is below 20 % (limits.battery)"),
        (SPEC, "cpu 0.5 x memory 0.2 x network 0.3 (weights)"),
        (replace(SPEC, tuning=replace(RADIO, score=ScoreForm.PAPER)), "cpu 0.5 + memory 0.2 + network 0.3 (weights)"),
        (replace(SPEC, tuning=replace(RADIO, deadline_ms=80.0)), "done there within 80 ms (deadline_ms)"),
        (replace(SPEC, prefer=(("edge1", 0.1),)), "0.1 more on edge1 (prefer)"),
        (replace(SPEC, beside=(("plan", 0.2), ("watch", -0.3))), "0.2 more beside plan (together)"),
        (replace(SPEC, beside=(("plan", 0.2), ("watch", -0.3))), "0.3 less beside watch (spread)"),
        (replace(SPEC, priority=2), "tasks below 2 use counts as free (priority)"),
        (replace(SPEC, reach=Reach.ALL), "; a robot cannot reach it (reach)"),
    ],
)
def test_a_setting_is_told_by_what_it_does(spec: TaskSpec, said: str) -> None:
    assert said in words(spec), words(spec)
    assert len(told(spec, TIMING)) == 4


def test_a_deadline_is_told_where_the_worker_tells_of_its_jobs() -> None:
    timed = replace(SPEC, tuning=replace(RADIO, deadline_ms=80.0))
    foreign = replace(timed, worker=replace(timed.worker, ready_when=ReadyWhen.MATCHING))
    assert ["(deadline_ms)" in words(one) for one in (timed, foreign)] == [True, False]


def test_a_task_that_does_not_weigh_the_network_is_told_of_its_reach_alone() -> None:
    text = words(task_of(price_s=0.3))
    assert "link.nu_dbm" in text
    assert "link.rho_dbm" not in text


def test_the_time_to_leave_grows_with_price_and_smoothing_and_falls_with_the_lead() -> None:
    by_price = [left_after_s(0.45, price_s, 0.3) for price_s in (0.0, 0.3, 1.0, 3.0)]
    assert by_price == sorted(set(by_price))
    assert left_after_s(0.45, 0.3, 3.0) > by_price[1]
    assert left_after_s(0.15, 0.3, 0.3) > by_price[1] > left_after_s(0.85, 0.3, 0.3)


def test_staying_costs_the_lead_beyond_the_bonus_each_second_and_that_of_the_seconds_ahead_counts_at_once() -> None:
    """0.05 of a second in a second: 0.075 s are ahead, and half a price that the others owe."""
    assert left_after_s(0.05, 0.3, 0.01) == pytest.approx(7.5, abs=0.1)
