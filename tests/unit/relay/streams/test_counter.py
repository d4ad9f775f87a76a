"""What one stream counts."""

from __future__ import annotations

import pytest

from zsched.core.values.plan import STILL_S
from zsched.relay.streams import counter as module
from zsched.relay.streams.counter import StreamCounter


def test_the_longest_gap_between_two_answers_is_told_once() -> None:
    counter = StreamCounter("echo/out/0")
    assert counter.value().gap_s is None
    counter.passed(1, 100.0)
    assert counter.value().gap_s is None, "one answer has no gap"
    for at in (100.1, 100.5, 100.6):
        counter.passed(1, at)
    told = counter.value()
    assert (told.gap_s, told.move_gap_s, told.move_epoch) == (0.4, None, 0)
    assert counter.value().gap_s is None, "told already"


def test_the_first_answer_of_a_new_owner_ends_the_gap_of_its_move() -> None:
    counter = StreamCounter("echo/out/0")
    counter.passed(4, 100.0)
    counter.passed(5, 100.25)
    counter.passed(5, 101.0)
    told = counter.value()
    assert (told.gap_s, told.move_gap_s, told.move_epoch) == (0.75, 0.25, 5)
    assert counter.value().move_gap_s == 0.25, "it lasts until the next move"
    counter.passed(7, 101.5)
    assert (counter.value().move_gap_s, counter.value().move_epoch) == (0.5, 7)


def test_a_stream_is_still_until_a_sample_comes_and_a_while_after_the_last(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(module, "monotonic_s", lambda: now[0])
    counter = StreamCounter("echo/in/0")
    told = [counter.is_still]
    counter.seen(3)
    for passed_s in (0.0, STILL_S - 0.1, STILL_S):
        now[0] = 100.0 + passed_s
        told.append(counter.is_still)
    assert told == [True, False, False, True]
