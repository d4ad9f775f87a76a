"""A sender with several receivers, without threads: what each of them is owed, and when."""

from __future__ import annotations

from typing import Any

from zsched.core.hop.kept import NOTHING, RESEND_S, Owed
from zsched.core.hop.serial import SPAN
from zsched.core.hop.shared import (
    ASKED_S,
    BATCH,
    FORGET_S,
    LOOK_S,
    MAX_PAUSE_S,
    MAX_RECEIVERS,
    NEWCOMERS_S,
    STALLED_S,
    TICK_S,
    SharedSender,
)
from zsched.core.values.relay_protocol import EndMarker, StreamAck


def sender(count: int = 0, limit: int = 100, *, first: int = 0, is_whole: bool = True) -> SharedSender:
    made = SharedSender(limit=limit, count=first, is_whole=is_whole)
    for number in range(first, first + count):
        assert made.note_put(None, None, 10, 0.0) == number
    return made


def ack(books: SharedSender, name: str, arrived: int, now: float, **more: Any) -> None:
    books.hear(name, f"node-{name}", StreamAck(eid=1, first=0, arrived=arrived, processed=arrived, **more), now)


def owed(books: SharedSender, name: str, now: float, *, is_reached: bool = True) -> tuple[int | None, list[int]]:
    one = books.take_owed(name, now, is_reached=is_reached)
    return one.skip, [sent.number for sent in one.again]


def test_each_receiver_is_owed_what_it_lacks_itself() -> None:
    books = sender(6)
    ack(books, "a", 1, 1.0, has_gap=True, until=3)
    ack(books, "b", 6, 1.0)
    ack(books, "c", 4, 1.0, has_gap=True)
    assert books.owing() == ("a", "c")
    assert owed(books, "a", 1.0) == (None, [1, 2])
    assert owed(books, "b", 1.0) == (None, [])
    assert owed(books, "c", 1.0) == (None, [4, 5])
    assert books.owing() == ()


def test_what_is_asked_for_once_more_is_on_its_way_for_a_moment() -> None:
    books = sender(6)
    ack(books, "a", 1, 1.0, has_gap=True)
    owed(books, "a", 1.0)
    ack(books, "a", 1, 1.0 + ASKED_S / 2, has_gap=True)
    assert books.owing() == ()
    ack(books, "a", 1, 1.0 + 2 * ASKED_S, has_gap=True)
    assert books.owing() == ("a",)


def test_who_asks_hears_what_is_kept_no_more_and_who_does_not_ask_is_only_late() -> None:
    books = sender(6, limit=2)
    ack(books, "a", 1, 1.0, has_gap=True, until=5)
    assert owed(books, "a", 1.0) == (4, [4])
    books.look_after(1.0 + RESEND_S)
    assert owed(books, "a", 2.0) == (None, [4, 5])


def test_late_ones_are_put_again_with_more_patience_each_time_until_there_is_progress() -> None:
    books, now, at = sender(6), 1.0, []
    ack(books, "a", 1, now)
    while now < 9.0:
        now += 0.01
        books.look_after(now)
        if books.owing():
            at.append(now)
            assert owed(books, "a", now) == (None, [1, 2, 3, 4, 5])
    pauses = [round(after - before, 1) for before, after in zip([1.0, *at], at, strict=False)]
    assert pauses[:4] == [RESEND_S, 2 * RESEND_S, 4 * RESEND_S, MAX_PAUSE_S]
    ack(books, "a", 2, now)
    books.look_after(now + RESEND_S + 0.01)
    assert books.owing() == ("a",)


def test_what_was_put_a_moment_ago_is_not_late_however_long_there_was_nothing_to_put() -> None:
    books = sender(1)
    ack(books, "a", 1, 1.0)
    books.look_after(8.0)
    books.note_put(None, None, 10, 9.0)
    books.look_after(8.99 + RESEND_S)
    assert books.owing() == ()
    books.look_after(9.01 + RESEND_S)
    assert books.owing() == ("a",)


def test_beyond_so_many_receivers_the_longest_silent_one_that_was_never_reached_goes() -> None:
    books = sender(3)
    for number in range(MAX_RECEIVERS):
        ack(books, f"a{number}", 1, 1.0 + number, has_gap=True)
    assert (len(books.receivers), books.crowded_out) == (MAX_RECEIVERS, 0)
    owed(books, "a0", 1000.0)
    ack(books, "b", 1, 1001.0)
    assert (len(books.receivers), books.crowded_out) == (MAX_RECEIVERS, 1)
    assert {"a0", "b"} <= books.receivers.keys()
    assert "a1" not in books.receivers


def test_of_receivers_that_have_gone_only_the_last_ones_are_remembered() -> None:
    books = sender(3)
    books.forget("nobody")
    assert books.had == {}
    for number in range(MAX_RECEIVERS + 1):
        ack(books, f"a{number}", 1, 1.0)
        books.forget(f"a{number}")
    assert list(books.had) == [f"a{number}" for number in range(1, MAX_RECEIVERS + 1)]


def test_who_comes_back_knows_what_it_had_and_a_new_one_on_its_node_does_not() -> None:
    books = sender(6)
    ack(books, "a", 4, 1.0)
    books.forget("a")
    ack(books, "a", 5, 2.0)
    assert (books.receivers["a"].had, books.had) == (None, {})
    books.hear("next", "node-a", StreamAck(eid=1, first=0, arrived=0, processed=0), 3.0)
    assert books.receivers["next"].had == 5


def test_an_input_waits_for_so_many_that_never_spoke_and_for_no_more() -> None:
    """Names come from other machines: a peer that makes them up fills no memory, and holds up no input."""
    books = sender(3)
    assert {books.settled(f"a{number}", 1.0) for number in range(MAX_RECEIVERS)} == {0}
    assert books.settled("b", 1.0) == 3
    assert len(books.expected) == MAX_RECEIVERS


def test_an_input_waits_for_a_new_relay_s_first_word_after_any_number_of_lives() -> None:
    books = sender(5)
    for number in range(MAX_RECEIVERS):
        assert books.settled(f"life{number}", 1.0) == 0
    now = 1.0 + LOOK_S
    in_doubt = books.in_doubt(now)
    assert len(in_doubt) == MAX_RECEIVERS
    for name in in_doubt[:-1]:
        books.decide(name, now, is_there=False)
    assert books.settled("new", now) == 0
    assert len(books.expected) == MAX_RECEIVERS
    assert books.settled(in_doubt[-1], now) == 0, "one that is still waited for is not forgotten"
    books.decide(in_doubt[-1], now, is_there=False)
    assert books.settled(in_doubt[-1], now) == 5
    assert books.in_doubt(now + LOOK_S) == ("new",)
    books.decide("new", now + LOOK_S, is_there=False)
    assert books.settled("new", now + LOOK_S) == 5


def test_much_goes_in_parts_and_progress_brings_the_next() -> None:
    books = sender(2 * BATCH + 1, limit=4 * BATCH)
    ack(books, "a", 0, 1.0, has_gap=True)
    assert owed(books, "a", 1.0) == (None, list(range(BATCH)))
    ack(books, "a", BATCH - 1, 1.1)
    assert books.owing() == ()
    ack(books, "a", BATCH, 1.2)
    assert owed(books, "a", 1.2) == (None, list(range(BATCH, 2 * BATCH)))


def test_who_is_not_reached_is_owed_nothing_and_forgotten_in_the_end() -> None:
    books = sender(3)
    for now in (1.0, 1.0 + FORGET_S, 1.5 + FORGET_S):
        assert "a" in books.receivers or now == 1.0
        ack(books, "a", 1, now, has_gap=True)
        assert owed(books, "a", now, is_reached=False) == (None, [])
    assert books.receivers == {}
    assert books.had == {"a": ("node-a", 1)}


def test_newcomers_find_the_beginning_for_a_while() -> None:
    books = sender(3)
    ack(books, "a", 3, 1.0)
    books.look_after(NEWCOMERS_S - 0.01)
    assert len(books.kept) == 3
    books.look_after(NEWCOMERS_S + 0.01)
    assert len(books.kept) == 0
    ack(books, "b", 0, NEWCOMERS_S + 0.02, has_gap=True, until=3)
    assert owed(books, "b", NEWCOMERS_S + 0.02) == (3, [])
    assert books.skip_marker("b", 3, 5.0) == EndMarker(epoch=0, count=3, age_s=5.0)


def test_of_class_latest_a_late_one_is_asked_first_how_far_it_is() -> None:
    books = sender(6, is_whole=False)
    ack(books, "a", 1, 1.0)
    books.look_after(2.0)
    assert books.take_owed("a", 2.0, is_reached=True) == Owed(skip=1)
    ack(books, "a", 1, 2.1)
    assert owed(books, "a", 2.1) == (None, [1, 2, 3, 4, 5])
    books.look_after(5.0)
    assert owed(books, "a", 5.0) == (1, [])
    books.note_put(None, None, 10, 5.0)
    ack(books, "a", 1, 5.1)
    assert books.take_owed("a", 5.1, is_reached=True) is NOTHING, "a newer one is on its way"


def test_the_end_marker_is_put_again_for_who_lacks_nothing_else() -> None:
    books, marker = sender(2), EndMarker(epoch=1, count=2)
    ack(books, "a", 2, 1.0)
    books.note_end(marker, 1.0)
    assert books.needs_way("a")
    books.look_after(1.1 + RESEND_S)
    assert books.take_owed("a", 2.0, is_reached=True) == Owed(end=marker)
    ack(books, "a", 2, 2.1, is_ended=True)
    assert not books.needs_way("a")
    books.look_after(NEWCOMERS_S + 1.0)
    assert books.next_deadline(NEWCOMERS_S + 1.0) is None


def test_it_is_looked_after_while_anything_is_kept() -> None:
    books = sender()
    assert books.next_deadline(1.0) is None
    books.note_put(None, None, 10, 1.0)
    assert books.next_deadline(1.0) == 1.0 + TICK_S
    books.look_after(1.1 + FORGET_S)
    assert books.next_deadline(1.1 + FORGET_S) is None


def test_who_is_expected_is_looked_for_until_it_is_known_or_not_there() -> None:
    books = sender(1)
    for name in ("a", "b", "c"):
        assert books.settled(name, 1.0) == 0
    ack(books, "a", 1, 1.0)
    assert books.in_doubt(1.0) == ()
    assert books.in_doubt(1.0 + LOOK_S) == ("b", "c")
    books.decide("b", 1.0 + LOOK_S, is_there=False)
    books.decide("c", 1.0 + LOOK_S, is_there=True)
    assert (books.settled("b", 1.2), books.settled("c", 1.2)) == (1, 0)
    assert books.in_doubt(1.2) == ("c",)
    assert (books.needs_way("b"), books.needs_way("c")) == (False, True)
    books.give_up()
    assert (books.settled("c", 1.2), books.in_doubt(1.2)) == (1, ())


def test_numbers_go_on_beyond_what_travels() -> None:
    books = sender(6, first=SPAN - 3)
    ack(books, "a", 1, 1.0, has_gap=True, until=2)
    assert owed(books, "a", 1.0) == (None, [SPAN + 1])


def say(books: SharedSender, name: str, node: str, arrived: int, now: float, **more: Any) -> None:
    books.hear(name, node, StreamAck(eid=1, first=0, arrived=arrived, processed=arrived, **more), now)


def test_what_another_node_says_of_a_relay_lets_go_of_nothing_that_it_lacks() -> None:
    """Its key is its own, and the relay's id in it is its own word: it could have the relay's answers thrown away."""
    books = sender(6)
    say(books, "a", "robot1", 2, 1.0)
    say(books, "a", "robot2", 6, 1.0, has_left=True, is_ended=True)
    assert books.settled("a", 1.0 + STALLED_S) == 2, "its inputs wait for what it lacks"
    late = NEWCOMERS_S + 1.0
    books.look_after(late)
    say(books, "a", "robot2", 6, late, has_left=True)
    assert owed(books, "a", late) == (None, [2, 3, 4, 5])
    assert books.contradicted == 1
    say(books, "a", "robot1", 6, late + 0.1, is_ended=True)
    assert books.settled("a", late + 0.1) == 6
    assert not books.kept


def test_whoever_speaks_first_for_a_relay_the_relay_is_heard_and_sent_what_it_lacks() -> None:
    books = sender(6)
    say(books, "a", "robot2", 6, 1.0, has_left=True, is_ended=True)
    say(books, "a", "robot1", 2, 1.0, has_gap=True)
    (name,) = books.owing()
    assert name.split()[0] == "a"
    assert owed(books, name, 1.0) == (None, [2, 3, 4, 5])
    assert books.settled("a", 1.0) == 2
    books.forget("a")
    say(books, "a", "robot1", 4, 1.1)
    assert list(books.receivers) == [name]
    assert books.receivers[name].arrived == 4


def test_another_node_cannot_hold_back_the_inputs_of_a_relay_by_standing_still() -> None:
    books = sender(6)
    say(books, "a", "robot1", 6, 1.0)
    say(books, "a", "robot2", 0, 1.0)
    assert books.settled("a", 1.5) == 0
    assert books.settled("a", 1.0 + STALLED_S + 0.1) == 6


def test_who_had_everything_and_stands_still_from_then_on_stops_the_inputs_of_others_no_longer() -> None:
    books = sender(2)
    for name in ("a", "b"):
        ack(books, name, 2, 1.0)
    books.note_put(None, None, 10, 2.0)
    books.look_after(2.0)
    ack(books, "b", 3, 2.1)
    assert books.settled("b", 2.0 + STALLED_S) == 2
    assert books.settled("b", 2.1 + STALLED_S) == 3


def test_an_end_marker_that_was_put_a_moment_ago_is_not_put_again() -> None:
    books = sender(2)
    ack(books, "a", 2, 1.0)
    books.note_end(EndMarker(epoch=1, count=2), 5.0)
    books.look_after(4.99 + RESEND_S)
    assert books.owing() == ()
    books.look_after(5.01 + RESEND_S)
    assert books.owing() == ("a",)


def test_a_receiver_that_comes_before_the_first_sample_is_owed_nothing() -> None:
    books = sender()
    ack(books, "a", 0, 1.0)
    assert (books.owing(), books.next_deadline(1.0)) == ((), None)
    assert books.skip_marker("a", 0, 1.0) == EndMarker(epoch=0, count=0)


def test_a_new_life_has_had_what_its_own_node_has_acknowledged_and_no_other() -> None:
    books = sender(6)
    say(books, "a", "robot1", 5, 1.0)
    say(books, "b", "robot2", 3, 1.0)
    say(books, "c", "robot1", 0, 2.0)
    say(books, "d", "robot2", 0, 2.0)
    say(books, "e", "robot3", 0, 2.0)
    assert [books.skip_marker(name, 6, 2.0).had for name in ("c", "d", "e")] == [5, 3, None]
