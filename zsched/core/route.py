"""ROUTE: the plan that this robot's relay shall carry out for one task.

Knows: slots and plans. Does not know: when a handover may go on (`zsched.core.executor`), zenoh, processes.
"""

from __future__ import annotations

from zsched.core.fleet import TaskSpec
from zsched.core.model import NodeId
from zsched.core.plan import RoutePhase, RoutePlan, Slot
from zsched.core.templates import routes_for


def slot_for(spec: TaskSpec, robot: NodeId, owner: NodeId, epoch: int) -> Slot:
    """The routes of one task between ``robot`` and ``owner`` in ``epoch``, every placeholder filled in."""
    return Slot(
        epoch=epoch,
        owner=owner,
        routes=routes_for(spec, robot, owner, epoch),
        ready_when=spec.worker.ready_when,
    )


def plan_for(spec: TaskSpec, phase: RoutePhase, current: Slot, predecessor: Slot | None) -> RoutePlan:
    """The plan in one phase; in `CLOSE` there is no predecessor any more."""
    return RoutePlan(
        task=spec.name,
        phase=phase,
        current=current,
        predecessor=None if phase is RoutePhase.CLOSE else predecessor,
        exclusive=spec.exclusive,
    )
