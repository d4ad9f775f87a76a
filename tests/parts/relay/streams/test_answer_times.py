"""How far outputs come behind their inputs, at a robot's relay."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import zenoh

from support.sessions import hub_and_neighbour
from support.waiting import until
from zsched.core.values.plan import Direction, Route, StreamClass, StreamSettings
from zsched.relay.streams import answer_times
from zsched.relay.streams import counter as counters
from zsched.relay.streams.answer_times import MAX_SENT, AnswerTimes
from zsched.relay.streams.counter import StreamCounter
from zsched.relay.streams.inputs import InputStream

A, B = "merge/out/0", "merge/out/1"


@pytest.fixture
def at(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """Sets the clock."""

    def set_to(now: float) -> None:
        monkeypatch.setattr(answer_times, "monotonic_s", lambda: now)

    return set_to


def stamps(count: int) -> list[zenoh.Timestamp]:
    with hub_and_neighbour() as (hub, _):
        return [hub.new_timestamp() for _ in range(count)]


def test_an_answer_with_its_input_s_timestamp_is_told_exactly(at: Callable[[float], None]) -> None:
    one, two, stranger = stamps(3)
    times = AnswerTimes()
    at(10.0)
    assert times.answered(one, A) is None, "nothing was sent"
    times.sent(one)
    at(10.3)
    times.sent(two)
    at(10.5)
    assert times.answered(one, A) == pytest.approx((0.5, True))
    assert times.answered(two, A) == pytest.approx((0.2, True))
    assert times.answered(two, B) == pytest.approx((0.2, True)), "an input may have an answer on each stream"
    assert times.answered(stranger, A) == pytest.approx((0.2, False)), "at least as old as the newest input"
    assert times.answered(None, A) == pytest.approx((0.2, False))


def test_what_a_worker_says_again_is_no_answer(at: Callable[[float], None]) -> None:
    """It publishes at a rate of its own, with the timestamp of its newest input."""
    (one,) = stamps(1)
    times = AnswerTimes()
    at(10.0)
    times.sent(one)
    at(10.1)
    assert times.answered(one, A) == pytest.approx((0.1, True))
    at(100.0)
    assert times.answered(one, A) is None
    times.sent(one)
    at(100.2)
    assert times.answered(one, A) == pytest.approx((0.2, True)), "a kept value was sent anew: to another worker"


def test_a_kept_value_that_another_worker_gets_is_timed_from_then_on(at: Callable[[float], None]) -> None:
    settings = StreamSettings(stream_class=StreamClass.LATEST, depth=100)
    route = Route(
        stream="t/in/0", direction=Direction.INPUT, from_expr="robot1/map", to_expr="edge1/t/map", settings=settings
    )
    with hub_and_neighbour() as (relay, outside):
        heard: list[zenoh.Sample] = []
        outside.declare_subscriber("edge1/t/map", heard.append)
        times = AnswerTimes()
        at(10.0)
        stream = InputStream(relay, route, frozenset({str(relay.zid())}), times=times)
        try:
            until(lambda: outside.put("robot1/map", "x") or stream.count().messages, "the relay's subscription")
            stream.open(1, route)
            until(lambda: stream.is_matching(1), "the worker's subscription")
            at(3610.0)
            assert stream.warm_up(1) == 1
            until(lambda: heard, "the kept value")
            at(3610.1)
            assert times.answered(heard[0].timestamp, A) == pytest.approx((0.1, True))
        finally:
            stream.close()


def test_inputs_without_timestamps_and_very_many_of_them_cost_no_memory(at: Callable[[float], None]) -> None:
    first, *others = stamps(MAX_SENT + 1)
    times = AnswerTimes()
    for number, stamp in enumerate((first, *others)):
        at(float(number))
        times.sent(stamp)
    times.sent(None)
    assert len(times._sent) == MAX_SENT
    at(MAX_SENT + 1.0)
    assert times.answered(first, A) == pytest.approx((1.0, False)), "it was forgotten: the newest one counts"


def test_a_count_tells_the_mean_since_the_one_before() -> None:
    counter = StreamCounter("merge/out/0")
    assert counter.value().answer_s is None
    for took_s in (0.1, 0.3):
        counter.answered(took_s, is_paired=False)
    told = counter.value()
    assert (told.answer_s, told.paired_hz) == pytest.approx((0.2, None))
    assert counter.value().answer_s is None


def test_with_answers_that_have_their_input_s_timestamp_a_count_tells_of_these_only(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(counters, "monotonic_s", lambda: 10.0)
    counter = StreamCounter("merge/out/0")
    for took_s, is_paired in ((0.1, False), (0.5, True), (0.7, True)):
        counter.answered(took_s, is_paired=is_paired)
    monkeypatch.setattr(counters, "monotonic_s", lambda: 14.0)
    told = counter.value()
    assert (told.answer_s, told.paired_hz) == pytest.approx((0.6, 0.5))
    monkeypatch.setattr(counters, "monotonic_s", lambda: 15.0)
    told = counter.value()
    assert (told.answer_s, told.paired_hz) == (None, None), "each count begins anew"
