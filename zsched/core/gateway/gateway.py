"""GATEWAY: the newest profile of every node, with its age (the paper's ``edge_data``, Alg. 1).

Knows: which profile is newer, how old is too old, what a node measured before its reader failed, the task's demand.
Does not know: which node is better.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from zsched.core.gateway.demand import Demands, Need, speed_of
from zsched.core.gateway.sharing import Shares
from zsched.core.values.fleet import TaskSpec
from zsched.core.values.gauges import BY_NAME, possible
from zsched.core.values.in_force import InForce
from zsched.core.values.model import NodeId, TaskId
from zsched.core.values.profile import Profile
from zsched.core.values.sequence import Order, Track
from zsched.core.values.struct import Struct
from zsched.core.values.words import GaugeName


class EdgeData(Struct, frozen=True, kw_only=True):
    """A node's newest profile and its age in seconds since we received it."""

    profile: Profile
    age_s: float


class Gateway:
    """This node's knowledge of every node, itself included."""

    def __init__(self, in_force: InForce) -> None:
        self._in_force = in_force
        self._profiles: dict[NodeId, tuple[Profile, float]] = in_force.by_node()
        self._tracks: dict[NodeId, Track] = in_force.by_node()
        self._readings: dict[NodeId, dict[GaugeName, float]] = in_force.by_node()
        """{node: the last readings in this life of its gauges without which it may have a task}."""
        self.demands = Demands()
        """What tasks need, as this node has learnt it."""
        self.shares = Shares()
        """What they would get of full machines."""
        self.version = 0
        """Rises with every change; a result from an older version may be wrong."""

    @property
    def _ttl_s(self) -> float:
        return self._in_force.timing.profile_ttl_s

    def absorb(self, profile: Profile, now: float, life: int | None = None) -> str | None:
        """Take a profile in; returns why it was refused (one word for a counter), or ``None``.

        ``life`` is the incarnation that the node's beats show: profiles of that life count at once.
        """
        if profile.node not in self._in_force.nodes:
            return "foreign"
        track = self._tracks.setdefault(profile.node, Track())
        is_over = now - track.at > self._ttl_s or (profile.incarnation == life != track.incarnation)
        order = track.judge(profile.incarnation, profile.sequence, now, may_begin=is_over)
        if order is not Order.NEW:
            return "stale" if order is Order.OLD else "doubtful"
        known = self._profiles.get(profile.node)
        last = {} if known is None or known[0].incarnation != profile.incarnation else self._readings[profile.node]
        seen = {name: reading for name, reading in possible(profile.gauges) if not BY_NAME[name].is_needed}
        self._profiles[profile.node], self._readings[profile.node] = (profile, now), last | seen
        self.version += 1
        return None

    def readings(self, profile: Profile) -> Mapping[GaugeName, float]:
        """A node's gauges by its newest profile; what it does not measure any more is as it was last, in this life.

        A reader that fails must not make its node better, and a node without a battery counts as full. Not so the
        gauges that a task needs (`Gauge.is_needed`): a node without them cannot have it.
        """
        return self._readings.get(profile.node, {}) | dict(possible(profile.gauges))

    def newest(self, node: NodeId, now: float) -> EdgeData | None:
        """The newest profile of ``node`` whatever its age, or ``None`` when it never sent one."""
        known = self._profiles.get(node)
        return None if known is None else EdgeData(profile=known[0], age_s=max(now - known[1], 0.0))

    def fresh(self, node: NodeId, now: float) -> Profile | None:
        """The newest profile of ``node`` when it is not older than the profile's time to live, else ``None``."""
        known = self._profiles.get(node)
        return known[0] if known is not None and now - known[1] <= self._ttl_s else None

    def fresh_until(self, now: float) -> float:
        """The time until which (inclusive) the same profiles as now stay fresh, if none comes."""
        ends = (at + self._ttl_s for _, at in self._profiles.values() if now - at <= self._ttl_s)
        return min(ends, default=math.inf)

    def learn_demand(self, task: TaskId, owner: NodeId | None, now: float) -> None:
        """Learn the task's need and share from its owner's profile (`zsched.core.gateway.demand` and `sharing`)."""
        if owner is None:
            self.demands.note_unplaced(task)
            return
        profile = self.fresh(owner, now)
        if profile is None:
            return
        spec = self._in_force.tasks.get(task)
        candidates = () if spec is None else spec.candidates
        heard_now = (self.fresh(name, now) for name in candidates)  # a machine that is gone would do none of it
        fastest = max((speed_of(one) for one in heard_now if one is not None), default=None)
        if self.demands.is_replaced(task, profile):
            self.forget(task)
        has_share = self.shares.learn(task, profile, now)
        load = profile.worker(task)
        if load is None or load.cpu_cores is None:  # nobody measures it
            for one in (self.fresh(name, now) for name in candidates if name != owner):
                if one is not None:
                    self.shares.look_elsewhere(task, one, now)
        has_need = self.demands.learn(task, profile, now, fastest)
        self.version += has_need or has_share

    def forget(self, task: TaskId) -> None:
        """Know no need and no share of a task that is no more."""
        self.demands.forget(task)
        self.shares.forget(task)
        self.version += 1

    def expect_another(self, task: TaskId) -> None:
        """The file names another program for the task: its need and share are the owner's worker's until that is it."""
        self.forget(task)
        self.demands.expect_another(task)

    def demand(self, spec: TaskSpec, profile: Profile) -> Need:
        """The task's demand on the node of ``profile``."""
        return self.demands.at(spec, profile)
