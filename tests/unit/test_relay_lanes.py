"""What a relay keeps of a stream until it is acknowledged, and when it puts it again."""

from __future__ import annotations

from typing import Any, cast

import pytest

from zsched.core.relay_protocol import StreamAck
from zsched.relay.lanes import KEPT_BYTES_LATEST, MAX_RESEND_S, RESEND_S, Lane, Sent


def lane() -> Lane:
    """One that nothing is put on: only its books."""
    return Lane(key="edge1/in", publisher=cast("Any", None), source_id=cast("Any", None), eid=1)


def sent(books: Lane, *, at: float, size: int = 100, took_s: float = 0.0) -> None:
    """A sample went out; class ``latest`` with ``depth`` 16 and ``keep_last`` 1."""
    books.count += 1
    one = Sent(books.count - 1, cast("Any", None), None, size, at, took_s)
    books.keep(one, samples=16, least=1, size=KEPT_BYTES_LATEST)


def acknowledged(books: Lane, arrived: int, now: float) -> None:
    books.acknowledge(StreamAck(eid=1, first=0, arrived=arrived, processed=arrived), "1", now)


def test_nothing_is_late_while_acknowledgements_come() -> None:
    books = lane()
    sent(books, at=10.0)
    acknowledged(books, 1, 10.01)
    assert not books.is_late(99.0)
    sent(books, at=11.0)
    assert not books.is_late(10.99 + RESEND_S)
    assert books.is_late(11.01 + RESEND_S)


def test_patience_doubles_each_time_and_ends_with_progress() -> None:
    books = lane()
    sent(books, at=10.0)
    acknowledged(books, 1, 10.0)
    sent(books, at=10.0)
    now, pauses = 10.0, []
    for _ in range(8):
        pauses.append(books.pause_s)
        now += books.pause_s + 0.001
        assert books.is_late(now)
        books.ask_again(books.arrived, now)
    assert pauses[:3] == [RESEND_S, 2 * RESEND_S, 4 * RESEND_S]
    assert pauses[-1] == MAX_RESEND_S
    sent(books, at=now)
    acknowledged(books, 3, now + 0.02)
    assert books.pause_s == RESEND_S


def test_a_slow_link_is_given_the_time_that_its_puts_and_acknowledgements_take() -> None:
    """4 MiB at 20 Mbit/s: the put waits for 1.6 s, and its acknowledgement comes 0.4 s later."""
    books = lane()
    sent(books, at=10.0, took_s=1.6)
    acknowledged(books, 1, 10.4)
    sent(books, at=14.0, took_s=1.6)
    assert books.pause_s == pytest.approx(1.6)
    assert not books.is_late(14.0 + 0.4)
    acknowledged(books, 2, 15.5)
    assert books.pause_s == pytest.approx(3.0)


@pytest.mark.parametrize(("size", "kept"), [(100, 16), (KEPT_BYTES_LATEST // 4, 4), (4 << 20, 1)])
def test_of_large_latest_samples_only_the_newest_are_kept_to_be_put_again(size: int, kept: int) -> None:
    books = lane()
    for number in range(20):
        sent(books, at=10.0 + number, size=size)
    assert [one.number for one in books.kept] == list(range(20 - kept, 20))
    assert books.kept_bytes == kept * size
