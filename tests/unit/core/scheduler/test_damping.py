"""Restraint under faults: penalties that grow and decay, probation, caps."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from support.allocations import allocation_of
from support.fleets import task_of, tuning_of
from zsched.core.scheduler.damping import EARLY_FAILURE_S, MAX_PENALTY, STEP, WINDOW_S, Damping
from zsched.core.scheduler.judge import Judge, Outcome
from zsched.core.scheduler.standing import Standing

SPEC = task_of(tuning=tuning_of(cpu=1.0, memory=0.0), price_s=0.0, max_moves_per_minute=2)
OWNED = allocation_of(tuning=SPEC.tuning)


def standing(**aggregates: float) -> Standing:
    return Standing(aggregates=aggregates, vetoed={}, vectors=(), voters_heard=3)


def test_first_placement_is_no_move() -> None:
    damping = Damping()
    damping.note_move(None, has_failed=False, now=10.0)
    assert damping.penalties(10.0) == {}
    assert damping.moves_within(WINDOW_S, 10.0, escapes=False) == 0


def test_only_moves_of_the_last_minute_are_remembered_also_where_nobody_judges() -> None:
    """An edge learns of moves for weeks, and asks for no count of them."""
    damping = Damping()
    for minute in range(1000):
        damping.note_move("edge1", has_failed=False, now=WINDOW_S * minute)
    assert damping.memory().moves == ((WINDOW_S * 998, False), (WINDOW_S * 999, False))


def test_penalty_grows_with_every_failure_and_is_bounded() -> None:
    damping, seen = Damping(), []
    for number in range(6):
        damping.note_move("edge1", has_failed=True, now=100.0 + number)
        seen.append(damping.penalty("edge1", 100.0 + number))
    assert seen == sorted(seen)
    assert seen[1] > 2 * seen[0]
    assert seen[-1] == MAX_PENALTY


def test_penalty_halves_its_points_with_the_half_life_and_is_forgotten() -> None:
    damping = Damping()
    damping.note_move(None, has_failed=False, now=0.0)
    damping.note_move("edge1", has_failed=True, now=1000.0)
    assert damping.points("edge1", 1000.0) == 2.0
    assert damping.points("edge1", 1060.0) == pytest.approx(1.0)
    assert damping.penalty("edge1", 1060.0) == pytest.approx(STEP)
    assert damping.penalties(1000.0 + 600.0) == {}


def test_to_fail_on_probation_costs_more_than_later() -> None:
    early, late = Damping(), Damping()
    for damping, stay in ((early, EARLY_FAILURE_S / 2), (late, EARLY_FAILURE_S * 2)):
        damping.note_move(None, has_failed=False, now=0.0)
        damping.note_move("edge1", has_failed=True, now=stay)
    assert early.points("edge1", EARLY_FAILURE_S / 2) == 3.0
    assert late.points("edge1", EARLY_FAILURE_S * 2) == 2.0


def test_a_node_that_is_left_for_a_better_one_pays_nothing_however_soon_it_is_left_again() -> None:
    """To follow a load is what moves are for; that they do not get too many is the cap's affair."""
    damping = Damping()
    for number, left in enumerate(("edge1", "edge2", "edge1", "edge2")):
        damping.note_move(left, has_failed=False, now=100.0 + number)
        assert damping.penalties(100.0 + number) == {}
    assert damping.moves_within(WINDOW_S, 104.0, escapes=False) == 4


@pytest.mark.parametrize("has_failed", [False, True])
def test_a_node_that_was_told_to_stop_pays_nothing(has_failed: bool) -> None:
    """However soon it is left, and though it may be gone by the time that the others learn of its task's new owner."""
    damping = Damping()
    damping.note_move(None, has_failed=False, now=0.0)
    damping.note_move("edge1", has_failed=has_failed, was_draining=True, now=10.0)
    assert damping.penalties(10.0) == {}
    assert damping.moves_within(WINDOW_S, 10.0, escapes=has_failed) == 1, "a move all the same"


def test_a_node_that_failed_is_not_chosen_again_at_once() -> None:
    """Slightly better, but it has just been fled from: the other one keeps the task until the points have decayed."""
    damping, judge = Damping(), Judge(spec=SPEC)
    damping.note_move("edge2", has_failed=True, now=100.0)
    joint = standing(edge1=0.5, edge2=0.65)
    now = judge.judge(joint, OWNED, escape=None, is_called=False, now=101.0, damping=damping)
    assert now.outcome is Outcome.STAY
    judge.judge(joint, OWNED, escape=None, is_called=False, now=900.0, damping=damping)
    later = judge.judge(joint, OWNED, escape=None, is_called=False, now=901.0, damping=damping)
    assert (later.outcome, later.candidate) == (Outcome.PROPOSE, "edge2")


def test_a_penalised_node_serves_when_it_is_the_only_one() -> None:
    damping = Damping()
    for number in range(5):
        damping.note_move("edge2", has_failed=True, now=100.0 + number)
    judgement = Judge(spec=SPEC).judge(
        standing(edge2=0.1), OWNED, escape="edge1 is gone", is_called=False, now=106.0, damping=damping
    )
    assert (judgement.outcome, judgement.candidate) == (Outcome.PROPOSE, "edge2")


def test_planned_moves_are_capped_per_minute_and_escapes_are_not_by_that_cap() -> None:
    damping, judge = Damping(), Judge(spec=SPEC)
    for at in (100.0, 110.0):
        damping.note_move("edge3", has_failed=False, now=at)
    joint = standing(edge1=0.2, edge2=0.9)
    capped = judge.judge(joint, OWNED, escape=None, is_called=True, now=120.0, damping=damping)
    assert capped.outcome is Outcome.WAIT
    assert "2 moves in the last minute, at most 2" in capped.reason
    fled = judge.judge(joint, OWNED, escape="edge1 is gone", is_called=False, now=120.0, damping=damping)
    assert fled.outcome is Outcome.PROPOSE
    free = judge.judge(joint, OWNED, escape=None, is_called=False, now=175.0, damping=damping)
    assert free.outcome is Outcome.PROPOSE


def test_the_cap_is_no_matter_where_nobody_wants_to_move() -> None:
    damping, judge = Damping(), Judge(spec=SPEC)
    for at in (100.0, 110.0):
        damping.note_move("edge3", has_failed=False, now=at)
    joint = standing(edge1=0.9, edge2=0.2)
    stays = judge.judge(joint, OWNED, escape=None, is_called=True, now=120.0, damping=damping)
    assert (stays.outcome, "last minute" in stays.reason) == (Outcome.STAY, False)


def test_what_any_robot_remembers_counts_and_nothing_counts_for_a_judge_without_damping() -> None:
    joint = replace(standing(edge1=0.5, edge2=0.6), penalties={"edge2": 0.3})
    given: dict[str, Any] = {"escape": None, "is_called": False, "now": 100.0}
    forgetful = Judge(spec=SPEC).judge(joint, OWNED, **given, damping=Damping())
    assert forgetful.aggregates["edge2"] == pytest.approx(0.3)
    own = Damping()
    own.note_move("edge2", has_failed=True, now=100.0)
    assert Judge(spec=SPEC).judge(joint, OWNED, **given, damping=own).aggregates["edge2"] == pytest.approx(0.3)
    assert Judge(spec=SPEC).judge(joint, OWNED, **given).aggregates["edge2"] == pytest.approx(0.6)


def test_moves_are_counted_by_kind_within_the_asked_time_its_end_included() -> None:
    damping = Damping()
    for at, has_failed in ((100.0, False), (110.0, True), (120.0, False), (130.0, False)):
        damping.note_move("edge1", has_failed=has_failed, now=at)
    assert damping.moves_within(20.0, 140.0, escapes=False) == 2
    assert damping.moves_within(19.9, 140.0, escapes=False) == 1
    assert damping.moves_within(30.0, 140.0, escapes=True) == 1
    assert damping.moves_within(29.9, 140.0, escapes=True) == 0
    assert damping.moves_within(WINDOW_S, 160.0, escapes=False) == 3
    assert damping.moves_within(WINDOW_S, 160.1, escapes=False) == 2
