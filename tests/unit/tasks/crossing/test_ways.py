"""Which gateway is asked, in which order, and for how long."""

from __future__ import annotations

from zsched.tasks.crossing.parcels import LASTING, Parcel
from zsched.tasks.crossing.ways import Ways

PARCEL = Parcel(name="robot1/map", life="a1", number=1)


class Gate:
    """Takes while it is open."""

    def __init__(self, endpoint: str, *, is_open: bool) -> None:
        self.endpoint, self.is_open, self.asked, self.why = endpoint, is_open, 0, "is shut"

    def give(self, _parcel: Parcel) -> str:
        self.asked += 1
        return "" if self.is_open else self.why

    def reach(self) -> str:
        return self.give(PARCEL)


class Time:
    """A clock that stands still but for pauses."""

    def __init__(self) -> None:
        self.now = 0.0
        self.is_over = False

    def __call__(self) -> float:
        return self.now

    def goes_on(self, pause_s: float) -> bool:
        self.now += pause_s
        return not self.is_over


def test_the_one_that_took_last_is_asked_first() -> None:
    first, second, time = Gate("tcp/1", is_open=False), Gate("tcp/2", is_open=True), Time()
    ways = Ways([first, second], time)
    for _ in range(3):
        assert ways.give(PARCEL, 10.0, time.goes_on) == ""
    assert (first.asked, second.asked) == (1, 3)
    first.is_open, second.is_open = True, False
    assert ways.give(PARCEL, 10.0, time.goes_on) == ""
    assert (first.asked, second.asked) == (2, 4)
    assert time.now == 0.0  # no pause: the next one is asked at once


def test_all_are_asked_until_patience_is_over_and_each_says_why() -> None:
    gates, time = [Gate("tcp/1", is_open=False), Gate("tcp/2", is_open=False)], Time()
    assert Ways(gates, time).give(PARCEL, 1.0, time.goes_on) == "at tcp/1 is shut; at tcp/2 is shut"
    assert 1.0 <= time.now < 1.2
    assert gates[0].asked == gates[1].asked > 5


def test_one_that_comes_back_meanwhile_takes() -> None:
    gate, time = Gate("tcp/1", is_open=False), Time()

    def goes_on(pause_s: float) -> bool:
        gate.is_open = time.now > 0.5
        return time.goes_on(pause_s)

    assert Ways([gate], time).give(PARCEL, 10.0, goes_on) == ""
    assert time.now < 1.0


def test_nothing_is_tried_again_once_it_is_over() -> None:
    gate, time = Gate("tcp/1", is_open=False), Time()
    time.is_over = True
    assert Ways([gate], time).give(PARCEL, 10.0, time.goes_on) == "at tcp/1 is shut"
    assert gate.asked == 1
    assert Ways([gate], time).reach() == "at tcp/1 is shut"


def test_what_is_refused_for_good_costs_no_patience() -> None:
    first, second, third = (Gate(f"tcp/{number}", is_open=False) for number in (1, 2, 3))
    second.why = f"failed: AdapterError: {LASTING}robot1/map: 4096 keys have come already"
    ways, time = Ways([first, second, third], Time()), Time()
    for _ in range(2):
        assert ways.give(PARCEL, 10.0, time.goes_on).endswith(f"at tcp/2 {second.why}")
    assert (time.now, first.asked, second.asked, third.asked) == (0.0, 1, 2, 0), "the one that has the owner first"
