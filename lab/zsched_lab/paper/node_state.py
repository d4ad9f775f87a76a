"""The nodes of a run: their shares of this machine, and what their daemons say of themselves before and after it.

Knows: control groups, daemons' snapshots. Does not know: the order of a run.
"""

from __future__ import annotations

from collections.abc import Mapping

from zsched.core.values.errors import AdapterError
from zsched.core.values.model import NodeId
from zsched_lab.fleet.groups import LimitedGroup
from zsched_lab.fleet.limits import LimitKind, NodeLimits
from zsched_lab.fleet.runner import LabFleet
from zsched_lab.fleet.view import Status, find_task
from zsched_lab.paper.scenario import Scenario
from zsched_lab.paper.work_group import OWN, WORK

CALM_RATIO = 0.3


def node_limits(prefix: str, scenario: Scenario, fleet: LabFleet) -> NodeLimits:
    """A control group with quota and memory limit for each node that has a share in the scenario.

    Where a share names what zsched takes on top, tasks have a group within it, with a quota of their own: else they
    would have what zsched leaves, which is another part on every machine. Workers go there by
    `zsched_lab.paper.work_group`.

    Raises:
        AdapterError: this user may not make them; without them the nodes would not differ, and nothing be shown.
    """
    groups: dict[NodeId, LimitedGroup] = {}
    work: dict[NodeId, LimitedGroup] = {}
    outer: list[LimitedGroup] = []
    says = []
    try:
        for node, share in scenario.nodes.items():
            if node not in fleet.kinds:
                continue
            name = f"{prefix}-{node}"
            group = LimitedGroup.create(name, cpu_cores=share.quota_cores, memory_mb=share.memory_mb)
            group.give_way()  # what has no quota stands for other machines
            if not share.overhead_cores:
                groups[node] = group
                says.append(f"{node} {share.quota_cores:g} cores, {share.memory_mb:.0f} MiB")
                continue
            outer.append(group)
            groups[node] = group.inner(OWN)
            tasks_cores = share.cpu_cores + share.work_cores
            work[node] = group.inner(WORK, cpu_cores=tasks_cores)
            says.append(f"{node} {share.quota_cores:g} cores, {tasks_cores:g} for tasks, {share.memory_mb:.0f} MiB")
    except AdapterError:
        for group in (*work.values(), *groups.values(), *outer):
            group.remove()
        raise
    if not groups:
        return NodeLimits(LimitKind.NONE, "no node has a share of its own")
    said = "control groups: " + "; ".join(says)
    return NodeLimits(LimitKind.CGROUP, said, groups=groups, work=work, outer=tuple(outer))


def ready_workers(status: Status, task: str) -> set[NodeId]:
    """The nodes whose worker for ``task`` is ready, by one snapshot."""
    return {
        str(node["name"])
        for node in status.get("nodes") or ()
        for worker in node.get("workers") or ()
        if worker.get("task") == task and worker.get("state") == "ready"
    }


def is_calm(statuses: Mapping[NodeId, Status], nodes: tuple[NodeId, ...]) -> bool:
    """Whether every one of ``nodes`` says of itself that it is idle."""
    for node in nodes:
        own = next((part for part in (statuses.get(node) or {}).get("nodes") or () if part.get("name") == node), None)
        ratio = None if own is None else own.get("cpu_ratio")
        if ratio is None or ratio > CALM_RATIO:
            return False
    return True


def own_links(status: Status, node: NodeId) -> object:
    """The signals (dBm) of the node's own way to the access point, by its own snapshot."""
    own: Status = next((part for part in status.get("nodes") or () if part.get("name") == node), {})
    return [link.get("rssi_dbm") for link in own.get("links") or () if link.get("peer") is None]


def owners_of(status: Status, tasks: tuple[str, ...]) -> set[str | None]:
    """The owners of ``tasks`` by one snapshot; ``None`` among them: one has none yet."""
    return {(find_task(status, task) or {}).get("owner") for task in tasks}


def task_streams(status: Status, task: str) -> object:
    """The counts of the task's streams at one node."""
    return (find_task(status, task) or {}).get("streams")
