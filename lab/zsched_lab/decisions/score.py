"""What a rule's moves were worth: regret against the oracle, wasted moves, time on a bad node.

Knows: the true state, the price of a move. Does not know: how a rule came to its moves.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from zsched_lab.decisions.loads import Array
from zsched_lab.decisions.rules import Move
from zsched_lab.decisions.world import DT_S, World, bad, true_utility

MOVE_COST_S: Final = 1.0
"""A move costs as much as this many seconds without the task. Measured gaps of planned moves are one period of the
worker (1 s for map merging); what is dearer is counted here as well."""
BACK_WITHIN_S: Final = 30.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Truth:
    """What a history's choices are worth: ``utility`` [T, C], ``is_bad`` [T, C], and the oracle's earnings."""

    utility: Array
    is_bad: npt.NDArray[np.bool_]
    move_cost: float
    oracle: float
    """Utility seconds of the best sequence of owners, moves paid."""
    oracle_moves: int
    best: float
    """Utility seconds of the best candidate at every step, moves free: no rule can have more."""
    oracle_owners: npt.NDArray[np.intp]
    """The oracle's owner at every step."""

    def figures(self) -> Figures:
        """The oracle's own line in a comparison."""
        steps = np.arange(len(self.utility))
        was_bad = self.is_bad[steps, self.oracle_owners] & ~self.is_bad.all(axis=1)
        return Figures(
            moves=self.oracle_moves,
            wasted=0,
            regret=0.0,
            bad=float(was_bad.mean()),
            mean_utility=float(self.utility[steps, self.oracle_owners].mean()),
            hours=len(steps) * DT_S / 3600,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Figures:
    """One rule on one history."""

    moves: int
    wasted: int
    """Moves back to the node that was left less than 30 s before."""
    regret: float
    """``(oracle - rule) / oracle``."""
    bad: float
    """Share of the time on a bad node while a good one was there."""
    mean_utility: float
    hours: float
    reaction_s: float | None = None
    """From the step to the move away from what got worse (histories with a step; ``None``: it did not move)."""


def oracle(utility: Array, move_cost: float) -> tuple[float, int, list[int]]:
    """The best sequence of owners in hindsight, moves paid: (utility seconds, moves, owner by step).

    Viterbi over the steps: staying is free, going to any other costs ``move_cost``.
    """
    value = utility[0] * DT_S
    stays = np.empty(utility.shape, dtype=bool)
    origins = np.empty(len(utility), dtype=np.intp)
    for step in range(1, len(utility)):
        best = int(value.argmax())
        moved = value[best] - move_cost
        stays[step], origins[step] = value >= moved, best
        value = np.maximum(value, moved) + utility[step] * DT_S
    owner = int(value.argmax())
    total, path = float(value[owner]), [owner]
    for step in range(len(utility) - 1, 0, -1):
        owner = owner if stays[step][owner] else int(origins[step])
        path.append(owner)
    path.reverse()
    return total, sum(one != other for one, other in itertools.pairwise(path)), path


def truth_of(world: World, *, skip_s: float = 10.0, move_cost_s: float = MOVE_COST_S) -> Truth:
    """The truth of a history from ``skip_s`` on (until then the first placement waits for figures)."""
    skip = round(skip_s / DT_S)
    utility = np.nan_to_num(true_utility(world))[skip:]
    cost = move_cost_s * float(utility.max(axis=1).mean())
    total, moves, owners = oracle(utility, cost)
    return Truth(
        utility=utility,
        is_bad=bad(world)[skip:],
        move_cost=cost,
        oracle=total,
        oracle_moves=moves,
        best=float(utility.max(axis=1).sum()) * DT_S,
        oracle_owners=np.asarray(owners, dtype=np.intp),
    )


def owners_by_step(world: World, moves: list[Move]) -> npt.NDArray[np.intp]:
    """The owner's column at every step (-1: nobody yet)."""
    column = {name: index for index, name in enumerate(world.candidates)}
    out = np.full(world.steps, -1, dtype=np.intp)
    for move in moves:
        out[int(np.ceil(move.at_s / DT_S)) :] = column[move.owner]
    return out


def wasted_moves(moves: list[Move]) -> int:
    """How many moves went back to the node that was left less than 30 s before."""
    pairs = itertools.pairwise(moves)
    return sum(after.owner == before.left and after.at_s - before.at_s < BACK_WITHIN_S for before, after in pairs)


def figures(world: World, truth: Truth, moves: list[Move]) -> Figures:
    """What one rule did on one history."""
    skip = world.steps - len(truth.utility)
    owner = owners_by_step(world, moves)[skip:]
    steps = np.arange(len(owner))
    held = owner >= 0
    earned = np.where(held, truth.utility[steps, owner], 0.0)
    later = [move for move in moves if move.left is not None]
    total = float(earned.sum()) * DT_S - truth.move_cost * len(later)
    was_bad = np.where(held, truth.is_bad[steps, owner], True) & ~truth.is_bad.all(axis=1)
    return Figures(
        moves=len(later),
        wasted=wasted_moves(later),
        regret=(truth.oracle - total) / truth.oracle,
        bad=float(was_bad.mean()),
        mean_utility=float(earned.mean()),
        hours=len(owner) * DT_S / 3600,
        reaction_s=_reaction_s(world, moves),
    )


def _reaction_s(world: World, moves: list[Move]) -> float | None:
    step_at_s = world.step_at_s
    if step_at_s is None:
        return None
    worse = world.candidates[0]
    return next((move.at_s - step_at_s for move in moves if move.left == worse and move.at_s > step_at_s), None)
