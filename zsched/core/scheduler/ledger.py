"""SCHEDULER, when to move: by what a task has lost where it is, and what a move costs.

Knows: losses of all machines over time, the price of a move. Does not know: where losses come from, orders, votes.

To move or to stay is rent or buy with an unknown end: a load that has just begun may be over before the move has paid.
Every robot sees every machine all the time, whoever has the task. So it keeps, for each, what the task would have lost
there: the work function of a metrical task system, one price for every move (Borodin, Linial and Saks, J. ACM 39,
1992), old losses fading. The task leaves for the machine that owes least once its own one owes a price more. No account
holds more than that, and one of a machine where the task is not holds half of it: what was bad there for hours is not
held against it for hours.

What both will lose for `AHEAD_S` if nothing changes counts as well: a large lead is followed at once.

For losses as they are, n machines, no fading and nothing ahead, all losses and moves together cost at most
``(4 n + 1) OPT + 2 n price``, whatever comes, where OPT knows it all beforehand: a machine that was left owes half a
price, so it is chosen again only when the least account has grown by as much, and a stay costs two prices and what the
least account has grown.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from zsched.core.values.model import NodeId
from zsched.core.values.struct import Struct, field

AHEAD_S: Final = 1.5
"""A lead is expected to last so much longer."""
ELSEWHERE: Final = 0.5
"""A machine where the task is not owes at most so many prices."""
LONGEST_GAP_S: Final = 2.0
"""Nothing is charged for longer than this between two judgements: nobody looked."""


class Ledger(Struct):
    """What one task would have lost on each machine, by one robot."""

    owed: dict[NodeId, float] = field(default_factory=dict)
    """{machine: seconds of the task's work, above the least one's}."""
    at: float | None = None
    """When it was charged last."""

    def charge(
        self, losses: Mapping[NodeId, float], owner: NodeId | None, *, price_s: float, memory_s: float, now: float
    ) -> None:
        """The losses were these since the last look (`LONGEST_GAP_S` at most).

        Args:
            losses: {machine: what of a second of its work the task loses there}, at most 1; 1: it cannot have it.
            owner: where the task is. While it is nowhere nothing is charged: who starts late would owe for that.
            price_s: what a move costs, in seconds of the task's work.
            memory_s: half of what is owed is forgotten in this time.
            now: monotonic seconds.

        >>> ledger = Ledger(at=0.0)
        >>> ledger.charge({"edge1": 0.5, "edge2": 0.25}, "edge1", price_s=0.3, memory_s=1e9, now=1.0)
        >>> {name: round(one, 6) for name, one in ledger.owed.items()}
        {'edge1': 0.25, 'edge2': 0.0}
        """
        gap_s = 0.0 if self.at is None or owner is None else min(max(now - self.at, 0.0), LONGEST_GAP_S)
        self.at = now
        kept = 0.5 ** (gap_s / memory_s)
        owed = {name: self.owed.get(name, 0.0) * kept + loss * gap_s for name, loss in losses.items()}
        least = min(owed.values(), default=0.0)
        self.owed = {
            name: min(one - least, price_s if name == owner else ELSEWHERE * price_s) for name, one in owed.items()
        }

    def expected(self, losses: Mapping[NodeId, float], ahead_s: float = AHEAD_S) -> dict[NodeId, float]:
        """{machine: what the task owes there, with what it will lose in ``ahead_s``}, of those that can have it."""
        return {name: self.owed.get(name, 0.0) + ahead_s * loss for name, loss in losses.items()}


def left_after_s(lead: float, price_s: float, smoothing_s: float) -> float:
    """Seconds from a step in the load to the proposal to leave, where it puts the owner behind by ``lead``, or inf.

    ``lead``: beyond the bonus. Smoothing shows the step by and by; a robot sees it as soon as it is shown. The owner
    was best for so long that the others owe what they can.

    >>> round(left_after_s(0.2, 0.3, 0.3), 2), left_after_s(0.0, 0.3, 0.3)
    (1.08, inf)
    """
    elapsed_s = shown = 0.0
    owed = -ELSEWHERE * price_s
    if lead <= 0.0:
        return float("inf")
    while owed + AHEAD_S * shown < price_s:
        elapsed_s += _STEP_S
        shown += (lead - shown) * min(_STEP_S / smoothing_s, 1.0)
        owed += shown * _STEP_S
    return elapsed_s


_STEP_S: Final = 0.01
