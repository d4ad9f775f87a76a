"""For how long a machine is avoided that disappointed for no visible cause. Times are written out: users feel them."""

from __future__ import annotations

import pytest

from zsched.core.doubt import Doubt


def tried_again(doubt: Doubt, count: int) -> list[float]:
    """Each trial fails at once; for how long the machine is avoided after it."""
    pauses = []
    for _ in range(count):
        now = doubt.seen_at + doubt.for_s
        assert not doubt.is_over(now - 0.01)
        assert doubt.is_over(now)
        doubt.see(now)
        pauses.append(doubt.for_s)
    return pauses


def test_each_trial_that_fails_doubles_the_time_up_to_an_hour() -> None:
    doubt = Doubt(seen_at=100.0)
    assert doubt.for_s == 60.0
    assert tried_again(doubt, 7) == [120.0, 240.0, 480.0, 960.0, 1920.0, 3600.0, 3600.0]


def test_what_is_seen_without_a_trial_lengthens_nothing() -> None:
    doubt = Doubt(seen_at=0.0)
    for now in (1.0, 30.0, 59.0):
        doubt.see(now)
    assert (doubt.for_s, doubt.seen_at) == (60.0, 59.0)


@pytest.mark.parametrize(
    ("kept_s", "for_s"), [(0, 480.0), (599, 480.0), (600, 240.0), (1199, 240.0), (1200, 120.0), (9000, 60.0)]
)
def test_ten_minutes_of_kept_promises_halve_the_time(kept_s: int, for_s: float) -> None:
    doubt = Doubt(seen_at=0.0)
    tried_again(doubt, 2)  # 240 s
    start = doubt.seen_at + doubt.for_s
    for second in range(kept_s + 1):
        doubt.keep(start + second)
    doubt.see(start + kept_s + 1.0)
    assert doubt.for_s == for_s


@pytest.mark.parametrize(("gap_s", "for_s"), [(5.0, 60.0), (5.1, 120.0)])
def test_two_looks_too_far_apart_prove_nothing_of_the_time_between(gap_s: float, for_s: float) -> None:
    doubt = Doubt(seen_at=0.0)
    for look in range(2000):
        doubt.keep(60.0 + gap_s * look)
    doubt.see(60.0 + gap_s * 2000)
    assert doubt.for_s == for_s


def test_what_was_kept_before_it_was_seen_again_counts_no_more() -> None:
    doubt = Doubt(seen_at=0.0)
    for second in range(650):
        doubt.keep(60.0 + second)
    doubt.see(710.0)
    assert doubt.for_s == 60.0
    doubt.keep(771.0)
    doubt.keep(772.0)
    doubt.see(773.0)
    assert doubt.for_s == 120.0
