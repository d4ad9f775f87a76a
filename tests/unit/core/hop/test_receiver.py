"""The receiving side of a hop, without threads: what is admitted, what is lost, and that each number is one of both."""

from __future__ import annotations

from random import Random

import pytest

from zsched.core.hop.receiver import GIVE_UP_S, MAX_AHEAD, RETURN, RunningTime, Source
from zsched.core.hop.serial import SPAN, serial_of


def heard(source: Source, *numbers: int, now: float = 0.0, in_turn: bool = True) -> list[bool]:
    return [source.admit(source.number(serial_of(number)), now, in_turn=in_turn) for number in numbers]


def test_what_is_missing_is_waited_for_and_then_given_up() -> None:
    source = Source.at(0)
    assert heard(source, 0, 2, now=10.0) == [True, False]
    assert source.ack(7).has_gap
    assert heard(source, 3, now=10.0 + GIVE_UP_S) == [False], "not a moment longer than it has to"
    assert heard(source, 3, now=10.001 + GIVE_UP_S) == [True]
    assert (source.arrived, source.lost, source.ack(7).has_gap) == (4, 2, False)
    assert heard(source, 1, 3, now=12.0) == [False, False]
    assert (source.reordered, source.doubled) == (1, 1)


def test_who_wants_only_the_newest_waits_for_nothing() -> None:
    source = Source.at(5)
    assert heard(source, 5, 9, 7, 9, in_turn=False) == [True, True, False, False]
    assert (source.arrived, source.lost, source.reordered, source.doubled) == (10, 3, 1, 1)


def test_the_time_of_a_gap_begins_with_its_first_number_and_ends_when_it_is_filled() -> None:
    source = Source.at(0)
    heard(source, 1, now=1.0)
    assert source.waits_s(1.5) == 0.5
    heard(source, 0, 1, now=1.6)
    assert source.gap_since is None
    assert source.waits_s(2.0) == 0.0


def test_what_is_absurdly_far_ahead_is_dropped_and_changes_nothing() -> None:
    source = Source.at(0)
    assert heard(source, MAX_AHEAD + 1, in_turn=False) == [False]
    assert source.skip(MAX_AHEAD + 1) == 0
    assert source == Source.at(0)


def test_what_was_in_work_before_a_jump_is_done_before_what_is_behind_it() -> None:
    source = Source.at(0)
    heard(source, 0, 1, in_turn=False)
    source.skip(5)
    heard(source, 5, in_turn=False)
    assert source.done(0)
    assert source.processed == 1
    assert source.done(1)
    assert source.processed == 5, "the lost ones are no work"
    assert source.done(5)
    assert source.processed == 6
    assert not source.done(5), "it is done already"


def test_late_ones_in_a_row_take_a_jump_back_as_if_a_stranger_had_made_it() -> None:
    """What nothing newer has confirmed may be anybody's. The price: the sample that made the jump comes twice."""
    source = Source.at(0)
    assert heard(source, 0, 4, in_turn=False) == [True, True]
    assert heard(source, 1, 2, 3, 4, in_turn=False) == [False, False, True, True]
    assert (source.first, source.arrived, source.lost) == (0, 5, 2)


def test_a_beginning_that_nothing_has_confirmed_is_taken_back_with_its_jump() -> None:
    """A start marker said that nothing before 5 would come; what comes in a row then says where the stream began."""
    source = Source.at(0)
    assert (source.skip(5), source.first) == (0, 5)
    assert heard(source, 0, 1, 2, 3) == [False, False, True, True]
    assert (source.first, source.arrived, source.lost) == (0, 4, 2)


def test_a_jump_that_nothing_follows_proves_nothing() -> None:
    """Anybody can put one number, and with it would call the end markers of the publisher too old."""
    source = Source.at(0)
    assert (heard(source, 0, in_turn=False), source.proven) == ([True], 1)
    assert (heard(source, 5, in_turn=False), source.proven) == ([True], 1)
    assert (heard(source, 6, in_turn=False), source.proven) == ([True], 7)


def test_less_is_believed_of_a_stream_when_enough_start_markers_in_a_row_say_so() -> None:
    source = Source.at(0)
    for _ in range(2):
        source.note_start(0, is_whole=True, replayed=4)
        for _ in range(RETURN - 1):
            source.note_start(0, is_whole=False, replayed=1)
            assert (source.is_whole, source.ack(7).replays) == (True, 4), "one that says more begins the row anew"
    source.note_start(0, is_whole=False, replayed=1)
    assert (source.is_whole, source.ack(7).replays) == (False, 1)


@pytest.mark.parametrize("seed", range(200))
def test_every_number_is_admitted_once_or_lost_whatever_the_way_does(seed: int) -> None:
    """Loss, copies, late ones, skips and pauses; numbers around 2^32. No forged ones: those are the fuzzer's."""
    rng = Random(seed)
    start = rng.choice((0, 1, SPAN - 20))
    in_turn, loss, late = rng.random() < 0.5, rng.choice((0.0, 0.1, 0.4)), rng.choice((0.0, 0.3))
    source, now, sent = Source.at(start), 0.0, start
    way: list[int] = []
    admitted: list[int] = []
    skipped = start
    while sent < start + 60 or way:
        now += rng.choice((0.0, 0.01, GIVE_UP_S))
        if sent < start + 60:
            way += [sent] * (rng.random() >= loss) * rng.choice((1, 1, 2))
            sent += 1
        if in_turn and rng.random() < 0.1:  # the sender puts again what is missing, or says that it keeps no more
            if rng.random() < 0.5:
                way += range(source.arrived, sent)
            else:
                skipped = rng.randint(source.arrived, sent)
                source.skip(skipped)
        while way and rng.random() >= late:
            number = way.pop(0 if rng.random() >= late else rng.randrange(len(way)))
            before = source.arrived
            if source.admit(source.number(serial_of(number)), now, in_turn=in_turn):
                if number < before:
                    return  # late ones took a jump back, see above
                admitted.append(number)
            for done in admitted:
                if rng.random() < 0.7:
                    source.done(done)
        assert source.processed <= source.arrived
    assert len(set(admitted)) == len(admitted), "none twice"
    assert all(number < source.arrived for number in admitted)
    assert len(admitted) + source.lost + (source.first - start) == source.arrived - start
    if in_turn:
        assert admitted == sorted(admitted)


def test_what_a_stopped_process_slept_is_not_waited_for() -> None:
    """Found by the simulated hop: frozen right behind a gap, it gave up what nobody had been asked for."""
    time, source = RunningTime(), Source.at(0)
    assert heard(source, 0, 2, now=time.at(10.0)) == [True, False]
    assert heard(source, 3, now=time.at(14.0)) == [False], "it was stopped"
    for step in range(18):  # it runs, and looks
        assert heard(source, 3, now=time.at(14.0 + step / 25)) == [False]
    assert heard(source, 3, now=time.at(14.8)) == [True]


def test_a_jump_is_taken_back_to_numbers_within_it_only() -> None:
    source = Source.at(0)
    heard(source, 0, 1, 2, 8, in_turn=False)
    before = (source.arrived, source.lost)
    assert not source.go_back(2), "it has come before the jump"
    assert (source.arrived, source.lost) == before
    assert source.go_back(3)
    assert (source.arrived, source.lost) == (4, 0)
    assert not source.go_back(3), "there is none any more"


def test_an_acknowledgement_says_up_to_where_something_is_missing_while_it_is() -> None:
    source = Source.at(0)
    heard(source, 0, 4, now=1.0)
    source.until = 4
    assert (source.ack(7).has_gap, source.ack(7).until) == (True, 4)
    heard(source, 1, now=1.1)
    assert (source.ack(7).has_gap, source.ack(7).until) == (False, 0)
