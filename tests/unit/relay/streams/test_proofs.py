"""What a dead owner's answers prove done: nothing that is not certain."""

from __future__ import annotations

from typing import Any, cast

import pytest

from zsched.relay.streams import proofs
from zsched.relay.streams.proofs import LeftOpen, Stamps, unproven

SAMPLE: Any = None


def stamp(number: int) -> Any:
    """Numbers are ordered and may be keys, as timestamps are."""
    return number


def left(*samples: tuple[int, int]) -> list[LeftOpen]:
    """From (lane, timestamp)."""
    return [LeftOpen(SAMPLE, stamp(at), lane) for lane, at in samples]


def stamps_of(again: list[LeftOpen]) -> list[int]:
    return [cast("int", one.stamp) for one in again]


@pytest.mark.parametrize(
    ("answered", "again"),
    [
        (set(), [1, 2, 3]),
        ({1}, [1, 2, 3]),
        ({1, 2}, [2, 3]),
        ({1, 3}, [2, 3]),
        ({2, 3}, [1, 3]),
        ({1, 2, 3}, [3]),
    ],
)
def test_a_sample_is_done_when_it_and_a_later_one_have_an_answer(answered: set[int], again: list[int]) -> None:
    """The newest answer's callback may have had more to say."""
    found = unproven(left((7, 1), (7, 2), (7, 3)), lambda one: cast("int", one) in answered)
    assert stamps_of(found) == again


def test_only_the_same_publisher_s_later_answers_count() -> None:
    found = unproven(left((7, 1), (8, 2), (7, 3), (8, 4)), lambda one: cast("int", one) in {1, 2, 4})
    assert stamps_of(found) == [1, 3, 4]


def test_what_was_never_sent_is_not_done() -> None:
    waiting = [LeftOpen(SAMPLE, stamp(1)), LeftOpen(SAMPLE, stamp(2)), LeftOpen(SAMPLE, None, 7)]
    assert unproven(waiting, lambda _: True) == waiting


def test_a_timestamp_is_alone_until_another_sample_has_it_too() -> None:
    stamps = Stamps()
    assert not stamps.is_alone(stamp(1))
    stamps.note(stamp(1))
    stamps.note(stamp(3))
    stamps.note(stamp(2))  # two applications' clocks
    assert [stamps.is_alone(stamp(at)) for at in (1, 2, 3)] == [True, True, True]
    stamps.note(stamp(1))
    assert [stamps.is_alone(stamp(at)) for at in (1, 2, 3)] == [False, True, True]


def test_of_what_was_forgotten_nobody_knows_whether_it_was_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(proofs, "MAX_STAMPS", 2)
    stamps = Stamps()
    for at in (5, 6, 7):
        stamps.note(stamp(at))
    stamps.note(stamp(5))  # it had it, once
    stamps.note(stamp(4))
    stamps.note(stamp(8))
    assert [stamps.is_alone(stamp(at)) for at in (4, 5, 6, 7, 8)] == [False, False, False, True, True]
