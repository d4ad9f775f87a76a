"""GATEWAY: the newest profile of every node, with its age (the paper's ``edge_data``, Alg. 1).

Knows: which report is newer, how old is too old, what the task costs where it runs. Does not know: who is better.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from zsched.core.fleet import Demand, Fleet, TaskSpec
from zsched.core.model import NodeId, Profile, TaskId, WorkerState
from zsched.core.sequence import Order, Track

STARVED_CPU_RATIO = 0.9
"""On an owner busier than this the task gets less than it wants: its measured use is no demand."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EdgeData:
    """A node's newest profile and its age in seconds since we received it."""

    profile: Profile
    age_s: float


class Gateway:
    """What this node knows of every node's state, itself included."""

    def __init__(self, fleet: Fleet) -> None:
        self._names = frozenset(node.name for node in fleet.nodes)
        self._ttl_s = fleet.timing.profile_ttl_s
        self._profiles: dict[NodeId, tuple[Profile, float]] = {}
        self._tracks: dict[NodeId, Track] = {}
        self._measured: dict[TaskId, Demand] = {}
        self.version = 0
        """Rises with every change; what was computed from an older version may be wrong."""

    def absorb(self, profile: Profile, now: float, life: int | None = None) -> str | None:
        """Take a profile in; returns why it was refused (one word for a counter), or ``None``.

        ``life`` is the incarnation that the node's beats show: profiles of that life count at once.
        """
        if profile.node not in self._names:
            return "foreign"
        track = self._tracks.setdefault(profile.node, Track())
        is_over = now - track.at > self._ttl_s or (profile.incarnation == life != track.incarnation)
        order = track.judge(profile.incarnation, profile.sequence, now, may_begin=is_over)
        if order is not Order.NEW:
            return "stale" if order is Order.OLD else "doubtful"
        self._profiles[profile.node] = (profile, now)
        self.version += 1
        return None

    def newest(self, node: NodeId, now: float) -> EdgeData | None:
        """The newest profile of ``node`` whatever its age, or ``None`` when it never sent one."""
        known = self._profiles.get(node)
        return None if known is None else EdgeData(profile=known[0], age_s=max(now - known[1], 0.0))

    def fresh(self, node: NodeId, now: float) -> Profile | None:
        """The newest profile of ``node`` when it is not older than the profile's time to live, else ``None``."""
        known = self._profiles.get(node)
        return known[0] if known is not None and now - known[1] <= self._ttl_s else None

    def fresh_until(self, now: float) -> float:
        """Up to when (inclusive) the same profiles as now are fresh, if none comes."""
        ends = (at + self._ttl_s for _, at in self._profiles.values() if now - at <= self._ttl_s)
        return min(ends, default=math.inf)

    def learn_demand(self, task: TaskId, owner: NodeId, now: float) -> None:
        """Note what the task's worker uses on its owner, unless the owner is starved (then it shows too little).

        A worker that is not ready, or a figure that nobody measured, changes nothing: the task does not cost less
        because its worker restarts.
        """
        profile = self.fresh(owner, now)
        load = None if profile is None else profile.worker(task)
        if profile is None or load is None or profile.cpu_used_cores is None:
            return
        if load.state is not WorkerState.READY or profile.cpu_used_cores / profile.cpu_cores >= STARVED_CPU_RATIO:
            return
        known = self._measured.get(task, Demand())
        demand = Demand(
            cpu_cores=known.cpu_cores if load.cpu_cores is None else load.cpu_cores,
            memory_mb=known.memory_mb if load.memory_mb is None else load.memory_mb,
        )
        if demand != self._measured.get(task):
            self._measured[task] = demand
            self.version += 1

    def demand(self, spec: TaskSpec) -> Demand:
        """What the task will use: the larger of the fleet file's figure and the measurement on the owner."""
        measured = self._measured.get(spec.name, spec.demand)
        return Demand(
            cpu_cores=max(spec.demand.cpu_cores, measured.cpu_cores),
            memory_mb=max(spec.demand.memory_mb, measured.memory_mb),
        )
