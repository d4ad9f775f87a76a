"""SCHEDULER, several tasks: the room that another task is about to take.

Knows: where tasks go whose votes are open or won at this robot, and what memory they will need there. Does not know:
who is better, whether a task has another place (`zsched.core.scheduler.decision`).

Tasks that lose their owner together are judged in one round, for such an escape waits for no other one. Each by itself
they would all find the same machine free, go there together, and some would leave it again for want of memory. Every
robot judges them in the order of their names, and so comes to the same claims.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from zsched.core.gateway.gateway import Gateway
from zsched.core.scheduler.eligibility import lacks_memory
from zsched.core.scheduler.turns import Turn
from zsched.core.scheduler.usage import book, coming_use, own_use, predicted
from zsched.core.values.fleet import TaskSpec
from zsched.core.values.model import Allocation, NodeId, TaskId
from zsched.core.values.struct import replace


def claims_of_others(turns: Mapping[TaskId, Turn], mine: TaskId, now: float) -> dict[TaskId, NodeId]:
    """{another task: the node that it is about to go to}, by what this robot knows of the votes."""
    going = {name: turn.going_to(now) for name, turn in turns.items() if name != mine}
    return {name: node for name, node in going.items() if node is not None}


def taken(
    spec: TaskSpec,
    claims: Mapping[TaskId, NodeId],
    specs: Iterable[TaskSpec],
    values: Mapping[TaskId, Allocation],
    gateway: Gateway,
    now: float,
) -> dict[NodeId, str]:
    """{candidate: why it has no room for the task beside those that are about to go there}.

    The task has no living owner: the fleet file's figure of its memory counts, as in `zsched.core.scheduler.scoring`.
    """
    coming = {name: node for name, node in claims.items() if node != values[name].owner}
    bookings = book(specs, {**values, **{name: replace(values[name], owner=node) for name, node in coming.items()}})
    nodes, found = frozenset(coming.values()), dict[NodeId, str]()
    for candidate in [name for name in spec.candidates if name in nodes]:
        profile = gateway.fresh(candidate, now)
        if profile is None:
            continue
        own = own_use(spec, values[spec.name], profile, spec.demand, gateway)
        use = predicted(profile, own, spec.demand, coming_use(spec, profile, bookings, gateway, now, own))
        if why := lacks_memory(profile, spec.demand.memory_mb, use):
            others = ", ".join(sorted(name for name, node in coming.items() if node == candidate))
            found[candidate] = f"{others} goes there now: {why}"
    return found
