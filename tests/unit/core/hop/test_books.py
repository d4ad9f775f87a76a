"""Whether counters account for every sample."""

from __future__ import annotations

from dataclasses import replace

import pytest

from zsched.core.hop.books import unaccounted
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


@pytest.mark.parametrize("name", ["acknowledged", "lost", "in_flight", "at_most_lost", "unsent", "unconfirmed"])
def test_what_a_counter_lacks_is_missing(name: str) -> None:
    assert unaccounted(replace(WHOLE, **{name: getattr(WHOLE, name) - 1})) == 1
    assert unaccounted(replace(WHOLE, **{name: getattr(WHOLE, name) + 1})) == -1


def test_what_a_worker_without_acknowledgements_was_sent_is_unconfirmed() -> None:
    foreign = StreamCount(stream="merge/in/0", messages=40, acknowledged=None, in_flight=0, unconfirmed=40)
    assert unaccounted(foreign) == 0
    assert unaccounted(replace(foreign, unconfirmed=0, drops=(("closed", 39),))) == 1


def test_an_output_has_no_books() -> None:
    assert unaccounted(StreamCount(stream="merge/out/0", messages=3)) is None
