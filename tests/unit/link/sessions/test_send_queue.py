"""The queue in front of a put that may block: order, bounds, what gives way."""

from __future__ import annotations

import threading
import time
import weakref
from collections.abc import Callable
from typing import Any

import pytest

from support.waiting import until, within
from zsched.link.sessions import send_queue
from zsched.link.sessions.send_queue import SendQueue


class Receiver:
    """Takes samples; stalls while `gate` is closed."""

    def __init__(self) -> None:
        self.got: list[object] = []
        self.gate = threading.Event()
        self.gate.set()

    def take(self, value: object) -> Callable[[], None]:
        def put() -> None:
            self.gate.wait(5)
            self.got.append(value)

        return put


def stalled(receiver: Receiver, *, depth: int, first: object = 0, **options: Any) -> SendQueue:
    """A queue whose first put blocks until the receiver's gate is opened."""
    receiver.gate.clear()
    queue = SendQueue("t", depth=depth, **options)
    queue.send("a", receiver.take(first), 1)
    until(lambda: queue.is_stalled, "the put blocks")
    return queue


def test_everything_goes_through_in_order_and_markers_keep_their_place() -> None:
    receiver = Receiver()
    queue = SendQueue("t", depth=1000, sheds=False)
    for number in range(100):
        assert queue.send("a", receiver.take(number), 10) == 0
    queue.then(receiver.take("end"))
    until(lambda: len(receiver.got) == 101, "all of it")
    assert receiver.got == [*range(100), "end"]
    queue.close()


def test_a_full_queue_that_sheds_nothing_refuses_the_newest() -> None:
    receiver = Receiver()
    queue = stalled(receiver, depth=3, sheds=False)
    assert [queue.send("a", receiver.take(number), 1) for number in range(1, 6)] == [0, 0, 0, 1, 1]
    assert queue.send("a", receiver.take(9), send_queue.MAX_BYTES) == 1
    receiver.gate.set()
    until(lambda: len(receiver.got) == 4, "what was taken")
    assert receiver.got == [0, 1, 2, 3]
    assert queue.close() == 0


def test_who_waits_for_room_loses_nothing_to_a_slow_receiver(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(send_queue, "NO_ROOM_S", 60.0)
    got: list[int] = []
    queue = SendQueue("t", depth=3, sheds=False)

    def slow(number: int) -> Callable[[], None]:
        def put() -> None:
            time.sleep(0.005)
            got.append(number)

        return put

    began = time.monotonic()
    for number in range(40):
        assert queue.wait_for_room(1)
        assert queue.send("a", slow(number), 1) == 0
    assert time.monotonic() - began > 0.1
    until(lambda: got == list(range(40)), "all of it")
    queue.close()


def test_nobody_waits_long_for_a_stalled_receiver() -> None:
    receiver = Receiver()
    queue = stalled(receiver, depth=2, sheds=False)
    for number in (1, 2):
        queue.send("a", receiver.take(number), 1)
    began = time.monotonic()
    assert not queue.wait_for_room(1)
    for _ in range(100):  # from now on not at all
        assert not queue.wait_for_room(1)
    within(time.monotonic() - began, 2 * send_queue.NO_ROOM_S)
    receiver.gate.set()
    until(lambda: queue.wait_for_room(1), "it takes something again")
    queue.close()


def test_behind_a_stalled_receiver_only_the_newest_of_each_lane_wait() -> None:
    receiver = Receiver()
    queue = stalled(receiver, depth=100, first=("a", 0), sheds=True, keep_last=2)
    dropped = sum(queue.send(lane, receiver.take((lane, n)), 1) for n in range(1, 6) for lane in "ab")
    assert dropped == 6
    receiver.gate.set()
    until(lambda: len(receiver.got) == 5, "the newest")
    assert receiver.got == [("a", 0), ("a", 4), ("b", 4), ("a", 5), ("b", 5)]
    queue.close()


class Value:
    """A payload that can be seen to go."""


def test_a_sample_that_gave_way_takes_no_memory_while_a_put_blocks() -> None:
    receiver = Receiver()
    queue = stalled(receiver, depth=100, sheds=True)
    value = Value()
    is_there = weakref.ref(value)
    queue.send("a", receiver.take(1), 1, value)
    del value
    assert is_there() is not None
    assert queue.send("a", receiver.take(2), 1) == 1
    assert is_there() is None
    receiver.gate.set()
    until(lambda: receiver.got == [0, 2], "the newest")
    queue.close()


def test_what_gave_way_does_not_pile_up_behind_a_put_that_blocks() -> None:
    receiver = Receiver()
    queue = stalled(receiver, depth=100, first="first", sheds=True, keep_last=2)
    queue.send("b", receiver.take("b"), 1)
    queue.then(receiver.take("marker"))
    longest = 0
    for number in range(10_000):
        assert queue.send("a", receiver.take(number), 1) == (number > 1)
        longest = max(longest, len(queue._items))
    assert longest < 3000
    receiver.gate.set()
    until(lambda: len(receiver.got) == 5, "what did not give way")
    assert receiver.got == ["first", "b", "marker", 9998, 9999]
    until(lambda: queue.is_empty, "nothing else waits")
    assert (queue._count, queue._bytes, queue._dead) == (0, 0, 0)
    queue.close()


def test_what_gave_way_is_not_taken_back_nor_counted_behind_that() -> None:
    receiver = Receiver()
    queue = stalled(receiver, depth=100, first="first", sheds=True)
    for number in range(1500):
        queue.send("a", receiver.take(number), 1, number)
    queue.then(receiver.take("marker"))
    assert queue.take_back() == [1499]
    assert (len(queue._items), queue._dead) == (1, 0)
    for number in range(1500, 3000):
        queue.send("a", receiver.take(number), 1, number)
    receiver.gate.set()
    until(lambda: receiver.got == ["first", "marker", 2999], "the newest")
    queue.close()


def test_a_sample_larger_than_the_queue_goes_alone() -> None:
    receiver = Receiver()
    queue = stalled(receiver, depth=10, sheds=False)
    assert queue.has_room(2 * send_queue.MAX_BYTES)
    assert queue.send("a", receiver.take(1), 2 * send_queue.MAX_BYTES) == 0
    assert not queue.has_room(1), "nothing beside it"
    assert queue.send("a", receiver.take(2), 1) == 1
    receiver.gate.set()
    until(lambda: receiver.got == [0, 1], "both")
    assert queue.has_room(1)
    queue.close()


def test_while_it_is_shut_samples_wait_and_a_kick_looks_again() -> None:
    receiver, is_open, looks = Receiver(), threading.Event(), []
    queue = SendQueue("t", depth=10, sheds=False, is_open=is_open.is_set, at_kick=lambda: looks.append(1))
    queue.send("a", receiver.take(1), 1)
    queue.kick()
    until(lambda: looks, "it looked")
    assert receiver.got == []
    is_open.set()
    queue.kick()
    until(lambda: receiver.got == [1], "the sample")
    queue.close()


def test_closing_says_what_still_waited_and_does_the_last_thing() -> None:
    receiver, ended = Receiver(), threading.Event()
    receiver.gate.clear()
    queue = SendQueue("t", depth=10, sheds=False)
    for number in range(3):
        queue.send("a", receiver.take(number), 1)
    until(lambda: queue.is_stalled, "the put blocks")
    assert queue.close(ended.set) == 2
    receiver.gate.set()
    assert ended.wait(3)
    queue.join(3)
    assert receiver.got == [0]
    assert queue.send("a", receiver.take(9), 1) == 1


@pytest.mark.parametrize("error", [ValueError("no way"), SystemExit("no way"), KeyboardInterrupt("no way")])
def test_a_failing_put_does_not_end_the_stream(error: BaseException, caplog: pytest.LogCaptureFixture) -> None:
    def fail() -> None:
        raise error

    receiver = Receiver()
    queue = SendQueue("t", depth=10, sheds=False)
    queue.send("a", fail, 1)
    queue.send("a", receiver.take(1), 1)
    until(lambda: receiver.got == [1], "the next one")
    assert "no way" in caplog.text
    queue.close()


def test_what_has_not_gone_out_can_be_taken_back() -> None:
    receiver = Receiver()
    receiver.gate.clear()
    queue = SendQueue("t", depth=10, sheds=False)
    for number in range(4):
        queue.send("a", receiver.take(number), 1, f"value {number}")
    queue.then(receiver.take("end"))
    until(lambda: queue.is_stalled, "the put blocks")
    assert queue.take_back() == ["value 1", "value 2", "value 3"]
    receiver.gate.set()
    until(lambda: receiver.got == [0, "end"], "what was in hand, and the marker")
    assert queue.close() == 0


def test_a_lane_of_which_nothing_waits_takes_no_memory() -> None:
    """A wildcard rule has a lane for each key, and keys come from applications and workers."""
    receiver = Receiver()
    queue = SendQueue("t", depth=10, sheds=True)
    for number in range(100):
        queue.send(number, receiver.take(number), 1)
    until(lambda: len(receiver.got) == 100, "all of it")
    assert not queue._lines
    queue.close()
