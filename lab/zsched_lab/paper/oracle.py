"""Says in hindsight which node was best at any moment: from the schedule of the injected load, not from measurements.

Knows: the scenario's shares, windows and levels. Does not know: what any scheme did.

The yardstick of regret: each node's utility by Eq. 1 and 2 with weights of one half each, if nothing but the schedule
were true. An injected load takes its share of a whole edge, at most all of the node's quota, and its memory; every node
carries its daemon and warm worker (`BASE_MB`), and the task costs the same everywhere.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from zsched.core.scheduler.utility import clamp
from zsched.core.values.model import NodeId
from zsched_lab.paper.load import Window, loaded_at
from zsched_lab.paper.scenario import LoadLevel, NodeShare, Scenario

BASE_MB = 110.0
"""Daemon, relay and merging worker of an edge together (measured: 65 MiB idle, 150 MiB as the owner)."""
TASK_CORES = 0.15
WORTH = 0.02
"""A window's best node must be better by this than the one before: the oracle does not move for nothing."""


def utility(share: NodeShare, level: LoadLevel, full_cores: float, *, is_loaded: bool) -> float:
    """How good a node is, in [0, 1], by Eq. 1 and 2 with what the schedule says; ``full_cores``: a whole edge."""
    wanted = level.streams * level.share * full_cores if level.share > 0 else share.cpu_cores
    cpu = clamp((share.cpu_cores - TASK_CORES - (wanted if is_loaded else 0.0)) / share.cpu_cores)
    used_mb = BASE_MB + share.ballast_mb + (level.memory_mb if is_loaded else 0.0)
    return 0.5 * cpu + 0.5 * clamp((share.memory_mb - used_mb) / share.memory_mb)


def utilities(scenario: Scenario, level: LoadLevel, loaded: Iterable[NodeId]) -> Mapping[NodeId, float]:
    """Every node's `utility` with these loaded."""
    busy = frozenset(loaded)
    full = scenario.full_cores
    return {node: utility(share, level, full, is_loaded=node in busy) for node, share in sorted(scenario.nodes.items())}


def changes(windows: Iterable[Window], duration_s: float) -> list[float]:
    """The times from which on something else is true, from 0, rising."""
    found = {0.0} | {t_s for window in windows for t_s in (window.start_s, window.end_s)}
    return sorted(t_s for t_s in found if t_s < duration_s)


def best_nodes(scenario: Scenario, level: LoadLevel, windows: tuple[Window, ...]) -> tuple[tuple[float, NodeId], ...]:
    """(from when, which node) for the oracle, by time; empty without nodes."""
    best: list[tuple[float, NodeId]] = []
    for t_s in changes(windows, scenario.duration_s):
        scored = utilities(scenario, level, loaded_at(windows, t_s))
        if not scored:
            return ()
        winner = max(scored, key=lambda node: (scored[node], node))
        if not best or scored[winner] > scored[best[-1][1]] + WORTH:
            best.append((t_s, winner))
    return tuple(best)
