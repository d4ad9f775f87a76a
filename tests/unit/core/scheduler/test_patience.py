"""The learnt patience: what each choice would have paid, by hand; noise makes patient, loads make quick."""

from __future__ import annotations

import math
from collections.abc import Callable
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from zsched.core.scheduler.patience import (
    CHOICES,
    FIRST_PATIENCE,
    FORGIVEN_IN_S,
    LONGEST_GAP_S,
    MEMORY_S,
    MOVE_PRICE_S,
    SEEN_LATE_S,
    LearntPatience,
    spend,
)

BONUS, COOL_DOWN_S, EVERY_S = 0.05, 2.0, 0.5
Seen = Callable[[float], dict[str, float]]


def watched(seen: Seen, until_s: float, learnt: LearntPatience | None = None, since_s: float = 0.0) -> LearntPatience:
    learnt = learnt or LearntPatience()
    for look in range(round((until_s - since_s) / EVERY_S)):
        at_s = since_s + look * EVERY_S
        learnt.watch(seen(at_s), BONUS, COOL_DOWN_S, at_s)
    return learnt


def paid(learnt: LearntPatience) -> list[float]:
    return [player.paid for player in learnt._players]


def loads(lead: float, length_s: float, pause_s: float) -> Seen:
    """Both machines in turns, neither for longer than the other."""

    def seen(at_s: float) -> dict[str, float]:
        turn, since_s = divmod(at_s, length_s + pause_s)
        is_on = since_s >= pause_s
        return {"edge1": 1.0 - lead * (is_on and turn % 2 == 0), "edge2": 1.0 - lead * (is_on and turn % 2 == 1)}

    return seen


def noise(width: float, seed: int = 1) -> Seen:
    rng = Random(seed)
    return lambda _: {name: 0.7 + rng.uniform(-width, width) for name in ("edge1", "edge2")}


def test_it_begins_with_the_first_patience() -> None:
    assert FIRST_PATIENCE in CHOICES
    assert LearntPatience().value == FIRST_PATIENCE


def test_where_nothing_happens_it_stays_with_it() -> None:
    assert watched(lambda _: {"edge1": 0.9, "edge2": 0.9}, 600.0).value == FIRST_PATIENCE


def test_the_price_of_one_move_by_hand() -> None:
    """A lead of 0.45 from the second look on: CHOICES 0.05 and 0.15 are used up by the first look that sees it."""
    learnt = LearntPatience()
    for look, lead in enumerate((0.0, 0.45)):
        learnt.watch({"edge1": 1.0 - lead, "edge2": 1.0}, BONUS, COOL_DOWN_S, look * EVERY_S)
    quick = 0.45 * EVERY_S + MOVE_PRICE_S + SEEN_LATE_S * 0.45
    stays = 0.45 * EVERY_S
    assert paid(learnt) == pytest.approx([quick, quick, stays, stays])
    learnt.watch({"edge1": 0.55, "edge2": 1.0}, BONUS, COOL_DOWN_S, 2 * EVERY_S)
    fade = math.exp(-EVERY_S / MEMORY_S)
    assert paid(learnt)[0] == pytest.approx(quick * fade), "who has moved pays no more"
    assert paid(learnt)[3] == pytest.approx(stays * fade + stays)


def test_a_load_that_begins_changes_nothing_before_every_choice_has_settled_with_it() -> None:
    """Whoever has just moved has paid for it, and the others have not: that is no sign that they are right."""
    learnt, told = LearntPatience(), []
    for look in range(60):
        lead = 0.45 if look >= 20 else 0.0
        learnt.watch({"edge1": 1.0 - lead, "edge2": 1.0}, BONUS, COOL_DOWN_S, look * EVERY_S)
        told.append((learnt.value, len({player.owner for player in learnt._players})))
    assert {owners for _, owners in told} == {1, 2}, "the quick ones have moved before the patient ones"
    assert {value for value, _ in told} == {FIRST_PATIENCE}


def test_a_load_that_was_over_before_it_paid_to_move_makes_it_patient_when_it_is_over() -> None:
    learnt, seen = LearntPatience(), lambda at_s: {"edge1": 0.55 if 10.0 <= at_s < 11.0 else 1.0, "edge2": 1.0}
    watched(seen, 11.0, learnt)
    assert learnt.value == FIRST_PATIENCE
    watched(seen, 12.0, learnt, 11.0)
    assert learnt.value == 0.5, "it has paid as little as the most patient one, and is nearer to the first"


def test_what_is_recalled_goes_on_from_the_patience_in_force() -> None:
    """A memory of before it was kept has none: then the accounts tell."""
    learnt = watched(lambda at_s: {"edge1": 0.55 if at_s >= 10.0 else 1.0, "edge2": 1.0}, 11.0)
    players, at = learnt.memory()
    for kept, value in ((FIRST_PATIENCE, FIRST_PATIENCE), (None, 0.5)):
        again = LearntPatience()
        again.recall(players, at, kept)
        assert again.value == value


def test_long_loads_make_it_quick() -> None:
    assert watched(loads(0.2, 30.0, 15.0), 300.0).value == min(CHOICES)


def test_loads_that_are_over_before_a_move_pays_make_it_patient() -> None:
    assert watched(loads(0.5, 1.0, 15.0), 300.0).value >= 0.5


@pytest.mark.parametrize("seed", range(4))
def test_noise_makes_it_patient(seed: int) -> None:
    assert watched(noise(0.25, seed), 300.0).value >= 0.5


def test_what_was_is_forgotten() -> None:
    learnt = watched(noise(0.25), 300.0)
    assert learnt.value >= 0.5
    assert watched(loads(0.2, 30.0, 15.0), 2400.0, learnt, 300.0).value == min(CHOICES)


def test_a_gap_in_the_looks_is_charged_for_two_seconds_and_an_owner_that_goes_for_nothing() -> None:
    learnt = LearntPatience()
    learnt.watch({"edge1": 1.0, "edge2": 0.2}, BONUS, COOL_DOWN_S, 0.0)
    learnt.watch({"edge1": 0.9, "edge2": 0.94}, BONUS, COOL_DOWN_S, 1000.0)
    assert paid(learnt) == pytest.approx([0.04 * LONGEST_GAP_S] * len(CHOICES)), "a lead below the bonus"
    learnt.watch({"edge2": 0.5}, BONUS, COOL_DOWN_S, 1001.0)
    assert max(paid(learnt)) < 0.04 * LONGEST_GAP_S + 1e-9
    learnt.watch({}, BONUS, COOL_DOWN_S, 1002.0)
    learnt.watch({"edge1": 0.5}, BONUS, COOL_DOWN_S, 1001.0)  # a clock does not go back; nothing is gained if it does
    assert min(paid(learnt)) >= 0.0


def test_virtual_moves_keep_the_cool_down() -> None:
    """A lead that changes sides at every look: one move in two seconds is the most that anybody pays."""
    learnt = watched(lambda at_s: {"edge1": float(round(at_s / EVERY_S) % 2), "edge2": 0.5}, 60.0)
    most = (60.0 / COOL_DOWN_S + 1) * (MOVE_PRICE_S + SEEN_LATE_S * 1.0) + 60.0
    assert max(paid(learnt)) <= most


@settings(derandomize=True, database=None, deadline=None, max_examples=60)
@given(
    st.lists(
        st.tuples(
            st.floats(0.0, 30.0),
            st.dictionaries(st.sampled_from(("edge1", "edge2", "edge3")), st.floats(0.0, 1.0)),
        ),
        max_size=40,
    )
)
def test_whatever_is_seen_it_is_one_of_the_choices_and_every_robot_comes_to_the_same(
    looks: list[tuple[float, dict[str, float]]],
) -> None:
    one, other, at_s = LearntPatience(), LearntPatience(), 0.0
    for gap_s, seen in looks:
        at_s += gap_s
        one.watch(seen, BONUS, COOL_DOWN_S, at_s)
        other.watch(dict(reversed(seen.items())), BONUS, COOL_DOWN_S, at_s)
        assert one.value == other.value
        assert one.value in CHOICES
        assert all(0.0 <= figure < math.inf for figure in paid(one))


@given(st.floats(0.0, 5.0), st.floats(-1.0, 1.0), st.floats(0.01, 5.0), st.floats(0.0, LONGEST_GAP_S))
def test_an_account_is_never_overdrawn_nor_more_than_asked_for(
    spent: float, lead: float, patience: float, elapsed_s: float
) -> None:
    assert 0.0 <= spend(spent, lead, patience, elapsed_s) <= patience
    assert spend(patience, 0.0, patience, FORGIVEN_IN_S) == 0.0
