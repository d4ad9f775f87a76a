"""At most so many moves of a task in a minute."""

from __future__ import annotations

from support.allocations import allocation_of
from support.fleets import task_of, tuning_of
from zsched.core.scheduler.fuse import WINDOW_S, Fuse
from zsched.core.scheduler.judge import Judge, Outcome
from zsched.core.scheduler.standing import Standing

SPEC = task_of(tuning=tuning_of(cpu=1.0, memory=0.0), price_s=0.0, max_moves_per_minute=2)
OWNED = allocation_of(tuning=SPEC.tuning)


def standing(**aggregates: float) -> Standing:
    return Standing(aggregates=aggregates, vetoed={}, vectors=(), voters_heard=3)


def blown() -> Fuse:
    """After as many moves as there may be in a minute, the last one at 110."""
    fuse = Fuse()
    for at in (100.0, 110.0):
        fuse.note_move(is_escape=False, now=at)
    return fuse


def test_only_moves_of_the_last_minute_are_remembered_also_where_nobody_judges() -> None:
    """An edge learns of moves for weeks, and asks for no count of them."""
    fuse = Fuse()
    for minute in range(1000):
        fuse.note_move(is_escape=False, now=WINDOW_S * minute)
    assert fuse.memory().moves == ((WINDOW_S * 998, False), (WINDOW_S * 999, False))


def test_planned_moves_are_capped_per_minute_and_escapes_are_not_by_that_cap() -> None:
    fuse, judge = blown(), Judge(spec=SPEC)
    joint = standing(edge1=0.2, edge2=0.9)
    capped = judge.judge(joint, OWNED, escape=None, is_called=True, now=120.0, fuse=fuse)
    assert capped.outcome is Outcome.WAIT
    assert "2 moves in the last minute, at most 2" in capped.reason
    fled = judge.judge(joint, OWNED, escape="edge1 is gone", is_called=False, now=120.0, fuse=fuse)
    assert fled.outcome is Outcome.PROPOSE
    free = judge.judge(joint, OWNED, escape=None, is_called=False, now=175.0, fuse=fuse)
    assert free.outcome is Outcome.PROPOSE


def test_the_cap_is_no_matter_where_nobody_wants_to_move() -> None:
    fuse, judge = blown(), Judge(spec=SPEC)
    joint = standing(edge1=0.9, edge2=0.2)
    stays = judge.judge(joint, OWNED, escape=None, is_called=True, now=120.0, fuse=fuse)
    assert (stays.outcome, "last minute" in stays.reason) == (Outcome.STAY, False)


def test_moves_are_counted_by_kind_within_the_asked_time_its_end_included() -> None:
    fuse = Fuse()
    for at, has_failed in ((100.0, False), (110.0, True), (120.0, False), (130.0, False)):
        fuse.note_move(is_escape=has_failed, now=at)
    assert fuse.moves_within(20.0, 140.0, escapes=False) == 2
    assert fuse.moves_within(19.9, 140.0, escapes=False) == 1
    assert fuse.moves_within(30.0, 140.0, escapes=True) == 1
    assert fuse.moves_within(29.9, 140.0, escapes=True) == 0
    assert fuse.moves_within(WINDOW_S, 160.0, escapes=False) == 3
    assert fuse.moves_within(WINDOW_S, 160.1, escapes=False) == 2
