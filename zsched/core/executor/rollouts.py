"""EXECUTOR, beside the handover: which changed workers wait for an operator's look, since when, in words.

The document says it (`zsched.core.values.document.Rollout`), so it is agreed and outlives every restart. A node that
waits makes its worker by the recipe of before (`TaskSpec.worker_on`), so nothing here orders any restart.

Knows: the rollouts of the fleet in force, since when this node has known each. Does not know: processes; whose worker
has started again (profiles tell), who begins and ends a rollout (`zsched.commands.base.rollout`).
"""

from __future__ import annotations

from collections.abc import Iterator

from zsched.core.values.document import Rollout
from zsched.core.values.fleet import Fleet, TaskSpec, runs_worker
from zsched.core.values.model import NodeId, TaskId
from zsched.core.values.struct import Struct, field


def waiting(fleet: Fleet, task: TaskSpec) -> tuple[NodeId, ...]:
    """The nodes that run the worker of before until an operator goes on."""
    homes = (node.name for node in fleet.nodes if runs_worker(task, node.name, node.kind))
    return () if task.rollout is None else tuple(name for name in homes if name not in task.rollout.first)


class Rollouts(Struct):
    """What one node knows of all rollouts; times are monotonic seconds."""

    _known: dict[TaskId, tuple[Rollout, float]] = field(default_factory=dict)

    def take(self, fleet: Fleet, now: float) -> tuple[tuple[TaskId, str], ...]:
        """Another fleet is in force; (task, what has changed) in sentences."""
        before = self._known
        said = {task.name: task.rollout for task in fleet.tasks if task.rollout is not None}
        self._known = {
            name: before[name] if name in before and before[name][0] == rollout else (rollout, now)
            for name, rollout in said.items()
        }
        return tuple(_changes({name: rollout for name, (rollout, _) in before.items()}, fleet))

    def since(self, task: TaskId) -> float | None:
        """Since when this node knows a task's rollout; ``None``: there is none."""
        known = self._known.get(task)
        return None if known is None else known[1]


def _changes(before: dict[TaskId, Rollout], fleet: Fleet) -> Iterator[tuple[TaskId, str]]:
    for task in fleet.tasks:
        was, now = before.get(task.name), task.rollout
        if was == now:
            continue
        if now is None:
            is_back = was is not None and (task.worker.command, task.worker.env) == (was.command, was.env)
            yield (
                task.name,
                "the worker of before is everybody's again" if is_back else "all run the changed worker now",
            )
            continue
        who = now.by or "an operator"
        who = f"{who} ({now.reason})" if now.reason else who
        yield (
            task.name,
            f"{' and '.join(now.first) or 'nobody'} first, the others wait with the worker of before: {who}",
        )
