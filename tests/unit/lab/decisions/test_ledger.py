"""A ledger of lost service, which the study plays beside zsched's own rule."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zsched_lab.decisions import ablation
from zsched_lab.decisions.ledger import Ledger

NAMES = ("a", "b", "c")
STEP_S = 0.2


def moves(ledger: Ledger, history: list[dict[str, float]]) -> tuple[float, int]:
    """(losses, moves) of a task that goes by the ledger from ``a`` on."""
    owner, lost, moved = "a", 0.0, 0
    for number, losses in enumerate(history):
        ledger.charge(losses, number * STEP_S)
        expected = ledger.expected(losses)
        least = min(expected, key=lambda name: (expected[name], name != owner, name))
        if expected[owner] - expected[least] >= ledger.price_s:
            owner, moved = least, moved + 1
        lost += losses[owner] * STEP_S
    return lost, moved


def best(history: list[dict[str, float]], price_s: float) -> float:
    """What who knows the history beforehand pays, from ``a`` on."""
    paid = {name: 0.0 if name == "a" else price_s for name in NAMES}
    for losses in history:
        paid = {name: min(paid[name], min(paid.values()) + price_s) + losses[name] * STEP_S for name in NAMES}
    return min(paid.values())


@given(st.lists(st.fixed_dictionaries({name: st.floats(0.0, 1.0) for name in NAMES}), min_size=1, max_size=120))
def test_losses_and_moves_together_are_bounded_by_what_is_known_only_afterwards(
    history: list[dict[str, float]],
) -> None:
    ledger = Ledger(price_s=0.3, memory_s=1e12, ahead_s=0.0)
    lost, moved = moves(ledger, history)
    bound = 2 * len(NAMES) * best(history, 0.3) + 4 * len(NAMES) * 0.3
    assert lost + 0.3 * moved <= bound + 1e-9


def test_a_large_lead_is_followed_at_once_and_a_small_one_once_staying_has_cost_a_move() -> None:
    def left_after(lead: float) -> int:
        ledger = Ledger()
        for number in range(100):
            losses = {"a": lead, "b": 0.0}
            ledger.charge(losses, number * STEP_S)
            expected = ledger.expected(losses)
            if expected["a"] - expected["b"] >= ledger.price_s:
                return number
        return 100

    assert [left_after(lead) for lead in (0.5, 0.1, 0.05, 0.0)] == [0, 0, 16, 100]


def test_a_machine_that_was_bad_for_hours_owes_no_more_than_the_price_of_a_move() -> None:
    ledger = Ledger()
    for number in range(5000):
        ledger.charge({"a": 0.0, "b": 1.0}, float(number))
    assert ledger.owed == pytest.approx({"a": 0.0, "b": ledger.price_s})
    for number in range(5000, 5400):
        ledger.charge({"a": 0.0, "b": 0.0}, float(number))
    assert ledger.owed["b"] == pytest.approx(ledger.price_s / 4, rel=0.02), "half of it is forgotten in 200 s"


def test_nothing_is_charged_for_a_time_in_which_nobody_looked() -> None:
    ledger = Ledger(price_s=100.0)
    for at in (0.0, 1000.0):
        ledger.charge({"a": 1.0, "b": 0.0}, at)
    assert ledger.owed["a"] == pytest.approx(2.0)


def test_each_switch_of_an_ablation_is_of_something_that_there_is() -> None:
    for name, switches in ablation.SWITCHES.items():
        for place, attribute, value in switches:
            assert getattr(place, attribute) != value, name
    assert all(first < second for first, second in pairwise(sorted(ablation.SWITCHES)))
