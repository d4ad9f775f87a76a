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


def nodes_of(names: Iterable[str]) -> tuple[NodeSpec, ...]:
    """Nodes of these names, in their order."""
    return tuple(NodeSpec(name=name, kind=NodeKind.ROBOT if name.startswith("r") else NodeKind.EDGE) for name in names)


def task_of(name: str = "merge", candidates: tuple[str, ...] = EDGES, **options: Any) -> TaskSpec:
    """A task; weights are 0.5 for CPU and memory."""
    return TaskSpec(name=name, candidates=candidates, **{"tuning": tuning_of(), **options})


def fleet_of(*tasks: TaskSpec, of: Iterable[str] = (*EDGES, *ROBOTS), electors: Iterable[str] | None = None) -> Fleet:
    """A fleet of these tasks.

    Args:
        tasks: none: `task_of()`.
        of: names of its nodes.
        electors: none given: the robots.
    """
    known = nodes_of(of)
    robots = tuple(node.name for node in known if node.kind is NodeKind.ROBOT)
    chosen = robots if electors is None else tuple(electors)
    return Fleet(name="test", timing=Timing(), nodes=known, tasks=tasks or (task_of(),), electors=chosen)
