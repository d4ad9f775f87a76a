"""How far away another node is, by which of our profiles it echoes."""

from __future__ import annotations

from dataclasses import replace

from support.profiles import profile_of
from zsched.core.gateway.round_trips import BREAK_S, ECHO_S, KEPT, SENT, RoundTrips
from zsched.core.values.profile import Echo

MINE = profile_of("robot1", incarnation=7, sequence=0, memory_mb=100.0, memory_used_mb=1.0)
EDGE = replace(MINE, node="edge1", incarnation=3)


def exchange(mine: RoundTrips, there_s: float, held_s: float, back_s: float, sequence: int, at: float = 100.0) -> None:
    """One profile of ours goes there, is kept, and comes back in the edge's next one."""
    edge = RoundTrips("edge1")
    mine.note_sent(replace(MINE, sequence=sequence), at)
    edge.note_heard(replace(MINE, sequence=sequence), 3, 5000.0)
    echoes = edge.echoes(5000.0 + held_s)
    mine.note_heard(replace(EDGE, sequence=sequence, echoes=echoes), 7, at + there_s + held_s + back_s)


def test_what_is_left_of_the_time_since_we_sent_is_the_way_whatever_the_other_clock_says() -> None:
    mine = RoundTrips("robot1")
    assert mine.seconds() == {}
    exchange(mine, 0.01, 0.6, 0.03, 1)
    assert round(mine.seconds()["edge1"], 6) == 0.04


def test_the_least_of_the_last_ones_counts() -> None:
    mine = RoundTrips("robot1")
    for sequence, slow_s in enumerate((0.5, 0.0, 0.9)):
        exchange(mine, 0.01, 0.2, 0.01 + slow_s, sequence)
    assert round(mine.seconds()["edge1"], 6) == 0.02
    for sequence in range(10, 10 + KEPT):
        exchange(mine, 0.05, 0.2, 0.05, sequence)
    assert round(mine.seconds()["edge1"], 6) == 0.1, "and it can rise"


def test_what_was_measured_before_a_break_counts_until_the_next_one_and_no_longer() -> None:
    """A machine that was away for an hour, or a deadline that was taken off for one, comes back another way."""
    mine = RoundTrips("robot1")
    for sequence in range(KEPT):
        exchange(mine, 0.01, 0.2, 0.01, sequence)
    later = 100.22 + BREAK_S
    exchange(mine, 0.3, 0.0, 0.3, KEPT, later - 0.6)
    assert round(mine.seconds()["edge1"], 6) == 0.02, "no break yet"
    exchange(mine, 0.3, 0.0, 0.3, KEPT + 1, later + BREAK_S)
    assert round(mine.seconds()["edge1"], 6) == 0.6
    exchange(mine, 0.3, 0.0, 0.2, KEPT + 2, later + BREAK_S + 1.0)
    assert round(mine.seconds()["edge1"], 6) == 0.5, "and the least counts again"


def test_echoes_that_mean_nothing_change_nothing() -> None:
    mine = RoundTrips("robot1")
    mine.note_sent(replace(MINE, sequence=1), 100.0)
    good = Echo(node="robot1", incarnation=7, sequence=1, held_s=0.1)
    for bad in (
        replace(good, node="robot2"),
        replace(good, incarnation=6),
        replace(good, sequence=2),
        replace(good, held_s=5.0),
    ):
        mine.note_heard(replace(EDGE, echoes=(bad,)), 7, 101.0)
    assert mine.seconds() == {}
    for sequence in range(2, 2 + SENT):
        mine.note_sent(replace(MINE, sequence=sequence), 100.0)
    mine.note_heard(replace(EDGE, echoes=(good,)), 7, 101.0)
    assert mine.seconds() == {}, "so old a one is forgotten"


def test_a_profile_is_echoed_for_as_long_as_it_may_mean_something() -> None:
    edge = RoundTrips("edge1")
    edge.note_heard(MINE, 3, 50.0)
    assert [echo.held_s for echo in edge.echoes(50.0 + ECHO_S)] == [ECHO_S]
    assert edge.echoes(50.1 + ECHO_S) == ()
