"""Which inputs are held back for their answers, without a worker (with one: `tests/unit/worker/test_debts.py`)."""

from __future__ import annotations

from zsched.core.hop.held import Done, Held, HeldInputs
from zsched.core.hop.receiver import MAX_SOURCES
from zsched.core.hop.shared import SharedSender
from zsched.core.values.relay_protocol import StreamAck

RELAY = "aa1"
NAME, BESIDE = ("edge1/t/robot1/in", RELAY, 7), ("edge1/t/robot1/beside", RELAY, 8)


def a_lane(count: int, arrived: int = 0) -> SharedSender:
    """``count`` answers, of which the relay has the first ones."""
    lane = SharedSender(limit=100)
    for _ in range(count):
        lane.note_put(None, None, 1, 0.0)
    hear(lane, arrived)
    return lane


def hear(lane: SharedSender, arrived: int) -> None:
    lane.hear(RELAY, "robot1", StreamAck(eid=1, first=0, arrived=arrived, processed=arrived), 0.0)


def test_an_input_that_owes_nothing_is_done_at_once_unless_one_before_it_or_its_own_answer_is_withheld() -> None:
    held: HeldInputs[SharedSender] = HeldInputs()
    assert held.hold(NAME, 0, 1, {}) is None
    first = held.hold(NAME, 1, 2, {}, is_unanswered=True)
    assert isinstance(first, Held)
    assert held.hold(NAME, 2, 4, {}) is first, "what comes behind it waits with it"
    assert held.hold(BESIDE, 0, 1, {}) is None, "other sources do not"
    assert held.settle(0.0) == []
    first.unanswered -= 1
    assert held.settle(0.0) == [Done(NAME, 2, 6)]
    assert held.hold(NAME, 3, 1, {}) is None, "nothing is held any more"


def test_each_input_whose_answer_was_withheld_has_its_turn_until_nobody_waits_for_them() -> None:
    held: HeldInputs[SharedSender] = HeldInputs()
    withheld = [held.hold(NAME, number, 1, {}, is_unanswered=True) for number in range(3)]
    assert withheld[0] is not None
    withheld[0].unanswered -= 1
    assert held.settle(0.0) == [Done(NAME, 0, 1)]
    held.forget(NAME)
    assert held.hold(NAME, 3, 1, {}) is None


def test_each_input_is_done_when_its_own_answers_have_come_in_the_order_of_its_source() -> None:
    held: HeldInputs[SharedSender] = HeldInputs()
    lane, other = a_lane(3), a_lane(1)
    held.hold(NAME, 0, 1, {lane: 1, other: 1})
    held.hold(NAME, 1, 1, {lane: 2})
    held.hold(BESIDE, 5, 1, {lane: 3})
    hear(lane, 2)
    assert held.settle(0.0) == [], "the first one still waits for its other answer"
    hear(other, 1)
    assert held.settle(0.0) == [Done(NAME, 0, 1), Done(NAME, 1, 1)]
    hear(lane, 3)
    assert held.settle(0.0) == [Done(BESIDE, 5, 1)]


def test_beyond_so_many_sources_the_one_that_is_held_longest_is_forgotten() -> None:
    held: HeldInputs[SharedSender] = HeldInputs()
    lane = a_lane(1)
    for number in range(MAX_SOURCES + 1):
        held.hold(("in", RELAY, number), 0, 1, {lane: 1})
        assert len(held.lines) == min(number + 1, MAX_SOURCES)
    hear(lane, 1)
    assert [done.name[2] for done in held.settle(0.0)] == list(range(1, MAX_SOURCES + 1))
