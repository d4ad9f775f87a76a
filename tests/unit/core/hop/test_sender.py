"""What a relay keeps of a stream until it is acknowledged, and when it puts it again."""

from __future__ import annotations

import itertools

import pytest

from zsched.core.hop.kept import NOTHING, RESEND_S, Owed
from zsched.core.hop.sender import GREET_S, KEPT_BYTES_LATEST, MAX_GREET_S, MAX_RESEND_S, Sender, Sums, near
from zsched.core.hop.serial import SPAN, serial_of
from zsched.core.values.relay_protocol import StreamAck
from zsched.relay.streams.tally import Tally


def lane() -> Sender:
    """One that nothing is put on: only its books; class ``latest`` with ``depth`` 16 and ``keep_last`` 1."""
    return Sender(kept_samples=16, kept_limit=KEPT_BYTES_LATEST)


def sent(books: Sender, *, at: float, size: int = 100, took_s: float = 0.0) -> None:
    """A sample went out."""
    assert books.note_put(None, None, size, at=at, took_s=took_s) is None


def acknowledged(books: Sender, arrived: int, now: float) -> None:
    books.acknowledge(StreamAck(eid=1, first=0, arrived=arrived, processed=arrived), "1", now)


def test_what_nobody_acknowledges_is_counted_and_not_kept() -> None:
    """A plain subscriber takes the stream; a worker that comes later goes on with the next number."""
    books = lane()
    for _ in range(2):
        sent(books, at=10.0)
    acknowledged(books, 1, 10.1)
    books.is_foreign = True
    ended = [books.note_put(None, None, 100, at=10.2) for _ in range(3)]
    assert ended == [Sums(1, 0, 0, 0, at_most_lost=1), Sums(0, 0, 0, 0), Sums(0, 0, 0, 0)]
    assert (books.count, books.in_flight, len(books.kept)) == (5, 0, 0)
    acknowledged(books, 5, 10.3)
    sent(books, at=10.4)
    assert (books.count, books.in_flight, [one.number for one in books.kept]) == (6, 1, [5])


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
    assert books.kept.size == kept * size


def ack(first: int, arrived: int, lost: int = 0, processed: int | None = None) -> StreamAck:
    return StreamAck(
        eid=1, first=first, arrived=arrived, processed=arrived if processed is None else processed, lost=lost
    )


def test_what_came_before_the_first_number_that_a_worker_saw_is_lost_and_not_forgotten() -> None:
    books = lane()
    for _ in range(10):
        sent(books, at=10.0)
    assert (books.acknowledged, books.lost, books.in_flight) == (0, 0, 10)
    books.acknowledge(ack(7, 9), "1", 10.1)
    assert (books.acknowledged, books.lost, books.in_flight) == (2, 7, 1)


def test_each_life_of_a_worker_answers_for_its_own_numbers() -> None:
    books, tally = lane(), Tally()
    for _ in range(10):
        sent(books, at=10.0)
    books.acknowledge(ack(0, 6, lost=1), "1", 10.1)
    assert not books.acknowledge(ack(0, 0), "2", 10.2)
    tally.take(books.begin_life("2", books.count))
    assert (tally.acknowledged, tally.lost, tally.at_most_lost) == (5, 1, 4)
    assert (books.acknowledged, books.lost, books.in_flight) == (0, 0, 0)
    sent(books, at=10.3)
    books.acknowledge(ack(0, 11, lost=10), "2", 10.4)  # it gave up on what was its predecessor's
    assert (books.acknowledged, books.lost, books.in_flight) == (1, 0, 0)


def test_where_work_is_kept_the_next_life_gets_what_the_former_one_had_not_finished() -> None:
    books = lane()
    books.keeps_work = True
    for _ in range(6):
        sent(books, at=10.0)
    books.acknowledge(StreamAck(eid=1, first=0, arrived=5, processed=2), "1", 10.1)
    ended = books.hear(StreamAck(eid=1, first=0, arrived=0, processed=0), "2", 10.2)
    assert ended == Sums(2, 0, 0, 0, at_most_lost=0)
    assert (books.base, books.lowest, [one.number for one in books.kept]) == (2, 2, [2, 3, 4, 5])
    assert books.replay_end == 6, "all of it may be known to it already"


def test_who_is_met_behind_a_plain_subscriber_is_not_blamed_for_what_was_lost_then() -> None:
    """What it tells as lost at its greeting was the subscriber's, and is counted as at most lost."""
    books = lane()
    for _ in range(3):
        sent(books, at=10.0)
    books.pass_on()
    books.part(10.1)
    books.greeted_at = 10.2
    books.hear(ack(0, 4, lost=3), "1", 10.3)
    assert books.meet(10.3)
    assert (books.was_foreign, books.forgiven, books.lost) == (False, 3, 0)
    sent(books, at=10.4)
    books.hear(ack(0, 5, lost=4), "1", 10.5)
    assert (books.acknowledged, books.lost) == (0, 1)


def test_a_lane_is_met_by_the_answer_to_its_greeting_alone() -> None:
    books = lane()
    books.part(10.0)
    books.acknowledge(ack(0, 0), "1", 10.0)
    assert not books.meet(10.0)  # it was on its way before
    books.greeted_at = 10.1
    assert books.meet(10.2)
    for _ in range(3):
        sent(books, at=10.3)
    books.part(11.0)  # its link went, and with it what was on it
    books.greeted_at = 12.0
    books.acknowledge(ack(0, 1), "1", 12.1)
    assert books.meet(12.1)
    assert (books.resend_from, books.lowest) == (1, 0), "what was let go of last may be taken back"


@pytest.mark.parametrize("keeps_work", [False, True])
def test_what_an_acknowledgement_says_is_taken_back_by_one_that_says_less(*, keeps_work: bool) -> None:
    """A stranger's said that all had come; the worker's own, behind it, tells what has."""
    books = lane()
    books.keeps_work = keeps_work
    for _ in range(8):
        sent(books, at=10.0)
    books.acknowledge(ack(0, 3), "1", 10.1)
    books.acknowledge(ack(0, 8), "1", 10.2)
    assert (books.acknowledged, books.in_flight, len(books.kept)) == (8, 0, 0)
    assert books.lowest == 3, "a start marker must not tell the worker to skip what it has not got"
    books.acknowledge(ack(0, 4), "1", 10.3)
    assert (books.acknowledged, books.in_flight, books.lowest) == (4, 4, 3)
    assert [one.number for one in books.kept] == [4, 5, 6, 7]
    assert books.kept.size == sum(one.size for one in books.kept)
    books.acknowledge(ack(0, 8), "1", 10.4)
    assert (books.acknowledged, books.in_flight, books.kept.size, len(books.kept)) == (8, 0, 0, 0)


def test_one_acknowledgement_further_on_lets_go_for_good() -> None:
    books = lane()
    for _ in range(3):
        sent(books, at=10.0)
        acknowledged(books, books.count, 10.1)
    assert [one.number for one in books.spare] == [2]
    books.begin_life("2", 3)
    assert not books.spare


@pytest.mark.parametrize("start", [0, SPAN - 2, SPAN, 5 * SPAN - 1])
def test_an_acknowledgement_is_read_near_our_own_number(start: int) -> None:
    """A receiver that came late knows the lowest bits of a number only; a stranger's does no harm."""
    books = lane()
    books.count = books.base = start
    for _ in range(5):
        sent(books, at=10.0)
    books.acknowledge(near(ack(serial_of(start), serial_of(start) + 4), books.count), "1", 10.1)
    assert (books.acknowledged, books.lost, books.in_flight) == (4, 0, 1)
    books.acknowledge(near(ack(0, 2**51), books.count), "1", 10.2)
    assert books.acknowledged + books.lost + books.in_flight == 5


@pytest.mark.parametrize(
    "forged",
    [
        StreamAck(eid=1, first=0, arrived=10**12, processed=10**12),
        StreamAck(eid=1, first=0, arrived=500, processed=500),
        StreamAck(eid=1, first=0, arrived=3, processed=5),
    ],
)
def test_an_acknowledgement_of_what_was_never_sent_is_nobody_s(forged: StreamAck) -> None:
    """It would let go of everything that is kept, and make every real acknowledgement an old one."""
    books = lane()
    for _ in range(5):
        sent(books, at=10.0)
    acknowledged(books, 2, 10.1)
    assert books.acknowledge(forged, "1", 10.2)
    assert (books.arrived, books.in_flight, len(books.kept)) == (2, 3, 3)
    acknowledged(books, 4, 10.3)
    assert (books.arrived, books.in_flight, len(books.kept)) == (4, 1, 1)


def test_a_gap_is_asked_for_again_while_newer_samples_flow() -> None:
    """Found by the simulated hop: what was put again was lost as well, and new samples passed for progress."""
    books = Sender()
    for number in range(4):
        sent(books, at=10.0 + number / 100)
    gap = StreamAck(eid=1, first=0, arrived=2, processed=2, has_gap=True)
    books.hear(gap, "1", 10.05)
    assert [one.number for one in books.take_owed().again] == [2, 3]
    assert books.take_owed() is NOTHING, "it is asked for once"
    books.resent(now := 10.06)
    while now < 10.06 + 2 * RESEND_S and books.resend_from is None:
        now += 0.01  # a new sample, and the receiver says the same again
        sent(books, at=now)
        books.hear(gap, "1", now)
    assert books.take_owed().again[0].number == 2
    assert now > 10.06 + 2 * RESEND_S / 3


def test_what_is_kept_no_more_is_given_up_by_a_skip() -> None:
    books = lane()
    for _ in range(20):
        sent(books, at=10.0)
    books.hear(StreamAck(eid=1, first=0, arrived=1, processed=1, has_gap=True), "1", 10.1)
    owed = books.take_owed()
    assert (owed.start, owed.skip, [one.number for one in owed.again]) == (None, 4, list(range(4, 20)))
    books.kept.let_go(20)
    books.ask_again(1, 10.5)
    assert books.take_owed() == Owed(skip=20)


def test_who_was_not_greeted_is_owed_nothing_and_a_misheard_start_is_said_again() -> None:
    books = Sender(is_whole=True)
    sent(books, at=10.0)
    books.ask_again(0, 10.0)
    assert books.take_owed() is NOTHING
    assert books.take_greeting(10.1) == 0
    books.hear(StreamAck(eid=1, first=0, arrived=0, processed=0, is_whole=False), "1", 10.2)
    owed = books.take_owed()
    assert (owed.start, owed.skip, [one.number for one in owed.again]) == (0, None, [0])
    assert books.take_owed() is NOTHING


def test_a_greeting_is_put_again_with_twice_the_pause_each_time() -> None:
    books, now, greeted = Sender(is_whole=True), 10.0, []
    books.part(now)
    while now < 13.9:
        if books.take_greeting(now) is not None:
            greeted.append(now)
        now += 0.01
    pauses = [after - before for before, after in itertools.pairwise(greeted)]
    assert pauses == pytest.approx([GREET_S, 2 * GREET_S, 4 * GREET_S, MAX_GREET_S, MAX_GREET_S], abs=0.02)


def test_class_latest_asks_how_far_the_receiver_is_before_it_puts_anything_again() -> None:
    """Found by the simulated hop: old numbers in a row passed for proof that a stranger had made the newest jump."""
    books = lane()
    for _ in range(6):
        sent(books, at=10.0)
    acknowledged(books, 1, 10.0)
    now = 10.1 + RESEND_S
    assert books.look_after(now)
    assert books.take_owed() == Owed(start=0), "it is asked by a start marker, and only that goes out"
    assert books.take_owed() is NOTHING
    books.hear(ack(0, 6, lost=4), "1", now + 0.1)  # it has the newest one, and has given up what is older
    assert books.take_owed() is NOTHING
    for _ in range(2):
        sent(books, at=11.0)
    assert books.look_after(14.0)
    assert books.take_owed() == Owed(start=1), "the lowest that may be put again, if a word is taken back"
    books.hear(ack(0, 6, lost=4), "1", 14.1)
    assert [one.number for one in books.take_owed().again] == [6, 7]
    assert books.look_after(20.0)
    sent(books, at=20.0)
    books.take_owed()
    books.hear(ack(0, 6, lost=4), "1", 20.1)
    assert books.take_owed() is NOTHING, "a newer one is on its way, behind which nothing older is wanted"


def test_a_lane_is_full_only_for_a_worker_that_acknowledges() -> None:
    books = lane()
    for _ in range(16):
        sent(books, at=10.0)
    assert not books.is_full(), "nobody may ever acknowledge"
    acknowledged(books, 0, 10.1)
    assert books.is_full()
    acknowledged(books, 1, 10.2)
    assert not books.is_full()


def test_a_lane_is_full_of_few_large_samples_too() -> None:
    books = lane()
    acknowledged(books, 0, 10.0)
    sent(books, at=10.0, size=KEPT_BYTES_LATEST - 1)
    assert not books.is_full()
    sent(books, at=10.0, size=1)
    assert books.is_full()
