"""What moves were worth: the true utility, the oracle, regret, wasted moves, time on a bad node."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from zsched_lab.decisions import loads
from zsched_lab.decisions.rules import Move
from zsched_lab.decisions.score import MOVE_COST_S, figures, oracle, truth_of, wasted_moves
from zsched_lab.decisions.view import START_S, Feed, Look, View
from zsched_lab.decisions.world import DT_S, World, bad, loaded_world, true_utility


def still(*, with_radio: bool) -> World:
    """A history whose readings are the truth, and which does not change."""
    world = loaded_world(seed=3, hours=0.02, plan=loads.LONG, with_radio=with_radio)
    cpu, memory = (np.repeat(values[:1], world.steps, axis=0) for values in (world.cpu, world.memory))
    signal = None if world.signal is None else np.repeat(world.signal[:1], world.steps, axis=0)
    return replace(world, cpu=cpu, memory=memory, cpu_read=cpu, memory_read=memory, signal=signal, signal_read=signal)


@pytest.mark.parametrize("with_radio", [False, True])
def test_the_true_utility_is_what_the_robots_compute_from_perfect_readings(*, with_radio: bool) -> None:
    world = still(with_radio=with_radio)
    feed = Feed(world, Look())
    view = View(world, feed)
    for step in range(50):
        feed.step(step)
    standing = view.standing(START_S + 50 * DT_S)
    truth = true_utility(world)[50]
    for column, name in enumerate(world.candidates):
        assert standing.aggregates.get(name, 0.0) == pytest.approx(truth[column], abs=1e-6)


def best_by_trial(utility: list[list[float]], cost: float) -> float:
    best = -np.inf
    for owners in itertools.product(range(len(utility[0])), repeat=len(utility)):
        moves = sum(one != other for one, other in itertools.pairwise(owners))
        best = max(best, sum(row[owner] for row, owner in zip(utility, owners, strict=True)) * DT_S - cost * moves)
    return best


@pytest.mark.parametrize("seed", range(5))
def test_the_oracle_is_the_best_of_all_sequences(seed: int) -> None:
    utility = np.random.default_rng(seed).random((7, 3))
    total, moves, owners = oracle(utility, 0.05)
    assert total == pytest.approx(best_by_trial(utility.tolist(), 0.05))
    assert moves == sum(one != other for one, other in itertools.pairwise(owners))
    earned = sum(utility[step, owner] for step, owner in enumerate(owners)) * DT_S - 0.05 * moves
    assert earned == pytest.approx(total)


def move(at_s: float, owner: str, left: str | None) -> Move:
    return Move(at_s=at_s, owner=owner, left=left)


def test_a_move_back_within_thirty_seconds_is_wasted_and_a_later_one_is_not() -> None:
    to_b, back = move(10.0, "b", "a"), move(39.0, "a", "b")
    assert wasted_moves([to_b, back]) == 1
    assert wasted_moves([to_b, replace(back, at_s=41.0)]) == 0
    assert wasted_moves([to_b, move(39.0, "c", "b")]) == 0


def test_whoever_does_what_the_oracle_does_has_no_regret_and_every_move_costs() -> None:
    world = loaded_world(seed=2, hours=0.3, plan=loads.LONG)
    truth = truth_of(world, skip_s=0.0)
    names = world.candidates
    owners = truth.oracle_owners.tolist()
    moves = [move(0.0, names[owners[0]], None)]
    for step, (before, after) in enumerate(itertools.pairwise(owners), 1):
        if before != after:
            moves.append(move(step * DT_S, names[after], names[before]))
    assert figures(world, truth, moves).regret == pytest.approx(0.0, abs=1e-9)
    assert len(moves) - 1 == truth.oracle_moves >= 1

    away = names[(owners[-1] + 1) % 3]
    end_s = world.steps * DT_S - DT_S
    extra = figures(world, truth, [*moves, move(end_s, away, names[owners[-1]])])
    assert extra.regret * truth.oracle >= truth.move_cost * 0.9
    assert truth.move_cost == pytest.approx(MOVE_COST_S * truth.utility.max(axis=1).mean())


def test_time_on_a_bad_node_counts_only_while_a_good_one_is_there() -> None:
    world = still(with_radio=False)
    full = replace(world, cpu=np.ones_like(world.cpu))
    assert bad(full).all()
    assert figures(full, truth_of(full, skip_s=0.0), [move(0.0, world.candidates[0], None)]).bad == 0.0
    one = world.cpu.copy()
    one[:, 0] = 1.0
    first = replace(world, cpu=one)
    assert figures(first, truth_of(first, skip_s=0.0), [move(0.0, world.candidates[0], None)]).bad == 1.0
