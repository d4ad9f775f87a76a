"""Which threads of a worker would use a whole core: by looks at how long each of them has run and waited."""

from __future__ import annotations

import math

import pytest

from zsched.core.profile.appetite import ALWAYS, APPETITE_S, Appetite, Thread

HUNGRY, CALM, NEW = (7, "hungry"), (7, "calm"), (7, "new")


def looked(seconds: int, *, with_new: bool = False) -> Appetite:
    """Threads that were looked at once a second: one runs half of the time and waits for the rest, one runs seldom."""
    appetite = Appetite()
    for now in range(1, seconds + 1):
        known: dict[Thread, tuple[float, float]] = {HUNGRY: (0.5 * now, 0.5 * now), CALM: (0.1 * now, 0.0)}
        appetite.look({NEW: (0.0, 0.0), **known} if with_new and now == seconds else known, float(now))
    return appetite


def test_a_thread_that_runs_or_waits_all_the_time_wants_a_core_and_the_others_what_they_use() -> None:
    assert looked(20).wanted_cores() == pytest.approx(1.1, abs=0.01)


def test_who_runs_or_waits_counts_as_of_the_last_look() -> None:
    assert Appetite().runnable is None
    assert looked(1).runnable is None, "since when nobody knows"
    assert looked(2).runnable == pytest.approx(1.1)
    assert looked(20).runnable == pytest.approx(1.1)
    assert looked(20, with_new=True).runnable == pytest.approx(1.1)
    appetite = looked(20)
    appetite.look({HUNGRY: (11.0, 10.0)}, 22.0)
    assert appetite.runnable == pytest.approx(0.5), "one has ended, and the other one rests since a second"


def test_a_thread_that_has_been_busy_for_a_moment_wants_no_core_yet() -> None:
    assert looked(1).wanted_cores() is None
    assert looked(1 + round(APPETITE_S)).wanted_cores() is None


def test_a_look_at_the_same_moment_changes_nothing() -> None:
    appetite = looked(20)
    appetite.look({HUNGRY: (1e6, 1e6)}, 20.0)
    assert appetite.wanted_cores() == looked(20).wanted_cores()


def look(appetite: Appetite, half_s: float, now: float) -> float | None:
    """A thread runs and waits for so long each, and never rests."""
    appetite.look({HUNGRY: (half_s, half_s)}, now)
    return appetite.wanted_cores()


@pytest.mark.parametrize("every_s", [0.05, 0.25, 0.4])
def test_a_thread_that_never_rests_is_known_at_the_first_look_after_its_time(every_s: float) -> None:
    """Its share rises from nothing: to 0.9 in 2.3 time constants."""
    appetite, number = Appetite(), 0
    needed = math.ceil(-APPETITE_S * math.log(1.0 - ALWAYS) / every_s)
    while look(appetite, 0.5 * every_s * number, 100.0 + every_s * number) is None:
        number += 1
        assert number <= needed
    assert number == needed
