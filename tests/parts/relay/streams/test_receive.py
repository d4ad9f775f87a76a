"""What a receiver does with samples that come faster than it carries them."""

from __future__ import annotations

import threading

import pytest
import zenoh

from support.sessions import hub_and_neighbour, matches
from support.waiting import until
from zsched.core.values.plan import StreamClass, StreamSettings
from zsched.relay.streams import receive
from zsched.relay.streams.receive import Receiver

KEY = "robot1/in"
COUNT = 200


class Held:
    """A receiver whose first sample stays in hand until `may_go_on`."""

    def __init__(self, relay: zenoh.Session, stream_class: StreamClass) -> None:
        self.carried: list[int] = []
        self.gone: list[int] = []
        self.may_go_on = threading.Event()
        settings = StreamSettings(stream_class=stream_class, depth=16)
        self._receiver = Receiver(relay, KEY, settings, self._carry, with_history=False, give_way=self._give_way)

    def _carry(self, sample: zenoh.Sample) -> None:
        self.carried.append(int(sample.payload.to_bytes()))
        self.may_go_on.wait(60.0)

    def _give_way(self, sample: zenoh.Sample) -> None:
        self.gone.append(int(sample.payload.to_bytes()))

    def close(self) -> None:
        self._receiver.close()


def publisher_of(outside: zenoh.Session) -> zenoh.Publisher:
    """One that the receiver hears."""
    publisher = outside.declare_publisher(KEY, congestion_control=zenoh.CongestionControl.BLOCK)
    until(lambda: matches(publisher), "the relay subscribes")
    return publisher


@pytest.mark.parametrize("stream_class", list(StreamClass))
def test_every_sample_that_comes_is_carried_or_gives_way_to_newer_ones(
    stream_class: StreamClass, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(receive, "BEHIND_S", 0.0)
    reached: list[zenoh.Sample] = []
    with hub_and_neighbour() as (relay, outside):
        held = Held(relay, stream_class)
        beside = relay.declare_subscriber(KEY, reached.append)
        publisher = publisher_of(outside)
        publisher.put("0")
        until(lambda: held.carried == [0], "the first is in hand")
        for number in range(1, COUNT):
            publisher.put(str(number))
        until(lambda: len(reached) == COUNT, "all have reached the relay")
        held.may_go_on.set()
        until(lambda: held.carried[-1] == COUNT - 1, "the newest")
        assert sorted(held.carried + held.gone) == list(range(COUNT))
        assert held.carried == sorted(held.carried)
        if stream_class is StreamClass.BEST_EFFORT:
            assert len(held.gone) > COUNT // 2
            assert held.gone == list(range(1, len(held.gone) + 1)), "the oldest behind the one in hand"
        else:
            assert not held.gone, "the newest value of a key may be among the oldest samples"
        held.close()
        beside.undeclare()


@pytest.mark.parametrize(("most_of_zenohs", "count"), [(8, 200), (16, 1000)], ids=["a queue of its own", "zenoh's"])
@pytest.mark.parametrize("stream_class", [StreamClass.LATEST, StreamClass.RELIABLE])
def test_a_full_queue_makes_the_link_wait_and_drops_nothing(
    stream_class: StreamClass, most_of_zenohs: int, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A ring of zenoh's would drop the oldest here, in no counter."""
    monkeypatch.setattr(receive, "QUEUE_DEPTH", most_of_zenohs)
    reached: list[zenoh.Sample] = []
    with hub_and_neighbour() as (relay, outside):
        held = Held(relay, stream_class)
        try:
            publisher = publisher_of(outside)
            publisher.put("0")
            until(lambda: held.carried == [0], "the first is in hand")
            beside = relay.declare_subscriber(KEY, reached.append)  # declared later, so it is handed each one later
            for number in range(1, count):
                publisher.put(str(number))
            until(lambda: len(reached) >= 16, "the queue is full")
            with pytest.raises(AssertionError):
                until(lambda: len(reached) == count - 1, "the link does not wait", 0.5)
        finally:
            held.may_go_on.set()
        until(lambda: held.carried[-1] == count - 1, "the newest")
        assert held.carried == list(range(count))
        assert not held.gone
        held.close()
        beside.undeclare()


def test_a_stream_goes_on_behind_a_sample_that_cannot_be_carried() -> None:
    carried: list[int] = []

    def carry(sample: zenoh.Sample) -> None:
        carried.append(int(sample.payload.to_bytes()))
        if carried == [0]:
            raise ValueError(sample)

    with hub_and_neighbour() as (relay, outside):
        settings = StreamSettings(stream_class=StreamClass.BEST_EFFORT, depth=16)
        receiver = Receiver(relay, KEY, settings, carry, with_history=False, give_way=lambda _: None)
        publisher = publisher_of(outside)
        for number in range(2):
            publisher.put(str(number))
        until(lambda: carried == [0, 1], "both")
        receiver.close()
