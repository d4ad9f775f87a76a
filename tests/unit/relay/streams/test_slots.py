"""What an output's slot knows of its keys and their publishers, whoever else puts under them."""

from __future__ import annotations

from zsched.core.hop.serial import serial_of
from zsched.core.relay_protocol import EndMarker
from zsched.relay.streams.counter import StreamCounter
from zsched.relay.streams.slots import END_GRACE_S, KeyState

WORKER, ANOTHER = ("a" * 32, 1), ("b" * 32, 1)


def taken(key: KeyState, publisher: tuple[str, int], *numbers: int) -> None:
    for number in numbers:
        key.received += 1
        key.take(publisher, serial_of(number), None, StreamCounter("t/out/0"))


def test_an_end_is_reached_by_its_own_publisher_only() -> None:
    """What another one had put counted, too: a worker that was restarted in place ended before its last answers."""
    key = KeyState(name="out")
    taken(key, ANOTHER, *range(50))
    taken(key, WORKER, 0, 1)
    assert key.take_end(EndMarker(epoch=1, count=4), WORKER, 0.0)
    assert not key.is_ended(0.0, None)
    taken(key, WORKER, 2, 3)
    taken(key, ANOTHER, 50)
    assert key.is_ended(0.0, None)


def test_a_strange_number_takes_no_end_for_another_one() -> None:
    """The end was read near the newest number of anybody: 4294967196 samples were called lost."""
    key = KeyState(name="out")
    taken(key, WORKER, *range(100))
    taken(key, ANOTHER, 3_000_000_000)
    assert key.take_end(EndMarker(epoch=1, count=102), WORKER, 0.0)
    assert not key.is_ended(0.0, None)
    assert key.is_ended(END_GRACE_S + 0.1, None)
    assert key.missing(None) == 2
