"""When an input counts as done: its answers are where they should be, and what came before it is done too."""

from __future__ import annotations

import threading
from typing import Any, cast

from zsched.core.hop.held import MAX_HELD
from zsched.core.hop.shared import STALLED_S, SharedSender
from zsched.core.values.relay_protocol import StreamAck
from zsched.link.acknowledger import Acknowledger
from zsched.worker.keep import Debts, KeptLane

OWN, OTHER = "aa1", "bb2"
NAME = ("edge1/t/robot1/in", OWN, 7)


class Told:
    """What an acknowledger is told."""

    def __init__(self) -> None:
        self.numbers: list[int] = []
        self.debts = Debts(cast("Acknowledger", self))

    def processed(self, _name: object, number: int, _size: int) -> None:
        self.numbers.append(number)


def a_lane(count: int = 0) -> KeptLane:
    state = SharedSender(limit=100_000)
    lane = KeptLane(key="k", source_id=cast("Any", None), wake=threading.Event(), state=state)
    put(lane, *range(count))
    return lane


def put(lane: KeptLane, *numbers: int) -> None:
    for number in numbers:
        assert lane.keep((b"", None, None), None, 1) == number


def ack(lane: KeptLane, relay: str, arrived: int, now: float = 0.0, **more: Any) -> None:
    word = StreamAck(eid=1, first=0, arrived=arrived, processed=arrived, **more)
    lane.hear(relay, f"node-{relay}", word, now)


def test_who_has_answered_nothing_is_done_at_once() -> None:
    told = Told()
    told.debts.processed(NAME, 0, 1, {})
    assert told.numbers == [0]
    assert not told.debts.is_waiting


def test_an_input_is_done_when_its_answer_has_come() -> None:
    told, lane = Told(), a_lane(2)
    ack(lane, OWN, 0)
    told.debts.processed(NAME, 0, 1, {lane: 2})
    for arrived, numbers in ((1, []), (2, [0])):
        ack(lane, OWN, arrived)
        told.debts.settle(0.0)
        assert told.numbers == numbers
    assert not told.debts.is_waiting


def test_what_comes_behind_one_that_waits_waits_too_and_other_sources_do_not() -> None:
    told, lane, other = Told(), a_lane(1), ("edge1/t/robot1/beside", OWN, 8)
    ack(lane, OWN, 0)
    told.debts.processed(NAME, 0, 1, {lane: 1})
    told.debts.processed(NAME, 1, 1, {})
    told.debts.processed(NAME, 2, 1, {})
    told.debts.processed(other, 77, 1, {})
    assert told.numbers == [77]
    ack(lane, OWN, 1)
    told.debts.settle(0.0)
    assert told.numbers == [77, 2]


def test_every_output_counts() -> None:
    told, first, second = Told(), a_lane(1), a_lane(3)
    for lane in (first, second):
        ack(lane, OWN, 0)
    told.debts.processed(NAME, 0, 1, {first: 1, second: 3})
    ack(first, OWN, 1)
    ack(second, OWN, 2)
    told.debts.settle(0.0)
    assert told.numbers == []
    ack(second, OWN, 3)
    told.debts.settle(0.0)
    assert told.numbers == [0]


def test_its_own_robot_is_waited_for_however_long_one_answer_takes() -> None:
    """A large answer takes a slow link longer than any limit; the robot that it is for lacks it all the same."""
    told, lane = Told(), a_lane(1)
    ack(lane, OWN, 0)
    told.debts.processed(NAME, 0, 1, {lane: 1})
    told.debts.settle(8 * STALLED_S)
    assert told.numbers == []
    lane.state.forget(OWN)
    told.debts.settle(8 * STALLED_S)
    assert told.numbers == [0]


def test_its_own_robot_is_waited_for_before_its_first_word() -> None:
    """The first answers of an epoch: the worker learns who gets them from their acknowledgements."""
    told, lane = Told(), a_lane(1)
    told.debts.processed(NAME, 0, 1, {lane: 1})
    told.debts.settle(0.0)
    ack(lane, OTHER, 1)
    told.debts.settle(0.0)
    assert told.numbers == []
    ack(lane, OWN, 1)
    told.debts.settle(0.0)
    assert told.numbers == [0]


def test_who_wants_nothing_more_is_waited_for_no_more() -> None:
    told, lane = Told(), a_lane(2)
    ack(lane, OWN, 1)
    told.debts.processed(NAME, 0, 1, {lane: 2})
    ack(lane, OWN, 1, has_left=True)
    told.debts.settle(0.0)
    assert told.numbers == [0]


def test_another_robot_is_waited_for_while_it_moves() -> None:
    """Also when it is slow: then it is the next input's turn to wait."""
    told, lane = Told(), a_lane(20)
    ack(lane, OWN, 20)
    ack(lane, OTHER, 0)
    for number in range(20):
        told.debts.processed(NAME, number, 1, {lane: number + 1})
    for arrived in range(1, 11):
        now = arrived * 0.8 * STALLED_S
        told.debts.settle(now)
        assert len(told.numbers) == arrived - 1
        ack(lane, OTHER, arrived, now)
        told.debts.settle(now)
        assert len(told.numbers) == arrived


def test_a_frozen_robot_stalls_the_inputs_of_another_once_and_not_for_each() -> None:
    told, lane = Told(), a_lane(1)
    ack(lane, OTHER, 0)
    ack(lane, OWN, 1)
    told.debts.processed(NAME, 0, 1, {lane: 1})
    told.debts.settle(0.9 * STALLED_S)
    assert told.numbers == []
    told.debts.settle(1.1 * STALLED_S)
    assert told.numbers == [0]
    for number in range(1, 50):
        now = (1.1 + number / 100) * STALLED_S
        put(lane, number)
        ack(lane, OWN, number + 1, now)
        lane.state.look_after(now)
        told.debts.processed(NAME, number, 1, {lane: number + 1})
        told.debts.settle(now)
        assert told.numbers[-1] == number
    ack(lane, OTHER, 20, 2.0 * STALLED_S)  # it moves again
    put(lane, 50)
    ack(lane, OWN, 51, 2.0 * STALLED_S)
    told.debts.processed(NAME, 50, 1, {lane: 51})
    told.debts.settle(2.0 * STALLED_S)
    assert told.numbers[-1] == 49


def test_who_has_had_everything_for_long_is_not_stalled_when_there_is_something_new() -> None:
    told, lane = Told(), a_lane(1)
    ack(lane, OTHER, 1)
    ack(lane, OWN, 1)
    lane.state.look_after(9 * STALLED_S)
    put(lane, 1)
    ack(lane, OWN, 2, 9 * STALLED_S)
    told.debts.processed(NAME, 0, 1, {lane: 2})
    lane.state.look_after(9 * STALLED_S)
    told.debts.settle(9.5 * STALLED_S)
    assert told.numbers == []


def test_what_is_held_is_bounded_and_still_waits() -> None:
    told, lane, count = Told(), a_lane(), 2 * MAX_HELD
    put(lane, *range(count))
    ack(lane, OWN, 0)
    for number in range(count):
        told.debts.processed(NAME, number, 1, {lane: number + 1})
    assert len(told.debts._held.lines[NAME]) == MAX_HELD
    ack(lane, OWN, count - 1)
    told.debts.settle(0.0)
    assert told.numbers[-1] == MAX_HELD - 2
    ack(lane, OWN, count)
    told.debts.settle(0.0)
    assert told.numbers[-1] == count - 1


def test_an_output_that_nobody_looks_after_any_more_holds_nothing_back() -> None:
    told, lane = Told(), a_lane(1)
    ack(lane, OWN, 0)
    told.debts.processed(NAME, 0, 1, {lane: 1})
    lane.give_up()
    told.debts.settle(0.0)
    assert told.numbers == [0]


def test_an_input_whose_answer_was_withheld_waits_until_it_has_been_answered() -> None:
    told, lane = Told(), a_lane(1)
    ack(lane, OWN, 0)
    held = told.debts.processed(NAME, 0, 1, {}, is_unanswered=True)
    assert held is not None
    told.debts.processed(NAME, 1, 1, {})
    told.debts.settle(0.0)
    assert told.numbers == []
    told.debts.answered(held, {lane: 1}, 0.0)
    told.debts.settle(0.0)
    assert told.numbers == []
    ack(lane, OWN, 1)
    told.debts.settle(0.0)
    assert told.numbers == [1]


def test_withheld_ones_that_share_a_place_are_all_waited_for() -> None:
    told, count = Told(), MAX_HELD + 3
    helds = [told.debts.processed(NAME, number, 1, {}, is_unanswered=True) for number in range(count)]
    for held in helds[:-1]:
        assert held is not None
        told.debts.answered(held, {}, 0.0)
    assert told.numbers[-1] == MAX_HELD - 2
    assert helds[-1] is not None
    told.debts.answered(helds[-1], {}, 0.0)
    assert told.numbers[-1] == count - 1


def test_nobody_waits_for_what_was_given_up() -> None:
    told = Told()
    held = told.debts.processed(NAME, 0, 1, {}, is_unanswered=True)
    assert held is not None
    told.debts.forget(NAME)
    told.debts.answered(held, {}, 0.0)
    assert told.numbers == []
    assert not told.debts.is_waiting
