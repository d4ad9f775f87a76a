"""What a task owes on each machine, and when that moves it."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zsched.core.scheduler.ledger import Ledger, left_after_s

NAMES = ("a", "b", "c")
STEP_S = 0.2
PRICE_S = 0.3


def charged(ledger: Ledger, losses: dict[str, float], at: float, price_s: float = PRICE_S) -> None:
    ledger.charge(losses, "a", price_s=price_s, memory_s=200.0, now=at)


def moves(history: list[dict[str, float]]) -> tuple[float, int]:
    """(losses, moves) of a task that goes by a ledger that forgets nothing and expects nothing, from ``a`` on."""
    ledger, owner, lost, moved = Ledger(), "a", 0.0, 0
    for number, losses in enumerate(history):
        ledger.charge(losses, owner, price_s=PRICE_S, memory_s=1e12, now=number * STEP_S)
        expected = ledger.expected(losses, ahead_s=0.0)
        least = min(expected, key=lambda name: (expected[name], name != owner, name))
        if expected[owner] - expected[least] >= PRICE_S:
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
    lost, moved = moves(history)
    n, opt = len(NAMES), best(history, PRICE_S)
    bound = min((4 * n + 1) * opt + 2 * n * PRICE_S, 2 * n * opt + 4 * n * PRICE_S)
    assert lost + PRICE_S * moved <= bound + 1e-9


def test_a_large_lead_is_followed_at_once_and_a_small_one_once_staying_has_cost_a_move() -> None:
    def left_after(lead: float) -> int:
        ledger = Ledger()
        for number in range(100):
            losses = {"a": lead, "b": 0.0}
            charged(ledger, losses, number * STEP_S)
            expected = ledger.expected(losses)
            if expected["a"] - expected["b"] >= PRICE_S:
                return number
        return 100

    assert [left_after(lead) for lead in (0.5, 0.1, 0.05, 0.0)] == [0, 8, 23, 100]


def test_a_machine_that_was_bad_for_hours_owes_no_more_than_half_the_price_of_a_move() -> None:
    ledger = Ledger()
    for number in range(5000):
        charged(ledger, {"a": 0.0, "b": 1.0}, float(number))
    assert ledger.owed == pytest.approx({"a": 0.0, "b": PRICE_S / 2})
    for number in range(5000, 5400):
        charged(ledger, {"a": 0.0, "b": 0.0}, float(number))
    assert ledger.owed["b"] == pytest.approx(PRICE_S / 8, rel=0.02), "half of it is forgotten in 200 s"


def test_nothing_is_charged_for_a_time_in_which_nobody_looked() -> None:
    ledger = Ledger()
    for at in (0.0, 1000.0):
        charged(ledger, {"a": 1.0, "b": 0.0}, at, price_s=100.0)
    assert ledger.owed["a"] == pytest.approx(2.0)


def test_how_soon_a_step_is_followed_is_told() -> None:
    assert [round(left_after_s(lead, PRICE_S, 0.3), 1) for lead in (0.5, 0.1, 0.05)] == [0.2, 3.3, 7.8]
    assert left_after_s(0.0, PRICE_S, 0.3) == float("inf")


def test_nothing_is_charged_while_the_task_is_nowhere() -> None:
    """A machine that starts a second after the others would owe for that second, and not get the task."""
    ledger = Ledger()
    for tick in range(10):
        ledger.charge({"a": 0.0, "b": 1.0}, None, price_s=PRICE_S, memory_s=200.0, now=tick * STEP_S)
    assert ledger.owed == {"a": 0.0, "b": 0.0}
