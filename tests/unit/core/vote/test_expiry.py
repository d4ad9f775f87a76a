"""Orders that end by themselves: each node counts from when it learnt them."""

from __future__ import annotations

import math
from dataclasses import replace

from support.allocations import allocation_of
from zsched.core.values.model import Allocation, Asked, Pause, Pin
from zsched.core.vote.expiry import AGAIN_S, SPREAD_S, Expiry

ADA = Asked(by="ada@robot1")


def held(revision: int = 5, *, pause_s: float | None = None, pin_s: float | None = None) -> Allocation:
    pause = Pause(asked=ADA, revision=5, for_s=pause_s) if pause_s else None
    pin = Pin(node="edge1", asked=ADA, revision=5, for_s=pin_s) if pin_s else None
    return allocation_of(revision, pause=pause, paused=pause is not None, pin=pin, pinned=pin is not None)


def test_an_order_without_an_end_never_ends() -> None:
    expiry, value = Expiry(rank=0), replace(held(), paused=True, pause=Pause(asked=ADA, revision=5))
    expiry.note(value, 100.0)
    assert (expiry.next_deadline(), expiry.since("merge", "pause"), expiry.since("merge", "pin")) == (
        math.inf,
        100.0,
        None,
    )


def test_the_end_is_proposed_when_the_time_is_over_and_again_until_it_is_agreed() -> None:
    expiry, value = Expiry(rank=2), held(pause_s=60.0)
    expiry.note(value, 100.0)
    due = expiry.next_deadline()
    assert due == 160.0 + 2 * SPREAD_S
    assert expiry.due({"merge": value}, due - 0.1) == []
    ((task, change),) = expiry.due({"merge": value}, due)
    assert (task, change.pause, change.pin, change.base_revision, change.asked) == ("merge", None, None, 5, None)
    assert change.reason == "the time of its pause is over"
    assert expiry.due({"merge": value}, due + 1.0) == [], "not at once again"
    assert len(expiry.due({"merge": value}, due + AGAIN_S)) == 1
    expiry.note(change.apply(value), due + 6.0)
    assert (expiry.next_deadline(), change.apply(value).paused) == (math.inf, False)


def test_a_newer_revision_with_the_same_order_does_not_count_anew() -> None:
    expiry = Expiry(rank=0)
    expiry.note(held(pause_s=60.0), 100.0)
    expiry.note(held(revision=6, pause_s=60.0), 150.0)
    assert (expiry.next_deadline(), expiry.since("merge", "pause")) == (160.0, 100.0)


def test_only_the_order_whose_time_is_over_ends() -> None:
    expiry, value = Expiry(rank=0), held(pause_s=60.0, pin_s=300.0)
    expiry.note(value, 0.0)
    ((_, change),) = expiry.due({"merge": value}, 60.0)
    assert (change.pause, change.pin) == (None, value.pin)
    expiry.note(change.apply(value), 60.0)
    assert expiry.next_deadline() == 300.0


def test_the_orders_of_a_task_that_has_left_the_fleet_are_forgotten() -> None:
    expiry = Expiry(rank=0)
    expiry.note(held(pause_s=60.0), 100.0)
    assert expiry.due({}, 160.0) == []
    assert expiry.next_deadline() == math.inf


def test_a_node_that_was_restarted_counts_anew() -> None:
    expiry, value = Expiry(rank=0), held(pause_s=60.0)
    expiry.note(value, 100.0)
    again = Expiry(rank=0)
    again.note(value, 150.0)
    assert (expiry.next_deadline(), again.next_deadline()) == (160.0, 210.0)
