from __future__ import annotations

import doctest
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from support.equations import total_utility
from zsched.core.scheduler import standing, utility
from zsched.core.scheduler.standing import rounded
from zsched.core.scheduler.utility import (
    LEAST_NEED_RATIO,
    cpu_utility,
    memory_utility,
    network_utility,
    predicted_use,
    service_utility,
)
from zsched.core.values import endpoint
from zsched.core.values.fleet import DEFAULT_BONUS
from zsched.core.values.model import ScoreForm, Weights

SEEDED = settings(derandomize=True, database=None, deadline=None)
RATIO = st.floats(0.0, 1.0)
CORES = st.floats(0.0, 4096.0)
ALL = frozenset({"cpu", "memory", "network"})


@st.composite
def weights(draw: st.DrawFn) -> Weights:
    low, high = sorted((draw(RATIO), draw(RATIO)))
    return Weights(cpu=low, memory=high - low, network=1.0 - high)


@pytest.mark.parametrize("module", [utility, standing, endpoint])
def test_the_worked_examples_in_the_docstrings_hold(module: object) -> None:
    result = doctest.testmod(module)  # type: ignore[arg-type]  # parametrisation loses the module's type

    assert result.attempted > 0
    assert result.failed == 0


@SEEDED
@given(CORES, CORES, CORES)
def test_predicted_use_forgets_the_task_s_own_load(rest: float, own: float, demand: float) -> None:
    """The same rest and demand give the same prediction, whatever the worker uses there now."""
    predicted = predicted_use(rest + own, own, demand)

    assert predicted == pytest.approx(predicted_use(rest, 0.0, demand), abs=1e-6)


def test_a_worker_that_shows_more_than_the_machine_leaves_nothing_negative() -> None:
    assert predicted_use(use=0.3, own_worker=0.5, demand=0.4) == 0.4


@SEEDED
@given(weights(), RATIO, RATIO)
def test_a_metric_that_nobody_measured_is_neither_zero_nor_one(omega: Weights, cpu: float, memory: float) -> None:
    """Dropped and the rest renormalised: the result lies between the terms that are there."""
    value = total_utility(omega, cpu=cpu, memory=memory, network=None, measured=frozenset({"cpu", "memory"}))

    if omega.cpu + omega.memory == 0.0:
        assert value is None
        return
    assert value is not None
    assert min(cpu, memory) - 1e-9 <= value <= max(cpu, memory) + 1e-9


def test_missing_here_but_measured_elsewhere_is_not_scored() -> None:
    omega = Weights(cpu=0.5, memory=0.0, network=0.5)

    assert total_utility(omega, cpu=0.8, memory=0.5, network=None, measured=ALL) is None
    assert total_utility(omega, cpu=None, memory=0.5, network=0.8, measured=ALL) is None


def test_nothing_weighted_is_measured_so_there_is_no_score() -> None:
    omega = Weights(cpu=0.0, memory=0.0, network=1.0)

    assert total_utility(omega, cpu=0.8, memory=0.8, network=None, measured=frozenset({"cpu", "memory"})) is None


def test_results_are_plain_finite_numbers_at_the_edges() -> None:
    for value in (
        cpu_utility(0.001, 4096.0),
        memory_utility(1.0, 1e8, 1e8),
        network_utility(-120.0, -80.0, -79.9),
        network_utility(0.0, -80.0, -79.9),
    ):
        assert math.isfinite(value)
        assert 0.0 <= value <= 1.0


# --- the share of its work that a task would get done -----------------------------------------------------------------


@SEEDED
@given(st.floats(0.1, 4096.0), CORES, CORES, CORES)
def test_room_is_worth_more_the_more_there_is_and_less_the_more_is_needed(
    capacity: float, free: float, more: float, demand: float
) -> None:
    value = service_utility(free, demand, capacity)

    assert 0.0 <= value <= 1.0
    assert service_utility(free + more, demand, capacity) >= value - 1e-12
    assert service_utility(free, demand + more, capacity) <= value + 1e-12


def test_below_the_need_a_term_falls_as_the_work_that_is_done_and_above_it_next_to_nothing_counts() -> None:
    whole = service_utility(2.0, 2.0, 4.0)
    assert service_utility(1.0, 2.0, 4.0) == pytest.approx(whole / 2, rel=0.02)
    assert whole < service_utility(4.0, 2.0, 4.0) < whole + DEFAULT_BONUS
    assert service_utility(4.0, 0.2, 4.0) <= service_utility(0.2, 0.2, 4.0) + DEFAULT_BONUS, "idle beside just enough"


@SEEDED
@given(st.floats(0.1, 64.0), st.floats(64.0, 1e6), st.data())
def test_a_task_that_lacks_nothing_is_not_moved_for_more_room(cores: float, memory: float, data: st.DataObject) -> None:
    """The largest lead that free CPU and memory together can give stays below the bonus, and rounds below it."""
    need_cores, need_mb = data.draw(st.floats(0.0, cores)), data.draw(st.floats(0.0, memory))
    least_cores, least_mb = max(need_cores, LEAST_NEED_RATIO * cores), max(need_mb, LEAST_NEED_RATIO * memory)

    def worth(free_cores: float, free_mb: float) -> float:
        cpu = service_utility(free_cores, need_cores, cores)
        room = service_utility(free_mb, need_mb, memory)
        shares = Weights(cpu=0.5, memory=0.5, network=0.0)
        return total_utility(shares, cpu=cpu, memory=room, network=None, measured=ALL, form=SERVICE) or 0.0

    assert rounded(worth(cores, memory)) < rounded(worth(least_cores, least_mb) + DEFAULT_BONUS)


def test_a_tenth_of_a_machine_places_tasks_apart_however_much_room_there_is() -> None:
    """Else three small tasks that come together all go to the first machine by name."""
    without, beside = (service_utility(free, 0.4, 4.0) for free in (3.6, 3.2))
    assert rounded(without) > rounded(beside)


def test_a_starved_machine_is_worth_less_than_an_idle_one_though_neither_has_what_the_task_needs() -> None:
    """Where Eq. 1 says 0 of both: 4 cores, a task that needs 5."""
    assert cpu_utility(4.0, 5.0) == cpu_utility(4.0, 8.6) == 0.0
    assert service_utility(4.0, 5.0, 4.0) > 8 * service_utility(0.4, 5.0, 4.0) > 0.0


def test_a_task_that_needs_next_to_nothing_still_prefers_the_machine_with_more_room() -> None:
    assert service_utility(3.0, 0.0, 4.0) > service_utility(1.0, 0.0, 4.0)
    assert service_utility(-1.0, 0.0, 4.0) == service_utility(0.0, 1.0, 4.0) == 0.0


SERVICE = ScoreForm.SERVICE


def test_in_the_product_the_heaviest_metric_counts_as_it_is_and_the_others_by_their_weight_beside_it() -> None:
    shares = Weights(cpu=0.5, memory=0.25, network=0.25)
    full = total_utility(shares, cpu=0.8, memory=0.4, network=0.6, measured=ALL, form=SERVICE)
    cpu = total_utility(shares, cpu=0.8 * 0.99, memory=0.4, network=0.6, measured=ALL, form=SERVICE)
    memory = total_utility(shares, cpu=0.8, memory=0.4 * 0.99, network=0.6, measured=ALL, form=SERVICE)
    assert full is not None
    assert full == pytest.approx(0.8 * 0.4**0.5 * 0.6**0.5)
    assert cpu == pytest.approx(full * 0.99)
    assert memory == pytest.approx(full * 0.99**0.5)


def test_spare_memory_hides_a_starved_cpu_in_a_sum_and_not_in_a_product() -> None:
    def worth(cpu: float, memory: float, form: ScoreForm) -> float:
        half = Weights(cpu=0.5, memory=0.5, network=0.0)
        return total_utility(half, cpu=cpu, memory=memory, network=None, measured=ALL, form=form) or 0.0

    assert worth(0.02, 0.9, ScoreForm.PAPER) > worth(0.4, 0.4, ScoreForm.PAPER)
    assert worth(0.02, 0.9, SERVICE) < worth(0.4, 0.4, SERVICE) / 2


@SEEDED
@given(RATIO, RATIO)
def test_what_nobody_measures_or_nobody_weighs_does_not_count_in_the_product(term: float, memory: float) -> None:
    shares = Weights(cpu=0.25, memory=0.25, network=0.5)
    two = total_utility(shares, cpu=term, memory=memory, network=None, measured=ALL - {"network"}, form=SERVICE)
    assert two == pytest.approx(term * memory)
    alone = Weights(cpu=1.0, memory=0.0, network=0.0)
    assert total_utility(alone, cpu=term, memory=memory, network=0.1, measured=ALL, form=SERVICE) == pytest.approx(term)
    assert total_utility(shares, cpu=None, memory=memory, network=0.1, measured=ALL, form=SERVICE) is None
