"""Decides whether this node's sessions may use shared memory, and says why not.

Knows: the fleet file's word, what the machine allows, which streams cannot bear it. Does not know: zenoh.
"""

from __future__ import annotations

from zsched.core.values.fleet import Fleet, NodeSpec, SharedMemory, runs_worker
from zsched.core.values.plan import StreamClass
from zsched.host.machine.shared_memory import why_not


def shared_memory_objection(fleet: Fleet, me: NodeSpec) -> str | None:
    """Why shared memory stays off although the fleet file says ``auto``; ``""``: it is on; ``None``: it says ``off``.

    A session uses it for all its large puts or for none, so one stream of class ``reliable`` keeps it off: what a relay
    keeps to send it again would be the sender's, who takes it back from a holder that stood still for 0.1 s.
    """
    if fleet.shared_memory is SharedMemory.OFF:
        return None
    for task in fleet.tasks:
        if any(rule.settings.stream_class is StreamClass.RELIABLE for rule in task.rules):
            return f"task {task.name} has a stream of class reliable, which a late receiver could lose by this way"
    workers = sum(runs_worker(task, me.name, me.kind) for task in fleet.tasks)
    return why_not(1 + workers)
