"""The worker's side of the numbered hop: what is admitted, what is counted, what the relay is told."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest

from support.waiting import until
from zsched import hop_acks
from zsched.core.relay_protocol import StreamAck, StreamAcks
from zsched.hop_acks import Acknowledger

NAME = ("edge1/t/in", "a1", 7)


class Book:
    """An acknowledger and what it sent."""

    def __init__(self) -> None:
        self.sent: list[tuple[float, str, StreamAcks]] = []
        self.acks = Acknowledger(lambda relay, frame: self.sent.append((time.monotonic(), relay, frame)))

    def last(self) -> StreamAck:
        return self.sent[-1][2].acks[-1]

    def admit(self, *numbers: int, in_turn: bool = True) -> list[bool]:
        return [self.acks.admit(NAME, number, in_turn=in_turn) for number in numbers]

    def wait(self, **fields: object) -> StreamAck:
        end = time.monotonic() + 3
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
    monkeypatch.setattr(hop_acks, "GIVE_UP_S", 0.05)
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
    end = time.monotonic() + 0.5
    number = 0
    while time.monotonic() < end:
        book.admit(number)
        book.acks.processed(NAME, number, 10)
        number += 1
        time.sleep(0.005)
    assert 5 <= len(book.sent) <= 13
    before = len(book.sent)
    book.admit(number)
    book.acks.processed(NAME, number, hop_acks.ACK_BYTES)
    end = time.monotonic() + 0.5
    while len(book.sent) == before and time.monotonic() < end:
        time.sleep(0.001)
    assert len(book.sent) > before
