"""VOTE, an operator's orders that end by themselves: when this node proposes the end of a pause or a pin.

Knows: since when this node has known an order, and how long the order lasts. Does not know: how a change is agreed.

No wall time is agreed, for clocks are not compared. Every node counts from the moment when it learnt the order, and the
first whose time is over proposes the end. A node that restarts counts anew. So an order never ends early, and it ends
late when every node was restarted meanwhile.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from zsched.core.values.change import SetHold
from zsched.core.values.model import Allocation, TaskId
from zsched.core.values.struct import Struct, field

SPREAD_S = 0.5
"""A node proposes the end this much later than the node before it in the fleet file: usually one proposal is enough."""
AGAIN_S = 5.0
"""The end of an order that was not agreed is proposed again after this time."""


class Expiry(Struct):
    """All tasks' orders at one node.

    ``rank`` is this node's place in the fleet file. Times are monotonic seconds.
    """

    rank: int
    _known: dict[TaskId, dict[tuple[str, int], float]] = field(default_factory=dict)
    """{task: {(kind of order, its revision): since when it is known}}."""
    _due: dict[TaskId, float] = field(default_factory=dict)

    def note(self, value: Allocation, now: float) -> None:
        """A value is learnt."""
        before = self._known.pop(value.task, {})
        self._due.pop(value.task, None)
        orders = {"pause": value.pause, "pin": value.pin}
        held = {(kind, order.revision): order.for_s for kind, order in orders.items() if order is not None}
        if held:
            self._known[value.task] = {key: before.get(key, now) for key in held}
        ends = [self._known[value.task][key] + for_s for key, for_s in held.items() if for_s is not None]
        if ends:
            self._due[value.task] = min(ends) + self.rank * SPREAD_S

    def since(self, task: TaskId, kind: str) -> float | None:
        """Since when this node knows the task's pause or pin; ``None``: it knows none."""
        for (known, _), at in self._known.get(task, {}).items():
            if known == kind:
                return at
        return None

    def next_deadline(self) -> float:
        """When `due` has something to say; infinity when never."""
        return min(self._due.values(), default=math.inf)

    def due(self, values: Mapping[TaskId, Allocation], now: float) -> list[tuple[TaskId, SetHold]]:
        """The changes by which this node proposes the end of orders; each is told again after `AGAIN_S`."""
        found = []
        for task in [task for task in self._due if task not in values]:
            del self._due[task]  # it has left the fleet
        for task in [task for task, at in self._due.items() if now >= at]:
            self._due[task] = now + AGAIN_S
            found.append((task, self._ended(values[task], now)))
        return found

    def _ended(self, value: Allocation, now: float) -> SetHold:
        pause, pin, over = value.pause, value.pin, []
        if pause is not None and self._is_over(value.task, "pause", pause.for_s, now):
            pause = None
            over.append("pause")
        if pin is not None and self._is_over(value.task, "pin", pin.for_s, now):
            pin = None
            over.append("pin")
        reason = f"the time of its {' and '.join(over)} is over"
        return SetHold(base_revision=value.revision, pause=pause, pin=pin, reason=reason)

    def _is_over(self, task: TaskId, kind: str, for_s: float | None, now: float) -> bool:
        since = self.since(task, kind)
        return for_s is not None and since is not None and now >= since + for_s
