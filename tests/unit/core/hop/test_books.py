"""Whether counters account for every sample."""

from __future__ import annotations

from dataclasses import replace

import pytest

from zsched.core.hop.books import added, closed, together, unaccounted, without
from zsched.core.values.plan import StreamCount

WHOLE = StreamCount(
    stream="merge/in/0",
    messages=107,
    repeated=5,
    acknowledged=60,
    lost=3,
    drops=(("overflow", 4), ("no_route", 6)),
    in_flight=20,
    at_most_lost=10,
    unsent=2,
    unconfirmed=7,
)


def test_what_is_in_exactly_one_counter_is_accounted_for() -> None:
    assert unaccounted(WHOLE) == 0


def test_what_a_worker_without_acknowledgements_was_sent_is_unconfirmed() -> None:
    foreign = StreamCount(stream="merge/in/0", messages=40, acknowledged=None, in_flight=0, unconfirmed=40)
    assert unaccounted(foreign) == 0
    assert unaccounted(replace(foreign, unconfirmed=0, drops=(("closed", 39),))) == 1


def test_an_output_has_no_books() -> None:
    assert unaccounted(StreamCount(stream="merge/out/0", messages=3)) is None


def test_what_somebody_who_has_gone_had_in_hand_is_at_most_lost() -> None:
    gone = closed(replace(WHOLE, last_seen_s=1.0, answer_s=0.1, gap_s=0.2, move_gap_s=0.3, move_epoch=4))
    assert (gone.messages, gone.at_most_lost, gone.in_flight) == (107, 30, 0)
    assert unaccounted(gone) == 0
    assert (gone.last_seen_s, gone.answer_s, gone.gap_s, gone.move_gap_s, gone.move_epoch) == (None,) * 4 + (0,)


def test_an_output_had_nothing_in_hand_that_is_known() -> None:
    gone = closed(StreamCount(stream="merge/out/0", messages=3, lost=1))
    assert gone == StreamCount(stream="merge/out/0", messages=3, lost=1)


def test_the_counters_of_two_balance_as_those_of_one() -> None:
    both = together(closed(WHOLE), replace(WHOLE, last_seen_s=1.0))
    assert (both.messages, both.in_flight, both.last_seen_s) == (214, 20, 1.0)
    assert dict(both.drops) == {"overflow": 8, "no_route": 12}
    assert unaccounted(both) == 0


def test_counters_of_a_stream_that_has_gone_are_nobodys() -> None:
    other = replace(WHOLE, stream="other/in/0")
    assert added((WHOLE,), {"other/in/0": other}) == (WHOLE,)
    assert added((WHOLE, other), {"other/in/0": other}) == (WHOLE, together(other, other))


def test_what_only_one_of_two_has_counted_is_the_sum() -> None:
    known, unknown = StreamCount(stream="merge/in/0", acknowledged=7, in_flight=2), StreamCount(stream="merge/in/0")
    for both in (together(known, unknown), together(unknown, known)):
        assert (both.acknowledged, both.in_flight) == (7, 2)
    assert together(unknown, unknown).acknowledged is None


@pytest.mark.parametrize("answer_s", [0.1, None])
def test_of_two_the_answers_with_their_inputs_timestamps_tell_the_time(answer_s: float | None) -> None:
    """An application that has an output itself knows more of it than its relay, or less."""
    timed = StreamCount(stream="merge/out/0", answer_s=0.4, paired_hz=2.0)
    other = StreamCount(stream="merge/out/0", answer_s=answer_s)
    for both in (together(timed, other), together(other, timed)):
        assert (both.answer_s, both.paired_hz) == (0.4, 2.0)


def test_a_reason_for_which_nothing_is_left_is_not_named() -> None:
    part = StreamCount(stream="merge/in/0", drops=(("overflow", 4), ("no_route", 1)))
    assert without(WHOLE, part).drops == (("no_route", 5),)
