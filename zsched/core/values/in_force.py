"""The fleet that a node goes by. Its parts hold this one object: they read the fleet at each step and keep none of it.

What a part remembers of nodes and tasks stands in tables that are made here. So it ends in one place, when the fleet
names the node or the task no more.

Knows: which names the fleet in force has. Does not know: what the parts remember, who changes the fleet.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from collections.abc import Set as AbstractSet
from typing import Any, TypeVar

from zsched.core.values.fleet import Fleet, NodeSpec, TaskSpec, Timing, fleet_hash
from zsched.core.values.model import NodeId, TaskId

T = TypeVar("T")

_NONE: frozenset[TaskId] = frozenset()
_Make = Callable[[str], Any]


class InForce:
    """One fleet at a time.

    Args:
        fleet: the first one, validated.
    """

    def __init__(self, fleet: Fleet) -> None:
        self._of_nodes: list[tuple[dict[NodeId, Any], _Make | None, NodeId]] = []
        self._of_tasks: list[tuple[dict[TaskId, Any], _Make | None]] = []
        self._save_s = 0.0
        self._go_by(fleet)

    def _go_by(self, fleet: Fleet) -> None:
        self.fleet = fleet
        self.file = fleet_hash(fleet)
        """Its hash."""
        self.nodes: dict[NodeId, NodeSpec] = {node.name: node for node in fleet.nodes}
        self.tasks: dict[TaskId, TaskSpec] = {task.name: task for task in fleet.tasks}
        self.voters = self.robots = fleet.voters
        """The robots that count in votes: all of them (`robots`), until `count` leaves out those that are away."""
        self.electors = fleet.electors
        self.timing: Timing = fleet.timing.paced(self._save_s)
        """The fleet's clocks; those of votes and ballots leave room for saves (`pace`)."""

    def clocks(self) -> Timing:
        """`timing`, for parts that need to know nothing else."""
        return self.timing

    # --- what parts remember -----------------------------------------------------------------------------------------

    def by_node(self, make: Callable[[NodeId], T] | None = None, *, but: NodeId = "") -> dict[NodeId, T]:
        """A table of what is remembered of nodes. With ``make`` it has an entry for each node, ``but`` left out."""
        table: dict[NodeId, T] = {}
        self._of_nodes.append((table, make, but))
        _fit(table, make, [name for name in self.nodes if name != but])
        return table

    def by_task(self, make: Callable[[TaskId], T] | None = None) -> dict[TaskId, T]:
        """A table of what is remembered of tasks. With ``make`` it has an entry for each task."""
        table: dict[TaskId, T] = {}
        self._of_tasks.append((table, make))
        _fit(table, make, self.tasks)
        return table

    # --- what changes it ---------------------------------------------------------------------------------------------

    def take(self, fleet: Fleet, anew: AbstractSet[TaskId] = _NONE) -> None:
        """Go by another fleet from now on; nothing is remembered of nodes and tasks that it does not name.

        ``anew``: nor of these tasks, which are others than those of the same names before.
        """
        self._go_by(fleet)
        for nodes, make, but in self._of_nodes:
            _fit(nodes, make, [name for name in self.nodes if name != but])
        for tasks, make in self._of_tasks:
            _fit(tasks, None, self.tasks.keys() - anew)
            _fit(tasks, make, self.tasks)

    def count(self, voters: tuple[NodeId, ...], electors: tuple[NodeId, ...]) -> None:
        """These robots and electors count, until another fleet is in force."""
        self.voters, self.electors = voters, electors

    def pace(self, save_s: float) -> None:
        """Leave room in the clocks of votes for saves of ``save_s`` (seconds)."""
        self._save_s = save_s
        self.timing = self.fleet.timing.paced(save_s)


def _fit(table: dict[str, Any], make: _Make | None, names: Iterable[str]) -> None:
    if make is not None:
        kept = dict(table)
        table.clear()
        table.update((name, kept[name] if name in kept else make(name)) for name in names)
        return
    wanted = frozenset(names)
    for name in [name for name in table if name not in wanted]:
        del table[name]
