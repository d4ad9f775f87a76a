"""Holds what every node's status says of a calm fleet against the truth, which only the stage knows.

Knows: the simulator's machines, the status snapshot. Does not know: faults, when the fleet is calm.

A status that says *ok* while electors have lost their state, while an owner is gone, or of another owner, is a fault.
"""

from __future__ import annotations

from collections.abc import Iterator

from zsched.core.node.status import build_snapshot
from zsched.core.values.model import NodeId, PeerState
from zsched.core.values.problems import Problem
from zsched.core.values.quorum import majority
from zsched.core.values.snapshot import Snapshot
from zsched_lab.sim.simulator import Simulator

TOLD_S = 3.0
"""At most this long after the fleet has come to rest, every status is right: no peer takes longer to be found gone."""


def untrue(sim: Simulator) -> list[str]:
    """What nodes say that is not so, of all that run; each begins with the node's name."""
    running = sim.running()
    return [
        f"{name} says {text}"
        for name in running
        for text in _untrue(sim, running, build_snapshot(sim.node(name), sim.machines[name].clock.local(sim.now)))
    ]


def _untrue(sim: Simulator, running: tuple[NodeId, ...], said: Snapshot) -> Iterator[str]:
    for node in said.nodes:
        if (node.state == PeerState.ALIVE.value) is not (node.name in running):
            yield f"that {node.name} is {node.state}"
    fit = sim.fit_electors()
    lost = [name for name in sim.fleet.electors if name in running and name not in fit]
    quorum = said.quorum
    if [name for name in quorum.stateless if name in running] != sorted(lost):
        yield f"that {quorum.stateless} have no state, and {lost} have none"
    if (quorum.alive, quorum.ok) != (len(fit), len(fit) >= majority(len(sim.fleet.electors))):
        yield f"that {quorum.alive} electors can answer (ok: {quorum.ok}), and {len(fit)} can"
    is_told = Problem.STATELESS in said.problem_kinds
    if bool(quorum.stateless) is not is_told:
        yield f"in its problems {said.problems}, and {quorum.stateless} have no state"
    for task in said.tasks:
        owner = sim.agreed(task.name)
        if (task.owner, task.owner_state) != (owner, PeerState.ALIVE.value):
            yield f"that {task.name} is at {task.owner} ({task.owner_state}), and it is at {owner}"
        if task.problems:
            yield f"of {task.name}, which is well, {task.problems}"
