"""What is away again and again: when it has been for too long in all, and what is forgiven."""

from __future__ import annotations

import math

import pytest

from zsched.core.values.absence import FORGIVEN_RATIO, Absences

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
    expected = [8.5, 8.5, 8.5 + 8.0 - 2 * FORGIVEN_RATIO, 8.5 + LIMIT_S - FORGIVEN_RATIO]
    assert looked(Absences(), *turns)[::2] == pytest.approx(expected)


def test_one_long_absence_takes_nothing_from_the_next() -> None:
    turns = (True, 500.0), (False, 1.0), (True, 9.0)
    assert looked(Absences(), *turns)[2] == 8.5


@pytest.mark.parametrize("ratio", [FORGIVEN_RATIO, 0.1])
def test_time_in_which_it_is_there_forgives_a_part_and_the_limit_bounds_what_is_to_be_forgiven(ratio: float) -> None:
    turns = ((True, 9.0), (False, math.ceil(9.5 / ratio)))
    assert looked(Absences(forgiven_ratio=ratio), *(turns * 5))[::2] == [8.5] * 5
    often = Absences(forgiven_ratio=ratio)
    looked(often, *(((True, 30.0), (False, 1.0)) * 100))
    assert often.held_s(LIMIT_S) == pytest.approx(LIMIT_S)
    back_at = 3100.0 - 1.0
    assert often.is_held(back_at + LIMIT_S / ratio - 1.0, LIMIT_S)
    assert not often.is_held(back_at + LIMIT_S / ratio + 1.0, LIMIT_S)


@pytest.mark.parametrize("is_away", [True, False])
def test_time_of_which_nobody_knows_counts_as_neither(is_away: bool) -> None:
    known, absences = Absences(), Absences()
    for one, gap_s in ((known, 0.0), (absences, 500.0)):
        looked(one, (True, 9.0), (False, 1.0), (True, 9.0), (False, 1.0), (is_away, 3.0))
        one.skip(23.0)
        one.skip(23.0 + gap_s)
        one.look(is_away, 23.0 + gap_s, LIMIT_S)
        one.look(is_away, 24.0 + gap_s, LIMIT_S)
    assert absences.look(True, 525.0, LIMIT_S) == pytest.approx(known.look(True, 25.0, LIMIT_S))
    assert known.held_s(LIMIT_S) > 5.0


def test_it_is_held_only_by_more_than_the_limit() -> None:
    absences = Absences()
    looked(absences, (True, 10.0), (False, 0.5))
    assert not absences.is_held(10.0, LIMIT_S)
