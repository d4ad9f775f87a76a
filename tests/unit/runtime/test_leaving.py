"""A daemon's way out: how long it waits, for what, and what it says."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import pytest

from zsched.runtime.leaving import ANEW_S, FINISH_S, HAND_OVER_S, LEAVE_S, NOBODY_S, TWICE_S, Leaving, Told

OWNED = ("map", "plan")


def asked(owned: tuple[str, ...] = OWNED) -> Leaving:
    leaving = Leaving()
    assert not leaving.is_over(owned, owned, 99.0), "nobody has asked"
    assert leaving.ask(owned, 100.0)
    return leaving


def test_who_owns_nothing_leaves_at_once() -> None:
    assert asked(()).is_over((), (), 100.0)


def test_an_owner_waits_until_its_tasks_have_moved_and_a_little_longer() -> None:
    leaving = asked()
    assert not leaving.is_over(OWNED, OWNED, 100.5)
    assert not leaving.is_over((), (), 101.0)
    assert not leaving.is_over((), (), 101.0 + LEAVE_S - 0.01)
    assert leaving.is_over((), (), 101.0 + LEAVE_S)
    assert leaving.last_words((), 101.0 + LEAVE_S) == ""


def test_a_task_that_comes_back_meanwhile_is_waited_for_again() -> None:
    leaving = asked()
    assert not leaving.is_over((), (), 100.5)
    assert not leaving.is_over(OWNED, OWNED, 101.0)
    assert not leaving.is_over((), (), 101.2)
    assert leaving.is_over((), (), 101.2 + LEAVE_S)


def test_tasks_that_another_could_take_are_waited_for_longer_than_those_that_nobody_can() -> None:
    for movable, wait_s in ((OWNED[:1], HAND_OVER_S), ((), NOBODY_S)):
        leaving = asked()
        assert not leaving.is_over(OWNED, movable, 100.0 + wait_s - 0.01)
        assert leaving.is_over(OWNED, movable, 100.0 + wait_s)


def test_a_daemon_that_begins_anew_waits_longer_for_the_move() -> None:
    leaving = Leaving()
    leaving.ask(OWNED, 100.0, begins_anew=True)
    assert not leaving.is_over(OWNED, OWNED, 100.0 + ANEW_S - 0.01)
    assert leaving.is_over(OWNED, OWNED, 100.0 + ANEW_S)
    assert leaving.is_over(OWNED, (), 100.0 + NOBODY_S), "nobody can take them"


@pytest.mark.parametrize("is_first", [True, False])
def test_who_is_told_to_end_does_not_begin_anew_whichever_came_first(is_first: bool) -> None:
    for keeps_relay in (False, True):
        told = Told()
        steps: list[Callable[[], None]] = [told.begin_anew, partial(told.stop, keeps_relay=keeps_relay)]
        for step in reversed(steps) if is_first else steps:
            step()
        assert (told.begins_anew, told.keeps_relay) == (False, keeps_relay)


def test_a_process_that_begins_anew_leaves_its_relay_to_the_next() -> None:
    told = Told()
    assert (told.begins_anew, told.keeps_relay) == (False, False)
    told.begin_anew()
    assert (told.begins_anew, told.keeps_relay) == (True, True)


def test_a_daemon_that_begins_anew_lets_its_worker_finish() -> None:
    for begins_anew, wait_s in ((True, FINISH_S), (False, LEAVE_S)):
        leaving = Leaving()
        leaving.ask(OWNED, 100.0, begins_anew=begins_anew)
        assert not leaving.is_over((), (), 101.0, finishing=OWNED)
        assert not leaving.is_over((), (), 100.99 + wait_s, finishing=OWNED)
        assert leaving.is_over((), (), 101.0 + wait_s, finishing=OWNED)
    leaving = Leaving()
    leaving.ask(OWNED, 100.0, begins_anew=True)
    assert not leaving.is_over((), (), 101.0, finishing=OWNED)
    assert leaving.is_over((), (), 101.0 + LEAVE_S), "it has finished"


@pytest.mark.parametrize("after_s", [TWICE_S / 3, 2.0])
def test_a_daemon_that_is_stopped_while_it_begins_anew_is_told_so_for_the_first_time(after_s: float) -> None:
    """It went at once, or waited for longer than systemd does."""
    leaving, told_at = Leaving(), 100.0 + after_s
    assert leaving.ask(OWNED, 100.0, begins_anew=True)
    assert leaving.ask(OWNED, told_at)
    assert not leaving.is_over(OWNED, OWNED, told_at + HAND_OVER_S - 0.01)
    assert leaving.is_over(OWNED, OWNED, told_at + HAND_OVER_S)
    assert "after 3.0 s (map, plan): nobody has taken over" in leaving.last_words(OWNED, told_at + HAND_OVER_S)
    assert not leaving.is_over((), (), told_at + 1.0, finishing=OWNED)
    assert leaving.is_over((), (), told_at + 1.0 + LEAVE_S, finishing=OWNED), "its worker has no more time than that"
    assert not leaving.ask(OWNED, told_at + TWICE_S + 0.01)
    assert leaving.is_over(OWNED, OWNED, told_at + TWICE_S + 0.01), "now it was told twice"
