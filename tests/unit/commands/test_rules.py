"""What `zsched check` says of a task's settings: all of them, in words, and true."""

from __future__ import annotations

import pytest

from zsched.commands.look.check import told
from zsched.core.scheduler.ledger import left_after_s
from zsched.core.values.fleet import TaskSpec, Timing

TIMING = Timing()


def words(spec: TaskSpec) -> str:
    return "\n".join(told(spec, TIMING))


def test_the_time_to_leave_grows_with_price_and_smoothing_and_falls_with_the_lead() -> None:
    by_price = [left_after_s(0.45, price_s, 0.3) for price_s in (0.0, 0.3, 1.0, 3.0)]
    assert by_price == sorted(set(by_price))
    assert left_after_s(0.45, 0.3, 3.0) > by_price[1]
    assert left_after_s(0.15, 0.3, 0.3) > by_price[1] > left_after_s(0.85, 0.3, 0.3)


def test_staying_costs_the_lead_beyond_the_bonus_each_second_and_that_of_the_seconds_ahead_counts_at_once() -> None:
    """0.05 of a second in a second: 0.075 s are ahead, and half a price that the others owe."""
    assert left_after_s(0.05, 0.3, 0.01) == pytest.approx(7.5, abs=0.1)
