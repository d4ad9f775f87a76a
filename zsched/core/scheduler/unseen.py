"""SCHEDULER, the way of the data: candidates whose worker is ready, and which this robot's relay does not see.

Knows: whose worker is ready by its node's profile, which workers' tokens our relay sees. Does not know: who was gone
(`zsched.core.scheduler.probation`), who is better.

Control and streams travel on ports of their own. Where a firewall lets the one through and not the other, a node beats,
answers and scores as any other, and no stream reaches its worker. A robot says so when such a worker has been ready and
unseen for `UNSEEN_S`, while the worker of another candidate is seen: then our own relay's links work, and there is a
better place. Where this robot is a candidate itself, with a ready worker, and no other one shares the task, its own
place is as good as one that is seen. By the task's `reach` such a candidate gets nothing, and an owner is left. One
that is unseen again and again has that time in all (`zsched.core.values.absence`). Nor does it get the task between two
absences, while that has an owner which is seen and does not come and go.

Workers that show no token before they own the task say nothing here.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from zsched.core.scheduler.probation import Probation, shows_token
from zsched.core.values.absence import Absences
from zsched.core.values.fleet import TaskSpec
from zsched.core.values.in_force import InForce
from zsched.core.values.model import NodeId, TaskId
from zsched.core.values.struct import Struct, field

UNSEEN_S = 10.0
"""As long as a link may take to come back (`zsched.core.scheduler.probation.LIMIT_S`)."""
LONGEST_GAP_S = 5.0
"""Nobody has looked for so long: this node stood still, and its links may be as old."""


class Unseen(Struct):
    """What one robot knows of candidates that no stream of its own reaches."""

    in_force: InForce
    found: dict[TaskId, frozenset[NodeId]] = field(default_factory=dict)
    """{task: the candidates that were found so when last looked}."""
    _absences: dict[TaskId, dict[NodeId, Absences]] = field(default_factory=dict)
    """{task: {candidate: of its ready worker's tokens}}."""
    _looked_at: float = -math.inf
    """When last, for any task: all are looked at together."""

    def __post_init__(self) -> None:
        self.found, self._absences = self.in_force.by_task(), self.in_force.by_task()

    def forget(self) -> None:
        """Our relay is another one: it tells anew what it sees."""
        self._absences.clear()
        self.found.clear()

    def look(
        self,
        spec: TaskSpec,
        ready: Iterable[NodeId],
        tokens: Probation,
        now: float,
        period_s: float = 0.0,
        *,
        owner: NodeId | None = None,
        is_ours: bool = False,
        is_enough: bool = False,
    ) -> frozenset[NodeId]:
        """The candidates that no stream reaches, as far as it can be told.

        Args:
            spec: the task.
            ready: other nodes that are candidates, live, and whose fresh profile calls the worker ready.
            tokens: knows which workers our relay sees.
            now: monotonic seconds.
            period_s: the longest time between two looks, while all is well.
            owner: who has the task, and may keep it.
            is_ours: that is this node, which needs no token.
            is_enough: this node could have it, too, and no other robot wants it: any other place must be seen.
        """
        if now - self._looked_at > max(LONGEST_GAP_S, 2.0 * period_s):
            self._absences.clear()
        self._looked_at = now
        is_seen = {name: tokens.sees(name, spec.name) for name in ready} if shows_token(spec) else {}
        missed = [name for name, seen in is_seen.items() if not seen] if is_enough or any(is_seen.values()) else []
        absences = {name: one for name, one in self._absences.get(spec.name, {}).items() if name in self.in_force.nodes}
        self._absences[spec.name] = absences
        for name in missed:
            absences.setdefault(name, Absences())
        away_s = {name: one.look(name in missed, now, UNSEEN_S) for name, one in absences.items()}
        comes_and_goes = {name for name in is_seen if name in absences and absences[name].is_held(now, UNSEEN_S)}
        found = {name for name, for_s in away_s.items() if for_s >= UNSEEN_S}
        if is_ours or (owner is not None and is_seen.get(owner) and owner not in comes_and_goes):
            found |= comes_and_goes  # where nobody has it, or not for long, any place is better than none
        self.found[spec.name] = frozenset(found)
        return self.found[spec.name]
