"""A rule that is played beside zsched's: a ledger of lost service, and one price for a move.

Knows: joint utilities over time. Does not know: availability, orders; in the study every machine is always there.

For each machine the task owes what it would have lost there: the work function of a metrical task system with one price
for every move (Borodin, Linial and Saks, J. ACM 39, 1992), old losses fading. No account holds more than the least one
and a price. The task leaves for the machine that owes least once its own one owes a price more; what both lose in the
next `AHEAD_S`, if nothing changes, counts as owed already. It has neither patience nor learning, cool-down, cap or
foresight.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Final

from zsched.core.scheduler.judge import Judge, Judgement, Outcome
from zsched.core.scheduler.patience import LONGEST_GAP_S
from zsched.core.scheduler.standing import Standing
from zsched.core.values.fleet import TaskSpec
from zsched.core.values.model import Allocation, NodeId
from zsched.core.values.struct import replace

PRICE_S: Final = 0.3
MEMORY_S: Final = 200.0
AHEAD_S: Final = 3.0
"""A lead is expected to last so much longer."""
BONUS: Final = 0.02
"""A true dead band: a mean that leads by less never moves the task."""


@dataclass(slots=True)
class Ledger:
    """What one task would have lost on each machine, in seconds of its work above the least one's."""

    price_s: float = PRICE_S
    memory_s: float = MEMORY_S
    ahead_s: float = AHEAD_S
    owed: dict[NodeId, float] = field(default_factory=dict)
    at: float | None = None

    def charge(self, losses: dict[NodeId, float], now: float) -> None:
        """The losses were these since the last look, each a part of the task's work; 2 s at most are charged."""
        gap_s = 0.0 if self.at is None else min(max(now - self.at, 0.0), LONGEST_GAP_S)
        self.at = now
        kept = math.exp2(-gap_s / self.memory_s)
        owed = {name: self.owed.get(name, 0.0) * kept + loss * gap_s for name, loss in losses.items()}
        least = min(owed.values(), default=0.0)
        self.owed = {name: min(one - least, self.price_s) for name, one in owed.items()}

    def expected(self, losses: dict[NodeId, float]) -> dict[NodeId, float]:
        """What each owes, with what it will lose in ``ahead_s``."""
        return {name: self.owed.get(name, 0.0) + self.ahead_s * loss for name, loss in losses.items()}


class LedgerJudge(Judge):
    """The production's judge, but that the ledger says whether to move."""

    __slots__ = ("ledger",)

    def __init__(self, spec: TaskSpec, ledger: Ledger) -> None:
        super().__init__(spec=replace(spec, patience=0.0, learns_patience=False))
        self.ledger = ledger

    def judge(self, standing: Standing, allocation: Allocation, **given: Any) -> Judgement:
        """As `Judge.judge`; a planned move by the ledger alone."""
        judgement, owner = super().judge(standing, allocation, **given), allocation.owner
        losses = {name: 1.0 - judgement.aggregates.get(name, 0.0) for name in self.spec.candidates}
        self.ledger.charge(losses, float(given["now"]))
        if owner is None or judgement.is_escape or owner not in judgement.aggregates:
            return judgement
        expected = self.ledger.expected({name: losses[name] for name in judgement.aggregates})
        least = min(expected, key=lambda name: (expected[name], name != owner, name))
        more_s = expected[owner] - expected[least]
        moves = least != owner and (bool(given["is_called"]) or more_s >= self.ledger.price_s)
        waits = Outcome.WAIT if least != owner else Outcome.STAY
        chosen = least if moves else owner
        return replace(
            judgement,
            outcome=Outcome.PROPOSE if moves else waits,
            candidate=chosen,
            aggregate=judgement.aggregates[chosen],
            reason=f"{owner} owes {more_s:.2f} s more than {least}",
        )
