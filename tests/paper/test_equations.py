"""The paper's equations 1 to 6 and their constraints, by the readings of docs/decisions/0001.

One test per equation and per reading. Each docstring says in short which sentence it proves.
"""

from __future__ import annotations

import pytest

from support.allocations import allocation_of
from support.equations import total_utility
from support.fleets import task_of, tuning_of
from support.proposals import vector_of
from zsched.core.scheduler.standing import Standing, compare, pick
from zsched.core.scheduler.utility import cpu_utility, memory_utility, network_utility, predicted_use
from zsched.core.values.fleet import LinkLimits
from zsched.core.values.model import Reach, Tuning, Weights

ALL = frozenset({"cpu", "memory", "network"})
LIMITS = LinkLimits()


# --- Eq. 1: eta = (gamma - beta) / gamma ---------------------------------------------------------------------------


def test_eq1_processing_utility_is_the_free_fraction_of_the_cpu() -> None:
    """Eq. 1: eta = (gamma - beta) / gamma, with gamma the maximal computation resource."""
    assert cpu_utility(gamma=100.0, beta=0.0) == 1.0
    assert cpu_utility(gamma=100.0, beta=30.0) == pytest.approx(0.7)
    assert cpu_utility(gamma=4.0, beta=4.0) == 0.0


def test_eq1_beta_is_what_is_in_use_so_the_idler_node_is_preferred() -> None:
    """Eq. 1 reads beta "available"; then eta would be the *used* fraction and the maximum the busiest node."""
    busy_used, idle_used, gamma = 3.5, 0.5, 4.0

    assert cpu_utility(gamma, idle_used) > cpu_utility(gamma, busy_used)
    as_printed = {"busy": cpu_utility(gamma, gamma - busy_used), "idle": cpu_utility(gamma, gamma - idle_used)}
    assert max(as_printed, key=as_printed.__getitem__) == "busy"


def test_eq1_stays_in_zero_to_one_when_more_is_wanted_than_there_is() -> None:
    """Sec. "Problem Formulation": all utilities have been normalised to values between 0 and 1."""
    assert cpu_utility(gamma=4.0, beta=6.0) == 0.0


# --- Eq. 2: theta = (delta - theta_i - mu) / delta -----------------------------------------------------------------


def test_eq2_memory_utility_subtracts_the_task_s_demand_and_what_is_in_use() -> None:
    """Eq. 2: (delta - theta_i - mu) / delta; delta the limit, mu in use (printed "available"), theta_i the demand."""
    assert memory_utility(delta=4096.0, theta=0.0, mu=0.0) == 1.0
    assert memory_utility(delta=4096.0, theta=1024.0, mu=2048.0) == pytest.approx(0.25)
    assert memory_utility(delta=4096.0, theta=1024.0, mu=3072.0) == 0.0
    assert memory_utility(delta=4096.0, theta=2048.0, mu=3072.0) == 0.0


def test_eq1_and_eq2_predict_by_one_formula_for_every_candidate() -> None:
    """Reading of theta_i: the owner's figures already hold the task, the others' do not; both are judged with it."""
    rest, task = 1.0, 0.8
    owner = predicted_use(use=rest + task, own_worker=task, demand=task)
    other = predicted_use(use=rest, own_worker=0.0, demand=task)
    standby = predicted_use(use=rest + 0.1, own_worker=0.1, demand=task)

    assert owner == pytest.approx(other)
    assert standby == pytest.approx(other)


# --- Eq. 3: kappa = (lambda - nu) / (rho - nu) ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("signal", "kappa"), [(-80.0, 0.0), (-70.0, 0.25), (-60.0, 0.5), (-40.0, 1.0), (-30.0, 1.0), (-95.0, 0.0)]
)
def test_eq3_link_utility_is_the_share_of_the_achievable_signal(signal: float, kappa: float) -> None:
    """Eq. 3: from nu, the minimum required for offloading, to rho, the maximum achievable; cut to [0, 1]."""
    assert network_utility(signal, LIMITS.nu_dbm, LIMITS.rho_dbm) == pytest.approx(kappa)


# --- Eq. 4: U = omega_eta eta + omega_sigma sigma + omega_kappa kappa ----------------------------------------------


def test_eq4_total_utility_is_the_weighted_sum() -> None:
    """Eq. 4: the sum of eta, sigma and kappa, weighted by omega (sigma is Eq. 2's theta)."""
    value = total_utility(Weights(cpu=0.5, memory=0.3, network=0.2), cpu=0.8, memory=0.5, network=0.25, measured=ALL)

    assert value == pytest.approx(0.5 * 0.8 + 0.3 * 0.5 + 0.2 * 0.25)


@pytest.mark.parametrize(
    ("weights", "value"),
    [
        (Weights(cpu=1.0, memory=0.0, network=0.0), 0.9),
        (Weights(cpu=0.0, memory=1.0, network=0.0), 0.3),
        (Weights(cpu=0.0, memory=0.0, network=1.0), 0.6),
        (Weights(cpu=0.5, memory=0.5, network=0.0), 0.6),
    ],
)
def test_eq4_different_weights_or_one_for_the_whole_computing_model(weights: Weights, value: float) -> None:
    """The paper's variants: by CPU, by memory, by network (the real robots), and both computing terms alike."""
    assert total_utility(weights, cpu=0.9, memory=0.3, network=0.6, measured=ALL) == pytest.approx(value)


def test_eq4_an_absent_metric_is_dropped_for_all_and_the_weights_renormalised() -> None:
    """Reading: what nobody measured is absent, never 0 and never 1 (the paper skips the network in simulation)."""
    thirds = Weights(cpu=1 / 3, memory=1 / 3, network=1 / 3)
    value = total_utility(thirds, cpu=0.9, memory=0.3, network=None, measured=frozenset({"cpu", "memory"}))

    assert value == pytest.approx(0.6)


def test_eq4_a_metric_absent_for_one_candidate_only_is_not_guessed() -> None:
    """Reading: missing for some candidates, those are not scored."""
    thirds = Weights(cpu=1 / 3, memory=1 / 3, network=1 / 3)

    assert total_utility(thirds, cpu=0.9, memory=0.3, network=None, measured=ALL) is None


# --- Eq. 5-6: the scheduling problem -------------------------------------------------------------------------------

SPEC = task_of(candidates=("edge1", "edge2", "edge3"), tuning=tuning_of(cpu=1.0, memory=0.0))


def joint(rows: dict[str, dict[str, float]]) -> Standing:
    """The standing of {robot: {candidate: utility}}; a negative utility stands for unreachable."""
    allocation = allocation_of(tuning=Tuning(weights=SPEC.tuning.weights))
    vectors = {robot: vector_of(robot, row, 1) for robot, row in rows.items()}
    return compare(SPEC, allocation, vectors)


MATRIX = {
    "robot1": {"edge1": 0.9, "edge2": 0.5, "edge3": 0.1},
    "robot2": {"edge1": 0.1, "edge2": 0.6, "edge3": 0.2},
    "robot3": {"edge1": 0.2, "edge2": 0.4, "edge3": 0.3},
}


def test_eq5_and_eq6_the_candidate_with_the_largest_sum_over_the_robots() -> None:
    """Eq. 5-6 sum over the candidates, which leaves no choice; the text sums per resource and takes the largest."""
    sums = {name: sum(row[name] for row in MATRIX.values()) for name in SPEC.candidates}
    standing = joint(MATRIX)

    assert pick(standing.aggregates, None) == max(sums, key=sums.__getitem__) == "edge2"
    for name, total in sums.items():
        assert standing.aggregates[name] == pytest.approx(total / 3), "the mean ranks as the sum when all answer"


def test_eq5_a_silent_robot_does_not_shift_the_columns() -> None:
    """Reading: the mean over fresh voters; a plain sum would count an unheard robot as zero for everybody."""
    two = joint({name: MATRIX[name] for name in ("robot2", "robot3")})

    assert two.voters_heard == 2
    assert two.aggregates["edge2"] == pytest.approx(0.5)


def test_eq3_below_nu_counts_zero_in_the_column_and_is_not_left_out() -> None:
    """Reading of "the minimum RSSI required for offloading": 0 for that robot; leaving it out would raise the mean."""
    rows = {**MATRIX, "robot3": {"edge1": 0.2, "edge2": -1.0, "edge3": 0.3}}

    assert joint(rows).aggregates["edge2"] == pytest.approx((0.5 + 0.6 + 0.0) / 3)


def test_eq3_a_candidate_that_no_majority_reaches_cannot_be_offloaded_to() -> None:
    """Reading: the task needs all robots' contributions; without a majority that reaches it a node is vetoed."""
    rows = {
        "robot1": {"edge1": -1.0, "edge2": 0.1},
        "robot2": {"edge1": -1.0, "edge2": 0.1},
        "robot3": {"edge1": 1.0, "edge2": 0.1},
    }

    assert pick(joint(rows).aggregates, None) == "edge2"
    assert str(joint(rows).vetoed["edge1"]) == "reached by 1 of 3 robots"
    assert SPEC.reach is Reach.MAJORITY


def test_constraint_weights_lie_in_zero_to_one() -> None:
    """Constraint of Eq. 6: omega in [0...1]."""
    for bad in ({"cpu": 1.2, "memory": -0.2, "network": 0.0}, {"cpu": -0.1, "memory": 0.6, "network": 0.5}):
        with pytest.raises(ValueError, match="weights"):
            Weights(**bad, gauges=())


def test_constraint_weights_sum_to_one() -> None:
    """Constraint of Eq. 6: omega_eta + omega_sigma + omega_kappa = 1."""
    with pytest.raises(ValueError, match=r"the sum is 0\.9"):
        Weights(cpu=0.3, memory=0.3, network=0.3)
