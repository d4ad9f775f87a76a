"""`zsched init`: creates a node's blank durable state, which states "this name has never voted here".

Knows: what a blank state holds. Does not know: how daemons use it.
"""

from __future__ import annotations

from pathlib import Path

from zsched.adapters.state_file import StateFile, hardware_id
from zsched.clock import wall_seconds
from zsched.core.fleet import Fleet, electorate_hash
from zsched.core.model import Allocation, DurableState, NodeId, RegisterState

GENERATION_STEP = 2**32
"""Revision and epoch of generation G start at G times this, so they only rise."""


def init_state(fleet: Fleet, node: NodeId, folder: Path, generation: int) -> Path:
    """Write the blank state of ``node``; returns the file's path.

    With a generation above 0 every task starts at revision and epoch ``generation * 2**32`` without an owner: for a
    fleet that lost too many states to agree, on every node at once.

    Raises:
        AdapterError: there is a state already, or the folder cannot be written.
    """
    start = generation * GENERATION_STEP
    registers = tuple(
        RegisterState(
            task=task.name,
            learnt=Allocation(task=task.name, revision=start, epoch=start, owner=None, tuning=task.tuning),
        )
        for task in fleet.tasks
        if generation > 0
    )
    state = DurableState(
        fleet=fleet.name,
        node=node,
        incarnation=wall_seconds(),
        generation=generation,
        hardware=hardware_id(),
        electorate=electorate_hash(fleet),
        registers=registers,
    )
    with StateFile(folder, fleet=fleet.name, node=node) as file:
        file.create(state)
        return file.path
