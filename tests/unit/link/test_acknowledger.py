"""The worker's side of the numbered hop: what is admitted, what is counted, what the relay is told."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import pytest

from support.waiting import until
from zsched.core.hop import receiver
from zsched.core.hop.serial import SPAN, serial_of
from zsched.core.values.relay_protocol import StreamAck, StreamAcks
from zsched.link import acknowledger
from zsched.link.acknowledger import Acknowledger

NAME = ("edge1/t/in", "a1", 7)


class Book:
    """An acknowledger and what it sent."""

    def __init__(self) -> None:
        self.sent: list[tuple[float, str, StreamAcks]] = []
        self.acks = Acknowledger(lambda relay, frame: self.sent.append((time.monotonic(), relay, frame)))

    def last(self) -> StreamAck:
        return self.sent[-1][2].acks[-1]

    def admit(self, *numbers: int, in_turn: bool = True) -> list[bool]:
        return [self.acks.admit(NAME, serial_of(number), in_turn=in_turn) is not None for number in numbers]

    def wait(self, **fields: object) -> StreamAck:
        end = time.monotonic() + 60
        while time.monotonic() < end:
            if self.sent and all(getattr(self.last(), name) == value for name, value in fields.items()):
                return self.last()
            time.sleep(0.005)
        raise AssertionError(f"never {fields}: {self.sent[-1:]}")


@pytest.fixture
def book() -> Iterator[Book]:
    made = Book()
    yield made
    made.acks.close()


def test_what_is_processed_is_acknowledged_to_its_own_relay(book: Book) -> None:
    book.acks.skip(NAME, 5)
    assert book.admit(5, 6, 7) == [True, True, True]
    for number in (5, 6, 7):
        book.acks.processed(NAME, number, 10)
    ack = book.wait(processed=8)
    assert (ack.eid, ack.first, ack.arrived, ack.lost, ack.has_gap) == (7, 5, 8, 0, False)
    assert book.sent[-1][1] == "a1"


def test_a_number_out_of_turn_is_refused_and_the_missing_ones_are_asked_for(book: Book) -> None:
    assert book.admit(0, 1, 4, 5) == [True, True, False, False]
    assert book.wait(has_gap=True).arrived == 2
    assert book.admit(2, 3, 4, 5) == [True, True, True, True]
    book.acks.processed(NAME, 5, 1)
    ack = book.wait(processed=6)
    assert (ack.lost, ack.doubled, ack.has_gap) == (0, 0, False)


def test_what_never_comes_is_given_up(book: Book, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(receiver, "GIVE_UP_S", 0.05)
    assert book.admit(0, 3) == [True, False]
    until(lambda: book.admit(4) == [True], "the gap is given up")
    book.acks.processed(NAME, 4, 1)
    assert book.wait(processed=5).lost == 3
    assert book.admit(2) == [False]
    assert book.wait(reordered=1).doubled == 0


def test_a_relay_that_kept_no_more_says_so(book: Book) -> None:
    assert book.admit(0, 9) == [True, False]
    book.acks.skip(NAME, 9)
    assert book.admit(9) == [True]
    assert book.wait(arrived=10).lost == 8


def test_an_input_that_wants_the_newest_takes_it(book: Book) -> None:
    assert book.admit(0, 3, 2, 3, in_turn=False) == [True, True, False, False]
    book.acks.flush()
    ack = book.wait(arrived=4)
    assert (ack.lost, ack.reordered, ack.doubled) == (2, 1, 1)


def test_at_20_hz_while_it_changes_and_at_once_when_much_was_processed(book: Book) -> None:
    began = time.monotonic()
    number = 0
    while time.monotonic() < began + 0.5 or len(book.sent) < 5:
        book.admit(number)
        book.acks.processed(NAME, number, 10)
        number += 1
        time.sleep(0.005)
    assert len(book.sent) <= 3 + 20 * (time.monotonic() - began)
    before = len(book.sent)
    book.admit(number)
    book.acks.processed(NAME, number, acknowledger.ACK_BYTES)
    end = time.monotonic() + 60
    while len(book.sent) == before and time.monotonic() < end:
        time.sleep(0.001)
    assert len(book.sent) > before


def test_a_source_begins_with_number_0_or_with_what_its_start_marker_says(book: Book) -> None:
    """What comes first is no proof that nothing was before it."""
    assert book.admit(5) == [False]
    ack = book.wait(has_gap=True)
    assert (ack.first, ack.arrived) == (0, 0)
    book.acks.skip(NAME, 5)
    ack = book.wait(arrived=5)
    assert (ack.first, ack.processed, ack.lost) == (5, 5, 0)
    assert book.admit(5, 6) == [True, True]


def test_a_start_marker_is_answered_each_time(book: Book) -> None:
    book.acks.skip(NAME, 0)
    assert book.wait(arrived=0).lost == 0
    before = len(book.sent)
    book.acks.skip(NAME, 0)
    until(lambda: len(book.sent) > before, "another answer")


def test_what_is_given_up_with_nothing_in_work_is_not_in_flight_for_ever(book: Book) -> None:
    assert book.admit(0) == [True]
    book.acks.processed(NAME, 0, 1)
    book.acks.skip(NAME, 4)
    assert book.wait(arrived=4).processed == 4


def test_what_gives_way_for_want_of_room_is_lost_although_newer_ones_are_processed(book: Book) -> None:
    assert book.admit(0, 1, 2) == [True, True, True]
    book.acks.shed(NAME)
    book.acks.processed(NAME, 2, 1)
    assert book.wait(processed=3).lost == 1


def test_numbers_go_on_where_their_serials_begin_again(book: Book) -> None:
    """Resent ones, a gap and a skip on both sides of 2^32."""
    start = SPAN - 3
    book.acks.skip(NAME, start)
    assert book.admit(start, start + 1, start + 5, start + 1) == [True, True, False, False]
    ack = book.wait(has_gap=True)
    assert (ack.arrived, ack.doubled) == (start + 2, 1)
    assert book.admit(start + 2, start + 3, start + 4, start + 5) == [True] * 4
    book.acks.processed(NAME, book.acks.number(NAME, serial_of(start + 5)), 1)
    assert book.wait(processed=SPAN + 3).lost == 0
    book.acks.skip(NAME, start + 9)
    assert book.wait(arrived=SPAN + 6).lost == 3
    assert book.admit(SPAN + 6) == [True]


# --- strangers -------------------------------------------------------------------------------------------------------


FAR = (40, 5000, 10**6, SPAN // 4)


@pytest.mark.parametrize("far", FAR)
def test_a_forged_number_is_taken_back_by_three_real_ones(book: Book, far: int) -> None:
    """Where only the newest is wanted a jump is made at once: one sample from anybody must not end the stream."""
    assert book.admit(*range(10), in_turn=False) == [True] * 10
    assert book.admit(far, in_turn=False) == [True]
    assert book.admit(10, 11, 12, 13, in_turn=False) == [False, False, True, True]
    book.acks.processed(NAME, 13, 1)
    assert book.wait(processed=14).lost == 2


@pytest.mark.parametrize("far", FAR)
@pytest.mark.parametrize("in_turn", [True, False])
def test_a_forged_skip_marker_is_taken_back_by_three_real_ones(book: Book, far: int, *, in_turn: bool) -> None:
    assert book.admit(*range(10), in_turn=in_turn) == [True] * 10
    book.acks.skip(NAME, far)
    assert book.admit(10, 11, 12, 13, in_turn=in_turn) == [False, False, True, True]
    book.acks.processed(NAME, 13, 1)
    ack = book.wait(processed=14)
    assert (ack.arrived, ack.lost) == (14, 2)


def test_a_forged_start_that_is_taken_back_leaves_nothing_before_the_first(book: Book) -> None:
    book.acks.skip(NAME, 0)
    book.acks.skip(NAME, 40)
    assert book.admit(0, 1, 2, 3) == [False, False, True, True]
    book.acks.processed(NAME, 3, 1)
    ack = book.wait(processed=4)
    assert (ack.first, ack.arrived, ack.lost) == (0, 4, 2)


def test_a_jump_that_something_newer_has_followed_stands(book: Book) -> None:
    """Late samples of an honest gap come in a row, too: they must not begin the stream anew."""
    assert book.admit(0, 1, in_turn=False) == [True, True]
    assert book.admit(8, 9, in_turn=False) == [True, True]
    assert book.admit(2, 3, 4, 5, in_turn=False) == [False] * 4
    book.acks.processed(NAME, 9, 1)
    assert book.wait(processed=10).reordered == 4


def test_what_is_given_up_while_something_is_in_work_is_not_in_flight_for_ever(book: Book) -> None:
    """An input waits for its answers while the last ones of its stream never come."""
    assert book.admit(0, 1) == [True, True]
    book.acks.processed(NAME, 0, 1)
    book.acks.skip(NAME, 4)
    ack = book.wait(arrived=4)
    assert (ack.processed, ack.lost) == (1, 2)
    book.acks.processed(NAME, 1, 1)
    assert book.wait(processed=4).lost == 2


def test_a_jump_that_is_taken_back_does_not_call_done_what_is_in_work(book: Book) -> None:
    assert book.admit(0, 1) == [True, True]
    book.acks.processed(NAME, 0, 1)
    book.acks.skip(NAME, 1000)  # nobody of ours
    assert book.admit(2, 3, 4, 5) == [False, False, True, True]
    ack = book.wait(arrived=6)
    assert (ack.processed, ack.lost) == (1, 2)
    book.acks.processed(NAME, 1, 1)
    assert book.wait(processed=4).lost == 2
    book.acks.processed(NAME, 5, 1)
    assert book.wait(processed=6).lost == 2


def test_what_came_in_a_jump_that_is_taken_back_is_not_said_to_be_processed(book: Book) -> None:
    book.acks.skip(NAME, 0)
    assert book.admit(0) == [True]
    assert book.admit(1000, in_turn=False) == [True]
    assert book.admit(1, 2, 3, in_turn=False) == [False, False, True]
    book.acks.processed(NAME, 1000, 1)
    book.acks.processed(NAME, 3, 1)
    assert book.wait(processed=4).arrived == 4


def test_who_leaves_says_so_and_nothing_more(book: Book) -> None:
    assert book.admit(0) == [True]
    book.acks.processed(NAME, 0, 1)
    assert not book.wait(arrived=1).has_left
    book.acks.leave([NAME])
    assert book.wait(has_left=True).arrived == 1
    assert book.acks.arrived(NAME) == 0


def test_the_source_that_goes_for_want_of_room_is_one_that_nothing_comes_of(
    book: Book, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The robot that has been up longest was heard first; many that came and went since are forgotten before it."""
    monkeypatch.setattr(acknowledger, "MAX_SOURCES", 3)
    book.acks.skip(NAME, 0)
    book.acks.note_start(NAME, 0, is_whole=True, replayed=0)
    others = [("edge1/t/in", f"b{number}", 7) for number in range(9)]
    for number, other in enumerate(others):
        assert book.admit(number) == [True]
        book.acks.processed(NAME, number, 10)
        assert book.acks.admit(other, 0, in_turn=True) == 0
        assert book.acks.arrived(other) == 1, "not the one that has just come"
    assert book.acks.is_whole(NAME)
    assert book.acks.arrived(NAME) == len(others)
    assert len(book.acks._sources) == 3
    assert book.acks._used <= set(book.acks._sources)


def test_frames_leave_in_the_order_in_which_they_were_made() -> None:
    """One that says less than the one before it is taken for a stranger's."""
    told: list[int] = []
    is_sending, may_go_on = threading.Event(), threading.Event()

    def send(_session: str, frame: StreamAcks) -> None:
        if not is_sending.is_set():
            is_sending.set()
            may_go_on.wait(20)
        told.append(frame.acks[0].arrived)

    acks = Acknowledger(send)
    name = ("key", "session", 1)
    acks.expect(name, 0)
    assert acks.take(name, 0, 1)
    assert is_sending.wait(20), "the thread sends the first"
    assert acks.take(name, 1, 1)
    other = threading.Thread(target=acks.flush)
    other.start()
    other.join(0.2)
    assert told == [], "the second one waits for it"
    may_go_on.set()
    other.join(20)
    assert told == [1, 2]
    acks.close()
