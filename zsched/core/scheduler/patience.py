"""SCHEDULER, how long to wait before a planned move: by what every patience would have paid so far.

Knows: the joint utilities of all candidates over time, what a move costs. Does not know: who has the task, votes.

To move or to stay is rent-or-buy with an unknown end: a load that has just begun may be over before the move has paid.
How patient a task should be depends on its loads and on how noisy its figures are, which nobody can know beforehand.
But every robot sees every candidate all the time, whoever has the task. So it knows what each patience of a few would
have led to, and goes by the one that has paid least: follow the leader with full information (Kalai and Vempala,
J. Comput. Syst. Sci. 71, 2005; here without perturbation, for nobody plays against it), old times fading.

Where nothing comes and goes but noise, each move of an impatient one is a loss, and the task grows patient; where loads
are real, whoever waits loses, and it grows quick.

Only accounts that are closed tell: whoever has just moved has paid for it, and what that is worth comes later. Were
open ones compared, the task would grow patient in the very moment in which a load begins.

Robots may come to different values: the quickest calls the vote, and each answers with its own winner.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from zsched.core.scheduler.standing import pick
from zsched.core.values.decision import PlayerMemory
from zsched.core.values.model import NodeId
from zsched.core.values.struct import Struct

CHOICES = (0.05, 0.15, 0.5, 1.5)
"""The patiences that are played all the time, in seconds of the task's work."""
FIRST_PATIENCE = 0.15
"""Until one of the others has paid less."""
MOVE_PRICE_S = 0.3
"""What a move costs, in seconds of the task's work; real fleets: 0.3 to 0.5 s."""
SEEN_LATE_S = 1.0
"""A lead is seen this late, and its end as well: a move earns less than the figures say, by the lead times it."""
MEMORY_S = 600.0
"""A payment counts 1/e after this time."""
FORGIVEN_IN_S = 2.0
LONGEST_GAP_S = 2.0
"""Nothing is charged for longer than this between two judgements: nobody looked."""


def spend(spent: float, lead: float, patience: float, elapsed_s: float) -> float:
    """Add up a lead over the owner with its bonus, over time (Page's CUSUM, Biometrika 41, 1954).

    The bonus is its drift and the patience its threshold. `FORGIVEN_IN_S` without a lead clear the account. It never
    holds more than is asked for: what a lead within the cool-down leaves behind is forgiven as soon as anything.

    >>> spend(spent=0.1, lead=0.2, patience=0.4, elapsed_s=0.5), spend(0.1, 0.0, 0.4, 0.5)
    (0.2, 0.0)
    """
    rate = lead if lead > 0.0 else -patience / FORGIVEN_IN_S
    return min(max(spent + elapsed_s * rate, 0.0), patience)


class _Player(Struct):
    """One patience, with the owner that the task would have by it."""

    patience: float
    owner: NodeId | None = None
    spent: float = 0.0
    paid: float = 0.0
    """Service lost against the best candidate of every moment, and moves; in seconds of work, fading."""
    moved_at: float = -math.inf

    def play(
        self, aggregates: Mapping[NodeId, float], bonus: float, cool_down_s: float, now: float, gap_s: float
    ) -> None:
        best = pick(aggregates, self.owner)
        assert best is not None
        if self.owner is None or self.owner not in aggregates:
            self.owner, self.spent = best, 0.0  # an escape, or the beginning: the same for everybody
        behind = aggregates[best] - aggregates[self.owner]
        self.paid = self.paid * math.exp(-gap_s / MEMORY_S) + behind * gap_s
        self.spent = spend(self.spent, behind - bonus, self.patience, gap_s)
        if behind > bonus and self.spent >= self.patience and now - self.moved_at >= cool_down_s:
            self.paid += MOVE_PRICE_S + SEEN_LATE_S * behind
            self.owner, self.spent, self.moved_at = best, 0.0, now

    def memory(self) -> PlayerMemory:
        moved_at = None if self.moved_at == -math.inf else self.moved_at
        return PlayerMemory(owner=self.owner, spent=self.spent, paid=self.paid, moved_at=moved_at)

    def recall(self, memory: PlayerMemory) -> None:
        self.owner, self.spent, self.paid = memory.owner, memory.spent, memory.paid
        self.moved_at = -math.inf if memory.moved_at is None else memory.moved_at


class LearntPatience:
    """One task's patience at one robot."""

    def __init__(self) -> None:
        self._players = tuple(_Player(patience) for patience in CHOICES)
        self._at: float | None = None
        self.value = FIRST_PATIENCE
        """That which had paid least when no account was open, to a thousandth; of several the nearest to the first."""

    def watch(self, aggregates: Mapping[NodeId, float], bonus: float, cool_down_s: float, now: float) -> None:
        """Play all choices on: the joint utilities have been ``aggregates`` since the last look (2 s at most)."""
        gap_s = 0.0 if self._at is None else min(max(now - self._at, 0.0), LONGEST_GAP_S)
        self._at = now
        if not aggregates:
            return
        for player in self._players:
            player.play(aggregates, bonus, cool_down_s, now, gap_s)
        best = max(aggregates.values())
        if all(player.owner is not None and best - aggregates[player.owner] <= bonus for player in self._players):
            self.value = min(self._players, key=_rank).patience

    def memory(self) -> tuple[tuple[PlayerMemory, ...], float | None]:
        """(the choices as they stand, when they were last played)."""
        return tuple([player.memory() for player in self._players]), self._at

    def recall(self, players: tuple[PlayerMemory, ...], at: float | None, value: float | None) -> None:
        """Go on from there; ``value``: the patience in force, ``None`` in a memory of before it was kept."""
        self._at = at
        for player, memory in zip(self._players, players, strict=False):
            player.recall(memory)
        self.value = min(self._players, key=_rank).patience if value is None else value


def _rank(player: _Player) -> tuple[float, float]:
    return round(player.paid, 3), abs(math.log(player.patience / FIRST_PATIENCE))
