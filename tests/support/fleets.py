"""Fleets and tasks, as tests make them over and over. What a test is about, it says itself.

A node whose name begins with "r" is a robot, every other one an edge. Robots are the electors, if there are any.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from zsched.core.values.fleet import Fleet, NodeSpec, TaskSpec, Timing
from zsched.core.values.model import NodeKind, Tuning, Weights

EDGES = ("edge1", "edge2")
ROBOTS = ("robot1", "robot2", "robot3")


def tuning_of(cpu: float = 0.5, memory: float = 0.5, network: float = 0.0, **options: Any) -> Tuning:
    """A task's tuning by its weights."""
    return Tuning(weights=Weights(cpu=cpu, memory=memory, network=network), **options)


def node_of(name: str, **options: Any) -> NodeSpec:
    """A node."""
    return NodeSpec(name=name, **{"kind": NodeKind.ROBOT if name.startswith("r") else NodeKind.EDGE, **options})


def task_of(name: str = "merge", candidates: tuple[str, ...] = EDGES, **options: Any) -> TaskSpec:
    """A task; weights are 0.5 for CPU and memory."""
    return TaskSpec(name=name, candidates=candidates, **{"tuning": tuning_of(), **options})


def fleet_of(
    *tasks: TaskSpec,
    of: Iterable[str | NodeSpec] = (*EDGES, *ROBOTS),
    electors: Iterable[str] | None = None,
    **options: Any,
) -> Fleet:
    """A fleet of these tasks.

    Args:
        tasks: none: `task_of()`.
        of: its nodes; a name stands for a plain one.
        electors: none given: the robots.
        options: other fields; ``tasks=()`` for a fleet without a task.
    """
    nodes = tuple(node_of(one) if isinstance(one, str) else one for one in of)
    robots = tuple(node.name for node in nodes if node.kind is NodeKind.ROBOT)
    chosen = robots if electors is None else tuple(electors)
    usual = {"name": "test", "timing": Timing(), "tasks": tasks or (task_of(),)}
    return Fleet(nodes=nodes, electors=chosen, **{**usual, **options})
