"""What a relay finds of what those before it have counted, however they ended."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from zsched.core.hop.books import unaccounted
from zsched.core.values.plan import StreamCount
from zsched.ipc.takeover import Door
from zsched.relay import books as relay_books
from zsched.relay.books import Books
from zsched.relay.streams.counter import StreamCounter
from zsched.relay.streams.tally import Tally

IN, OUT = "merge/in/0", "merge/out/0"


class Life:
    """A relay with one input, of whose samples a worker acknowledges some."""

    def __init__(self, folder: Path) -> None:
        self.books = Books(Door(folder, "robot1").books)
        self.counter = StreamCounter(IN)
        self.taken = self.acknowledged = self.closed = 0

    def take(self, count: int, acknowledged: int = 0) -> None:
        for _ in range(count):
            self.counter.seen(10)
        self.taken += count
        self.acknowledged += acknowledged

    def own(self) -> tuple[StreamCount, ...]:
        tally = Tally(acknowledged=self.acknowledged, in_flight=self.taken - self.acknowledged - self.closed)
        return (self.counter.value(tally, has_acks=True), StreamCount(stream=OUT, messages=self.acknowledged))

    def count(self, *, is_last: bool = False) -> StreamCount:
        self.books.write(self.own(), is_last=is_last)
        return self.told()

    def told(self, stream: str = IN) -> StreamCount:
        found = next(count for count in self.books.added(self.own()) if count.stream == stream)
        assert not unaccounted(found)
        return found


def test_what_was_in_hand_at_the_last_count_is_at_most_lost(tmp_path: Path) -> None:
    first = Life(tmp_path)
    first.take(100, acknowledged=90)
    first.count()
    first.take(7, acknowledged=17)  # it is killed before it can say so: of these nobody knows
    second = Life(tmp_path)
    second.take(5, acknowledged=3)
    found = second.told()
    assert (found.messages, found.acknowledged, found.at_most_lost, found.in_flight) == (105, 93, 10, 2)
    assert second.told(OUT).messages == 93
    second.count()
    assert Life(tmp_path).told().at_most_lost == 10 + 2, "and again"


def test_a_relay_that_ends_in_order_has_nothing_that_is_at_most_lost(tmp_path: Path) -> None:
    first = Life(tmp_path)
    first.take(100, acknowledged=96)
    first.counter.dropped("closed", 4)
    first.closed = 4
    first.count(is_last=True)
    first.books.write((StreamCount(stream=IN, messages=7),))  # a thread that counts meanwhile comes too late
    found = Life(tmp_path).told()
    assert (found.messages, found.acknowledged, found.at_most_lost, dict(found.drops)) == (100, 96, 0, {"closed": 4})


def test_books_that_are_not_to_be_understood_count_nothing(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    Life(tmp_path).take(3)
    Door(tmp_path, "robot1").books.write_bytes(b"{}")
    assert Life(tmp_path).told() == Life(tmp_path).told()
    assert "is not to be understood" in caplog.text


def test_books_that_cannot_be_written_are_said_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    first = Life(tmp_path / "gone")
    for _ in range(3):
        first.take(1)
        assert first.count().in_flight == first.taken
    assert sum("cannot be written" in line for line in caplog.messages) == 1


def test_books_that_do_not_fit_leave_those_of_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first, write, room = Life(tmp_path), os.write, [10]
    first.take(3)
    first.count()

    def full(descriptor: int, content: bytes | memoryview) -> int:
        if not room[0]:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        taken, room[0] = write(descriptor, content[: room[0]]), 0
        return taken

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", full)
        first.take(4)
        first.count()
    assert Life(tmp_path).told().messages == 3


def test_nothing_is_written_while_nothing_is_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = Life(tmp_path)
    first.take(1)
    first.count()
    monkeypatch.setattr(relay_books, "_replace", lambda *_: pytest.fail("written"))
    first.count()


def test_a_task_that_has_left_is_forgotten(tmp_path: Path) -> None:
    first = Life(tmp_path)
    first.take(3)
    first.count()
    second = Life(tmp_path)
    second.books.keep(frozenset({"merge"}))
    assert second.told().messages == 3
    second.books.keep(frozenset({"other"}))
    assert second.told().messages == 0


def test_the_files_go_with_the_door(tmp_path: Path) -> None:
    first = Life(tmp_path)
    first.take(1)
    first.count()
    assert len(list(tmp_path.iterdir())) == 1
    Door(tmp_path, "robot1").remove()
    assert list(tmp_path.iterdir()) == []
