"""SCHEDULER: what machines have kept of what they promised a task.

Knows: what a machine was worth just before the task came, and what it was worth with the task. Does not know: why the
two differ, what a move costs (`zsched.core.scheduler.ledger`).

A machine that looks better than it is (slower for this task than the benchmark says, a quota, memory that nobody shows)
would be left as soon as it has shown that, and be chosen again as soon as the task is away, without end. So what it
gave counts for as long as it promises the same: then the cause is there as well, whatever it is. A cause that ends
unseen is found by trying again: what was kept fades.
"""

from __future__ import annotations

import math
from collections.abc import Container, Mapping
from typing import Final, Self

from zsched.core.values.decision import KeptMemory
from zsched.core.values.model import NodeId
from zsched.core.values.struct import Struct, field

SAME_WORTH: Final = 0.1
"""A promise is the same as long as it differs by at most this."""
RISES_S: Final = 4.0
"""For so long a task's use may rise where it has come, and the machine seem to give more than it will."""
LEASELESS_S: Final = 60.0
"""A machine that had no lease for an exclusive task is not judged anew for so long."""


class Kept(Struct):
    """What one robot has seen machines give one task."""

    owner: NodeId | None = None
    since: float = 0.0
    """When this owner was first seen."""
    foretold: dict[NodeId, float] = field(default_factory=dict)
    """{machine: its worth when it was last judged without the task, or first}."""
    seen: dict[NodeId, tuple[float, float, float]] = field(default_factory=dict)
    """{machine: (what it promised, what it gave, when)}."""

    @classmethod
    def of(cls, memory: KeptMemory) -> Self:
        """What a memory says."""
        seen = {name: (promised, gave, at) for name, promised, gave, at in memory.seen}
        return cls(owner=memory.owner, since=memory.since, foretold=dict(memory.foretold), seen=seen)

    def memory(self) -> KeptMemory:
        """All of it, as a value."""
        return KeptMemory(
            owner=self.owner,
            since=self.since,
            foretold=tuple(sorted(self.foretold.items())),
            seen=tuple((name, *one) for name, one in sorted(self.seen.items())),
        )

    def keep(self, nodes: Container[NodeId]) -> None:
        """Know nothing of other nodes: one of the same name that comes later is another one."""
        self.foretold = {name: one for name, one in self.foretold.items() if name in nodes}
        self.seen = {name: one for name, one in self.seen.items() if name in nodes}

    def look(self, worth: Mapping[NodeId, float], owner: NodeId | None, now: float) -> None:
        """Note what each machine is worth now, and what ``owner`` gives.

        While the task's use still rises the least figure counts, that of before among them, then the best one: a load
        that comes is not the machine's doing.

        >>> kept = Kept()
        >>> kept.look({"edge1": 0.6, "edge2": 0.9}, "edge1", now=0.0)
        >>> kept.look({"edge1": 0.6, "edge2": 0.5}, "edge2", now=5.0)
        >>> kept.corrected({"edge1": 0.6, "edge2": 0.9}, "edge1", 200.0, now=5.0)
        {'edge1': 0.6, 'edge2': 0.5}
        """
        if owner != self.owner:
            self.owner, self.since = owner, now
        if owner is not None and owner in worth and owner in self.foretold:
            gave, before = worth[owner], self.seen.get(owner)
            if before is not None:
                gave = (max if now - self.since >= RISES_S else min)(gave, before[1])
            if before is None or before[2] <= now:
                self.seen[owner] = (self.foretold[owner], gave, now)
        self.foretold |= {name: value for name, value in worth.items() if name != owner or name not in self.foretold}

    def fail(self, node: NodeId, now: float, for_s: float = 0.0) -> None:
        """The machine was left because it failed: it gave half of what it promised, or half of what it gave before.

        For the next ``for_s`` it is not judged anew: it looks as good as ever.
        """
        if node in self.foretold:
            promised, gave, _ = self.seen.get(node, (self.foretold[node], self.foretold[node], now))
            self.seen[node] = (promised, min(gave, promised) / 2.0, now + for_s)

    def has_failed(self, node: NodeId | None, now: float) -> bool:
        """Whether that is so still."""
        return node in self.seen and self.seen[node][2] > now

    def corrected(
        self, worth: Mapping[NodeId, float], owner: NodeId | None, memory_s: float, now: float
    ) -> dict[NodeId, float]:
        """What each machine is worth by what it has kept; half of that is forgotten in ``memory_s``."""
        found = dict(worth)
        for name, (promised, gave, at) in self.seen.items():
            if name != owner and gave < promised and abs(found.get(name, math.inf) - promised) <= SAME_WORTH:
                found[name] -= (promised - gave) * 0.5 ** (max(now - at, 0.0) / memory_s)
        return found
