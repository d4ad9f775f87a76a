"""SCHEDULER, the way of the data: candidates whose worker is ready, and which this robot's relay does not see.

Knows: whose worker is ready by its node's profile, which workers' tokens our relay sees. Does not know: who was gone
(`zsched.core.scheduler.probation`), who is better.

Control and streams travel on ports of their own. Where a firewall lets the one through and not the other, a node beats,
answers and scores as any other, and no stream reaches its worker. A robot says so when such a worker has been ready and
unseen for `UNSEEN_S`, while the worker of another candidate is seen: then our own relay's links work, and there is a
better place. By the task's `reach` such a candidate gets nothing, and an owner is left.

Workers that show no token before they own the task say nothing here.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from collections.abc import Set as AbstractSet

from zsched.core.scheduler.probation import Probation, shows_token
from zsched.core.values.fleet import TaskSpec
from zsched.core.values.model import NodeId, TaskId
from zsched.core.values.struct import Struct, field

UNSEEN_S = 10.0
"""As long as a link may take to come back (`zsched.core.scheduler.probation.LIMIT_S`)."""
LONGEST_GAP_S = 5.0
"""Nobody has looked for so long: this node stood still, and its links may be as old."""


class Unseen(Struct):
    """What one robot knows of candidates that no stream of its own reaches."""

    found: dict[TaskId, frozenset[NodeId]] = field(default_factory=dict)
    """{task: the candidates that were found so when last looked}."""
    _since: dict[TaskId, dict[NodeId, float]] = field(default_factory=dict)
    """{task: {candidate: since when its worker is ready and unseen}}."""
    _looked_at: float = -math.inf
    """When last, for any task: all are looked at together."""

    def forget(self) -> None:
        """Our relay is another one: it tells anew what it sees."""
        self._since.clear()
        self.found.clear()

    def adopt(self, tasks: AbstractSet[TaskId]) -> None:
        """What was known of other tasks is forgotten."""
        for task in [task for task in self.found if task not in tasks]:
            del self.found[task]
            self._since.pop(task, None)

    def look(
        self, spec: TaskSpec, ready: Iterable[NodeId], tokens: Probation, now: float, period_s: float = 0.0
    ) -> frozenset[NodeId]:
        """The candidates that no stream reaches, as far as it can be told.

        Args:
            spec: the task.
            ready: other nodes that are candidates, live, and whose fresh profile calls the worker ready.
            tokens: knows which workers our relay sees.
            now: monotonic seconds.
            period_s: the longest time between two looks, while all is well.
        """
        if now - self._looked_at > max(LONGEST_GAP_S, 2.0 * period_s):
            self._since.clear()
        self._looked_at = now
        is_seen = {name: tokens.sees(name, spec.name) for name in ready} if shows_token(spec) else {}
        missed = [name for name, seen in is_seen.items() if not seen] if any(is_seen.values()) else []
        known = self._since.get(spec.name, {})
        since = self._since[spec.name] = {name: known.get(name, now) for name in missed}
        found = self.found[spec.name] = frozenset(name for name, at in since.items() if now - at >= UNSEEN_S)
        return found
