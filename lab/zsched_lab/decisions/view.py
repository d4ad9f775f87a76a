"""What the robots of a simulated fleet see: the production profilers, gateway, scores and comparison on a history.

Knows: sampling, smoothing, publication, gathers without loss. Does not know: rules, and the truth behind readings.

Every robot receives every profile at once, so one gateway stands for all; each robot has its own utilities, for its
links are its own. What is seen does not depend on the owner (its own load is subtracted), so all rules that want
the same smoothing and weights share one `View`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Final, Protocol

from zsched.config.timing import WIFI
from zsched.core.gateway.gateway import Gateway
from zsched.core.profile.profile import Profiler
from zsched.core.scheduler.scoring import score
from zsched.core.scheduler.standing import Standing, compare, reaches_owner
from zsched.core.values.fleet import Fleet, TaskSpec
from zsched.core.values.in_force import InForce
from zsched.core.values.model import Allocation, NodeId, PeerState, UtilityVector
from zsched.core.values.profile import DeviceSample, LinkSample, LinkSource
from zsched_lab.decisions.world import DT_S, MEMORY_MB, World

LostFor = Callable[[bool, float], float]
"""`Judge.lost_for`: whether the owner is reached and the time now -> for how long it has not been, in seconds."""

START_S: Final = 100.0
"""The clock at step 0: nothing in the core may depend on where a clock begins."""
IDLE: Final = DeviceSample(cpu_cores=4.0, cpu_used_cores=1.0, memory_mb=MEMORY_MB, memory_used_mb=1000.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Look:
    """How a rule wants to see: seconds of smoothing at the source."""

    smoothing_s: float = WIFI.smoothing_s


class Sight(Protocol):
    """What a rule is given to see with."""

    @property
    def fleet(self) -> Fleet:
        """The fleet that it decides in."""

    @property
    def gateway(self) -> Gateway:
        """What the robots have heard."""

    @property
    def spec(self) -> TaskSpec:
        """The task that it decides about."""

    def standing(self, now: float, allocation: Allocation | None = None, lost_for: LostFor | None = None) -> Standing:
        """The joint view of a gather now.

        ``allocation``: the rule's own, where what a machine is worth hangs on it; ``lost_for`` goes with it.
        """


class Feed:
    """What reaches the robots of a history under one `Look`: every node's profiles, in one gateway."""

    def __init__(self, world: World, look: Look) -> None:
        smoothing_s = max(look.smoothing_s, 1e-9)
        self.fleet: Fleet = replace(world.fleet, timing=replace(world.fleet.timing, smoothing_s=smoothing_s))
        self._world = world
        self.gateway = Gateway(InForce(self.fleet))
        self._profilers = {node.name: Profiler(node.name, 1, self.fleet.timing) for node in self.fleet.nodes}
        self._column = {name: index for index, name in enumerate(world.candidates)}
        self._row = {name: index for index, name in enumerate(self.fleet.voters)}
        self._read = _Readings.of(world)

    def step(self, index: int) -> None:
        """Every node takes its reading of step ``index``; profiles that are due reach every robot."""
        now = START_S + index * DT_S
        for name, profiler in self._profilers.items():
            profiler.absorb(self._device(name, index), self._links(name, index), now)
            profile = profiler.publishable({}, is_draining=False, now=now)
            if profile is not None:
                self.gateway.absorb(profile, now)

    def _device(self, name: NodeId, index: int) -> DeviceSample:
        column = self._column.get(name)
        if column is None:
            return IDLE
        cores = self._read.cores[column]
        return DeviceSample(
            cpu_cores=cores,
            cpu_used_cores=self._read.cpu[index][column] * cores,
            memory_mb=MEMORY_MB,
            memory_used_mb=self._read.memory[index][column] * MEMORY_MB,
        )

    def _links(self, name: NodeId, index: int) -> tuple[LinkSample, ...]:
        row, signal = self._row.get(name), self._read.signal
        if signal is None:
            return (LinkSample(source=LinkSource.WIRED),)
        if row is None:
            return ()
        read = signal[index][row]
        if isinstance(read, list):
            pairs = zip(self._world.candidates, read, strict=True)
            return tuple(LinkSample(source=LinkSource.TRACE, peer=peer, rssi_dbm=_dbm(value)) for peer, value in pairs)
        return (LinkSample(source=LinkSource.TRACE, rssi_dbm=_dbm(read)),)


class View:
    """What the robots make of a feed, under one task's weights."""

    def __init__(self, world: World, feed: Feed) -> None:
        self.fleet, self.gateway = feed.fleet, feed.gateway
        self.spec = world.spec
        self._states = dict.fromkeys((node.name for node in self.fleet.nodes), PeerState.ALIVE)
        tuning = self.spec.tuning
        self._allocation = Allocation(task=self.spec.name, revision=0, epoch=0, owner=None, tuning=tuning)
        self._standing: Standing | None = None
        self._version = -1

    def standing(self, now: float, allocation: Allocation | None = None, lost_for: LostFor | None = None) -> Standing:
        """The joint view of a gather now; computed again only when a profile has come, or for ``allocation``."""
        if allocation is not None:
            vectors = self._vectors(allocation, now)
            is_reached = reaches_owner(self.spec, allocation, vectors)
            lost_for_s = math.inf if lost_for is None else lost_for(is_reached, now)
            return compare(self.spec, allocation, vectors, lost_for_s)
        if self._standing is None or self._version != self.gateway.version:
            self._version = self.gateway.version
            vectors = self.vectors(now)
            self._standing = compare(self.spec, self._allocation, vectors)
        return self._standing

    def vectors(self, now: float) -> dict[NodeId, UtilityVector]:
        """{robot: its utilities now}."""
        return self._vectors(self._allocation, now)

    def _vectors(self, allocation: Allocation, now: float) -> dict[NodeId, UtilityVector]:
        return {
            voter: score(self.spec, allocation, voter, self.gateway, self._states, now) for voter in self.fleet.voters
        }


def _dbm(value: float) -> float | None:
    return None if math.isnan(value) else value


@dataclass(slots=True)
class _Readings:
    """The history's readings as plain lists: single numbers are read out of those much faster than out of arrays."""

    cores: list[float]
    cpu: list[list[float]]
    memory: list[list[float]]
    signal: list[list[float]] | list[list[list[float]]] | None = field(default=None)

    @classmethod
    def of(cls, world: World) -> _Readings:
        signal = None if world.signal_read is None else world.signal_read.tolist()
        return cls(world.cores.tolist(), world.cpu_read.tolist(), world.memory_read.tolist(), signal)
