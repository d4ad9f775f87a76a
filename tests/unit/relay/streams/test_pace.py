"""Thinning out: the rate that is let through, and that the newest is never lost."""

from __future__ import annotations

import pytest

from zsched.relay.streams import pace
from zsched.relay.streams.pace import Pace


@pytest.mark.parametrize(("hz", "max_hz", "expected"), [(30.0, 20.0, 200), (100.0, 10.0, 100), (5.0, 10.0, 50)])
def test_on_average_at_most_the_highest_rate_passes(hz: float, max_hz: float, expected: int) -> None:
    made: Pace[int] = Pace(max_hz, remembers=False)
    passed = sum(made.passes("k", n, n / hz) for n in range(int(10 * hz)))
    assert expected - 2 <= passed <= expected + 2


def test_a_pause_earns_no_burst() -> None:
    made: Pace[int] = Pace(10.0, remembers=False)
    assert made.passes("k", 0, 0.0)
    assert [made.passes("k", n, 100 + n / 1000) for n in range(50)].count(True) <= 2


def test_keys_do_not_wait_for_each_other() -> None:
    made: Pace[int] = Pace(1.0, remembers=True)
    assert made.passes("a", 1, 0.0)
    assert made.passes("b", 1, 0.0)
    assert not made.passes("a", 2, 0.1)


def test_the_newest_that_was_passed_over_goes_on_when_it_may() -> None:
    made: Pace[int] = Pace(1.0, remembers=True)
    assert [made.passes("k", n, n / 10) for n in range(4)] == [True, False, False, False]
    assert made.overdue(0.9) == []
    assert made.overdue(1.1) == [3]
    assert made.overdue(9.0) == []
    assert not made.passes("k", 4, 1.2)


def test_what_is_remembered_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pace, "MAX_KEYS", 3)
    made: Pace[int] = Pace(1.0, remembers=True)
    for n in range(10):
        assert made.passes(str(n), n, 0.0)
        made.passes(str(n), n, 0.1)
    assert len(made.overdue(5.0)) <= 4


def test_keys_that_come_and_go_take_no_live_key_its_newest_value(monkeypatch: pytest.MonkeyPatch) -> None:
    """The key that had come first gave way, though it had passed last, and what was held back of it with it."""
    monkeypatch.setattr(pace, "MAX_KEYS", 3)
    made: Pace[str] = Pace(1.0, remembers=True)
    assert made.passes("map", "old", 0.0)
    for n in range(2):
        assert made.passes(str(n), "x", 0.5)
    assert made.passes("map", "newer", 1.0)
    assert not made.passes("map", "newest", 1.1)
    assert made.passes("one more", "x", 1.2)
    assert made.overdue(5.0) == ["newest"]
