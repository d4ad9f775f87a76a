"""When the fleet is told of a node's relay: not of one end, of a loop of them, and of one that does not come back."""

from __future__ import annotations

from zsched.core.profile.relay_ends import DOWN_TOLD_S, OFTEN, WINDOW_S, RelayEnds
from zsched.core.values.events import RelayChanged
from zsched.core.values.model import MAX_REASON

UP = RelayChanged(is_running=True, reason="pid 7")


def down(reason: str = "exit code -9") -> RelayChanged:
    return RelayChanged(is_running=False, reason=reason)


def test_a_relay_that_is_replaced_at_once_is_no_news() -> None:
    ends = RelayEnds()
    ends.on_changed(UP, 99.0)
    for number in range(OFTEN - 1):
        ends.on_changed(down(), 100.0 + number)
        assert ends.told(100.5 + number) == ""
        ends.on_changed(UP, 100.6 + number)
    assert ends.told(100.0 + DOWN_TOLD_S + OFTEN) == ""


def test_a_relay_that_ends_often_is_told_of_until_its_ends_are_old() -> None:
    ends = RelayEnds()
    for at in (100.0, 110.0, 120.0):
        ends.on_changed(down(f"{at:g}"), at)
        ends.on_changed(UP, at + 0.5)
    assert ends.told(120.5) == "has ended 3 times in 60 s, last: 120"
    assert ends.told(100.0 + WINDOW_S) != ""
    assert ends.told(100.1 + WINDOW_S) == ""
    ends.on_changed(down("again"), 170.0)
    assert ends.told(170.0) == "has ended 3 times in 60 s, last: again"


def test_a_relay_that_does_not_come_back_is_told_of_until_it_runs() -> None:
    ends = RelayEnds()
    ends.on_changed(down("no port"), 100.0)
    assert ends.told(99.9 + DOWN_TOLD_S) == ""
    ends.on_changed(down("no port yet"), 101.0)  # the next one could not start: it has not been there meanwhile
    assert ends.told(100.0 + DOWN_TOLD_S) == "is down: no port yet"
    ends.on_changed(UP, 200.0)
    assert ends.told(200.0) == ""


def test_what_is_told_fits_into_a_profile() -> None:
    ends = RelayEnds()
    for _ in range(OFTEN):
        ends.on_changed(down("x" * 1000), 100.0)
    assert len(ends.told(100.0)) == MAX_REASON
