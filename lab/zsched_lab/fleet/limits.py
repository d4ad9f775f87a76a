"""Gives each edge of the lab a share of this machine of its own, so that a load on one is not a load on all.

Knows: control groups with quotas, and CPU affinity for those who may not make groups. Does not know: what runs inside.

The daemons measure what they are given: under a quota the group *is* the machine, otherwise the CPUs they may run on
are. So either way an edge's figures are its own, without a word of the lab inside the daemon.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping
from enum import StrEnum

from zsched.core.values.errors import AdapterError
from zsched.core.values.model import NodeId
from zsched_lab.fleet.groups import LimitedGroup


class LimitKind(StrEnum):
    """How the edges differ."""

    CGROUP = "cgroup"
    AFFINITY = "affinity"
    NONE = "none"


class NodeLimits:
    """The shares of all edges; made by `make_limits`."""

    def __init__(
        self,
        kind: LimitKind,
        says: str,
        *,
        groups: Mapping[NodeId, LimitedGroup] | None = None,
        work: Mapping[NodeId, LimitedGroup] | None = None,
        cpus: Mapping[NodeId, int] | None = None,
        outer: tuple[LimitedGroup, ...] = (),
    ) -> None:
        """``outer``: groups that only hold the others, and go last."""
        self.kind = kind
        self.says = says
        """One sentence for the operator."""
        self._groups = dict(groups or {})
        self._work = dict(work or {})
        """Where a node's tasks have a smaller quota than the node: their groups, within its own."""
        self._cpus = dict(cpus or {})
        self._outer = outer

    def put(self, node: NodeId, pid: int) -> None:
        """Put a process that has just started into its node's share; robots have none.

        Raises:
            AdapterError: it may not be moved, or is gone.
        """
        group = self._groups.get(node)
        if group is not None:
            group.add(pid)
        cpu = self._cpus.get(node)
        if cpu is None:
            return
        try:
            os.sched_setaffinity(pid, {cpu})
        except OSError as error:
            raise AdapterError(f"cannot bind process {pid} to CPU {cpu}: {error}") from error

    def put_work(self, node: NodeId, pid: int) -> None:
        """The same of a process that is the node's work, and no part of zsched.

        Raises:
            AdapterError: it may not be moved, or is gone.
        """
        if (group := self._work.get(node)) is not None:
            group.add(pid)
        else:
            self.put(node, pid)

    def pids(self, node: NodeId) -> tuple[int, ...]:
        """Every process in the node's group; none where it has no group."""
        groups = (self._groups.get(node), self._work.get(node))
        return tuple(sorted({pid for group in groups if group is not None for pid in group.pids()}))

    def remove(self) -> None:
        """Remove the groups; what is still inside one stays (in the lab the janitor comes after us)."""
        for group in (*self._work.values(), *self._groups.values(), *self._outer):
            with contextlib.suppress(AdapterError):
                group.remove()
        self._work.clear()
        self._groups.clear()
        self._outer = ()


def make_limits(prefix: str, cores: Mapping[NodeId, float], memory_mb: float) -> NodeLimits:
    """Shares for the nodes of ``cores`` (quota in cores): control groups where the user may, else one CPU each."""
    why = LimitedGroup.why_not()
    limits_memory = why is None
    if why is not None:
        why = LimitedGroup.why_not(memory=False)
    if why is not None:
        return by_affinity(tuple(cores), why)
    groups: dict[NodeId, LimitedGroup] = {}
    try:
        for node, quota in cores.items():
            memory = memory_mb if limits_memory else None
            groups[node] = LimitedGroup.create(f"{prefix}-{node}", cpu_cores=quota, memory_mb=memory)
    except AdapterError as error:
        for group in groups.values():
            group.remove()
        return by_affinity(tuple(cores), str(error))
    shares = ", ".join(f"{node} {quota:g}" for node, quota in cores.items())
    memory_says = f", {memory_mb:.0f} MiB each" if limits_memory else "; memory is the host's"
    return NodeLimits(LimitKind.CGROUP, f"CPU quotas by cgroup (cores: {shares}){memory_says}", groups=groups)


def by_affinity(nodes: tuple[NodeId, ...], why: str) -> NodeLimits:
    """One CPU per node in turn; with a single CPU there is nothing to tell the nodes apart."""
    available = sorted(os.sched_getaffinity(0))
    if len(available) < 2:
        says = f"no CPU quotas ({why}) and one CPU only: all edges look alike, no moves are to be expected"
        return NodeLimits(LimitKind.NONE, says)
    cpus = {node: available[index % len(available)] for index, node in enumerate(nodes)}
    shares = ", ".join(f"{node} CPU {cpu}" for node, cpu in cpus.items())
    return NodeLimits(LimitKind.AFFINITY, f"no CPU quotas ({why}); each edge is bound to a CPU: {shares}", cpus=cpus)
