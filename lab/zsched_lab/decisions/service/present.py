"""A yardstick between the rules and the oracle: it knows what every machine gives now, and nothing of the future.

Knows: the truth of the present step. Does not know: readings, what comes next.

Rent or buy: a task leaves once staying has cost `PATIENCE` of a move's price. Nobody who must measure what this one
knows can be expected to do better, but by luck or by knowing how long loads last.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from zsched_lab.decisions.loads import Array
from zsched_lab.decisions.rules import Move
from zsched_lab.decisions.service.history import History, mask_of, rank_of
from zsched_lab.decisions.world import DT_S

PATIENCE: Final = 0.5
"""Of a move's price; half of it was best on the training seeds."""
LAG_S: Final = 0.4
"""From a change to its move at the earliest: one reading, one round."""


def present(history: History, price_s: float) -> list[list[Move]]:
    """The moves of every task, in the order of ``history.works``."""
    names = history.fleet.tasks[0].candidates
    placed: list[int] = []
    for _ in history.works:
        first = _each(history, (*placed, None), len(placed), int(history.stretch[0]))
        placed.append(int(np.argmax(first)))
    moves = [[Move(at_s=0.0, owner=names[where], left=None)] for where in placed]
    cost = np.zeros((len(placed), len(names)))
    lag = round(LAG_S / DT_S)
    for step in range(history.steps):
        seen = int(history.stretch[max(step - lag, 0)])
        for task in range(len(placed)):
            gives = _each(history, tuple(placed), task, seen)
            lead = gives - gives[placed[task]]
            cost[task] = np.where(lead > 0.0, cost[task] + lead * DT_S, 0.0)
            best = int(np.argmax(np.where(lead > 0.0, cost[task], -1.0)))
            if lead[best] > 0.0 and cost[task, best] >= PATIENCE * price_s:
                moves[task].append(Move(at_s=step * DT_S, owner=names[best], left=names[placed[task]]))
                placed[task] = best
                cost[task] = 0.0
    return moves


def _each(history: History, placed: tuple[int | None, ...], task: int, stretch: int) -> Array:
    """[C]: the service of ``task`` on every machine, while the other tasks stay where they are."""
    out = np.empty(len(history.machines))
    for machine in range(len(out)):
        there = (*placed[:task], machine, *placed[task + 1 :])
        shared = history.on[machine][mask_of(there, machine)]
        out[machine] = shared.service[stretch, rank_of(there, task)]
    return out
