"""Numbers of one sender: the window, another life, and the way back when somebody has overtaken it."""

from __future__ import annotations

import pytest

from zsched.core.values.sequence import RATE_HZ, RUN, WINDOW, Order, Track


def track(sequence: int = 100, incarnation: int = 7) -> Track:
    one = Track()
    assert one.judge(incarnation, sequence, 10.0, may_begin=False) is Order.NEW
    return one


def judged(one: Track, *numbers: int, at: float = 10.0, incarnation: int = 7) -> list[Order]:
    """Each number, a tenth of a second after the one before."""
    times = enumerate(numbers)
    return [one.judge(incarnation, number, at + index / 10, may_begin=False) for index, number in times]


@pytest.mark.parametrize(
    ("ahead", "after_s", "order"),
    [
        (-1, 0.0, Order.OLD),
        (0, 0.0, Order.OLD),
        (1, 0.0, Order.NEW),
        (WINDOW, 0.0, Order.NEW),
        (WINDOW + 1, 0.0, Order.DOUBTFUL),
        (WINDOW + round(2 * RATE_HZ), 2.0, Order.NEW),
        (WINDOW + round(2 * RATE_HZ) + 1, 2.0, Order.DOUBTFUL),
    ],
)
def test_a_number_is_news_in_a_window_that_grows_with_the_silence(ahead: int, after_s: float, order: Order) -> None:
    assert track().judge(7, 100 + ahead, 10.0 + after_s, may_begin=False) is order


def test_the_window_grows_from_the_last_message_that_counted() -> None:
    one = track()
    assert one.judge(7, 101, 20.0, may_begin=False) is Order.NEW
    assert one.judge(7, 101 + WINDOW + 1, 20.0, may_begin=False) is Order.DOUBTFUL


@pytest.mark.parametrize(
    ("incarnation", "may_begin", "order"),
    [
        (8, True, Order.NEW),
        (6, True, Order.NEW),
        (8, False, Order.DOUBTFUL),
        (6, False, Order.DOUBTFUL),
        (7, True, Order.OLD),  # the same life goes on, it does not begin
    ],
)
def test_another_life_begins_at_once_only_when_the_known_one_is_over(
    incarnation: int, may_begin: bool, order: Order
) -> None:
    assert track().judge(incarnation, 3, 10.1, may_begin=may_begin) is order
    if not may_begin:
        assert track().judge(incarnation, 101, 10.1, may_begin=False) is order, "its number may fit, its life does not"


def test_a_sender_whose_number_was_overtaken_is_believed_again_by_its_third_message() -> None:
    one = track(sequence=1000)  # somebody's forgery
    assert RUN == 3
    assert judged(one, 101, 102, 103) == [Order.OLD, Order.OLD, Order.NEW]
    assert judged(one, 104, 105, at=10.4) == [Order.NEW, Order.NEW]


def test_a_course_is_of_one_life() -> None:
    one = track()
    assert one.judge(8, 1, 10.0, may_begin=False) is Order.DOUBTFUL
    assert one.judge(8, 2, 10.1, may_begin=False) is Order.DOUBTFUL
    assert one.judge(9, 3, 10.2, may_begin=False) is Order.DOUBTFUL
    assert one.judge(9, 4, 10.3, may_begin=False) is Order.DOUBTFUL
    assert one.judge(9, 5, 10.4, may_begin=False) is Order.NEW
    assert (one.incarnation, one.sequence) == (9, 5)


def test_a_burst_of_one_moment_makes_no_course() -> None:
    """Frames that are forged, or that a link gives out at once, leave no time for the known course to be heard."""
    one = track()
    burst = [one.judge(8, number, 10.0, may_begin=False) for number in range(6)]
    assert set(burst) == {Order.DOUBTFUL}
    assert one.judge(8, 6, 10.1, may_begin=False) is Order.NEW


def test_a_message_of_the_known_course_ends_the_other_one() -> None:
    one = track()
    assert judged(one, 10**6, 10**6 + 1) == [Order.DOUBTFUL, Order.DOUBTFUL]
    assert judged(one, 101, 10**6 + 2, at=10.3) == [Order.NEW, Order.DOUBTFUL]


def test_a_repeat_of_the_newest_does_not_interrupt_the_way_back() -> None:
    """Whoever has forged the newest number must not keep the real sender out by saying it again and again."""
    one = track(sequence=1000)
    assert judged(one, 101, 1000, 102, 1000, 103) == [Order.OLD, Order.OLD, Order.OLD, Order.OLD, Order.NEW]
    assert one.judge(7, 1000, 10.6, may_begin=False) is Order.DOUBTFUL
