"""What is away again and again: when it has been for too long in all, and what is forgiven."""

from __future__ import annotations

import pytest

from zsched.core.absence import FORGIVEN_RATIO, Absences

LIMIT_S = 10.0


def looked(absences: Absences, *turns: tuple[bool, float], start: float = 0.0) -> list[float]:
    """The longest absence that is told in each turn (whether it is away, for how many seconds)."""
    longest, now = list[float](), start
    for is_away, for_s in turns:
        told = [absences.look(is_away, now + 0.5 * step, LIMIT_S) for step in range(round(for_s / 0.5))]
        longest.append(max(told))
        now += for_s
    return longest


def test_an_absence_is_told_as_long_as_it_is_and_what_is_there_is_not_away() -> None:
    absences = Absences()
    assert looked(absences, (False, 5.0), (True, 8.0), (False, 5.0)) == [0.0, 7.5, 0.0]
    assert absences.since is None
    assert absences.total_s == 8.0


def test_what_is_more_than_the_limit_in_all_counts_to_the_next_absence() -> None:
    turns = ((True, 9.0), (False, 1.0)) * 4
    assert looked(Absences(), *turns)[::2] == pytest.approx([8.5, 8.5, 8.5 + 7.8, 8.5 + LIMIT_S - FORGIVEN_RATIO])


def test_one_long_absence_takes_nothing_from_the_next() -> None:
    turns = (True, 500.0), (False, 1.0), (True, 9.0)
    assert looked(Absences(), *turns)[2] == 8.5


def test_ten_times_as_long_there_forgives_an_absence_and_the_limit_bounds_what_is_to_be_forgiven() -> None:
    turns = ((True, 9.0), (False, 90.5))
    assert looked(Absences(), *(turns * 5))[::2] == [8.5] * 5
    often = Absences()
    looked(often, *(((True, 30.0), (False, 1.0)) * 100))
    assert often.held_s(LIMIT_S) == pytest.approx(LIMIT_S)
    back_at = 3100.0 - 1.0
    assert often.is_held(back_at + 99.0, LIMIT_S)
    assert not often.is_held(back_at + 100.0, LIMIT_S)


def test_it_is_held_only_by_more_than_the_limit() -> None:
    absences = Absences()
    looked(absences, (True, 10.0), (False, 0.5))
    assert not absences.is_held(10.0, LIMIT_S)
