"""CPU time per answer, from sums that rise."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from zsched.core.gateway.spending import LEAST_ANSWERS, MEAN_S, Spending

Counts = dict[str, float]


def looked_at(until_s: int, spent_s: Callable[[float], float], counts: Callable[[float], Counts]) -> Spending:
    """After a look a second at these sums."""
    spending = Spending()
    for at in range(until_s + 1):
        spending.absorb(spent_s(at), tuple(sorted(counts(at).items())), float(at))
    return spending


def test_what_was_spent_and_answered_before_the_first_look_counts_nothing() -> None:
    spending = looked_at(10, lambda at: 500.0 + 0.4 * at, lambda at: {"robot1": 9000.0 + 2.0 * at})
    assert spending.per_answer_s == pytest.approx(0.2)


def test_few_answers_tell_nothing() -> None:
    first = LEAST_ANSWERS / 0.5 + 1  # the first one is where it begins
    for until_s in (int(first), int(first) + 1):
        spending = looked_at(until_s, lambda at: at, lambda at: {"robot1": 0.5 * at})
        assert (spending.per_answer_s is None) is (until_s == int(first)), "the oldest count a little less"
    assert looked_at(3600, lambda at: at, lambda at: {"robot1": 0.05 * at}).per_answer_s is None


def test_a_worker_of_whole_jobs_is_seen_as_one_that_does_a_bit_at_a_time() -> None:
    """One job of 2 s every 5 s: it uses a core or nothing."""
    spending = looked_at(
        60, lambda at: 2.0 * (at // 5) + min(at % 5, 2.0), lambda at: {"robot1": math.floor((at + 3) / 5)}
    )
    assert spending.per_answer_s == pytest.approx(2.0, rel=0.1)


@pytest.mark.parametrize("late_s", [0.0, 0.3, 0.9])
def test_counts_that_are_older_than_what_was_spent_tell_the_same_at_every_look(late_s: float) -> None:
    """Looks are twice a second, each robot counts once a second at a time of its own: a sum of seconds is not even."""
    spending, told = Spending(), 0
    for at in (look / 2 for look in range(60)):
        counts = (("robot1", 4.0 * math.floor(at - late_s)), ("robot2", 4.0 * math.floor(at - 0.6)))
        spending.absorb(1.6 * at, counts, at)
        if spending.per_answer_s is not None:
            told += 1
            assert spending.per_answer_s == pytest.approx(0.2, rel=0.001)
    assert told > 50


@pytest.mark.parametrize("is_known", [True, False], ids=["that it knew", "that has just come"])
def test_another_robot_is_the_clock_when_the_first_one_has_no_more_answers(is_known: bool) -> None:
    def counts(at: float) -> Counts:
        first = {"robot1": 2.0 * min(at, 30.0)} if at <= 30 or is_known else {}
        return first | ({"robot2": 2.0 * at} if at > 30 or is_known else {})

    def spent_s(at: float) -> float:
        return (0.8 if is_known else 0.4) * at + (0.0 if is_known else 0.4 * max(at - 30.0, 0.0))

    assert looked_at(30, spent_s, counts).per_answer_s == pytest.approx(0.2, rel=0.05)
    told = [looked_at(until_s, spent_s, counts).per_answer_s for until_s in range(37, 45)]
    assert len(set(told)) == len(told), "at each of its rises"
    assert looked_at(30 + int(4 * MEAN_S), spent_s, counts).per_answer_s == pytest.approx(0.4, rel=0.05)


def test_a_robot_with_an_answer_in_20_s_stays_the_clock_for_some_of_them() -> None:
    """The other one counts at another time: by its rises what was spent belongs to fewer answers or to more."""
    spending = Spending()
    for at in range(200):
        counts = (("robot1", math.floor(at / 20.0)), ("robot2", math.floor((at + 7.0) / 20.0)))
        spending.absorb(0.02 * at, counts, float(at))
        assert spending.per_answer_s is None or spending.per_answer_s == pytest.approx(0.2, rel=0.001)
    assert spending.per_answer_s is not None


def test_a_robot_that_comes_and_goes_changes_nothing() -> None:
    """Each asks at 2 Hz; the second one has asked another owner before, and starts anew on the way."""

    def spent_s(at: float) -> float:
        return 0.4 * at + 0.4 * max(min(at, 90.0) - 30.0, 0.0)

    def counts(at: float) -> Counts:
        both = {"robot1": 2.0 * at}
        if 30 <= at < 90:
            both["robot2"] = 2.0 * at if at < 60 else 2.0 * (at - 60.0)
        return both

    for until_s in (25, 33, 40, 58, 61, 70, 89, 95, 120):
        assert looked_at(until_s, spent_s, counts).per_answer_s == pytest.approx(0.2, rel=0.05)


def test_an_owner_whose_daemon_starts_again_has_spent_nothing_twice() -> None:
    spending = looked_at(40, lambda at: 0.4 * (at if at < 20 else at - 20.0), lambda at: {"robot1": 2.0 * at})
    assert spending.per_answer_s == pytest.approx(0.2, rel=0.05)


def test_jobs_that_have_become_larger_are_seen_so_in_some_minutes() -> None:
    spending = looked_at(
        60 + int(3 * MEAN_S), lambda at: 0.2 * at + 0.2 * max(at - 60.0, 0.0), lambda at: {"robot1": 2.0 * at}
    )
    assert spending.per_answer_s == pytest.approx(0.2, rel=0.05)
