"""What a judgement goes by, with what a test does not care about filled in."""

from __future__ import annotations

from typing import Any

from support.allocations import allocation_of
from zsched.core.scheduler.decision import rules_of
from zsched.core.values.decision import Figures
from zsched.core.values.fleet import TaskSpec
from zsched.core.values.model import NodeId, PeerState


def figures_of(spec: TaskSpec, *robots: NodeId, **options: Any) -> Figures:
    """Figures of a task that edge1 owns, which lives; the robots are the electors, all heard, without a utility yet."""
    usual = {
        "now": 1000.0,
        "allocation": allocation_of(4, epoch=3, task=spec.name, tuning=spec.tuning),
        "vectors": (),
        "settled_for_s": 60.0,
        "owner_state": PeerState.ALIVE,
        **dict.fromkeys(("voters", "present", "electors", "electors_heard"), robots),
    }
    return Figures(task=spec.name, rules=rules_of(spec), **{**usual, **options})
