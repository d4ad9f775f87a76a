"""VOTE, a new generation: what `zsched init --generation G` writes for each task, on every node.

Knows: what the state before said of leases. Does not know: disks, who is initialised when.
"""

from __future__ import annotations

from collections.abc import Iterable

from zsched.core.belief import GENERATION_STEP
from zsched.core.fleet import Fleet
from zsched.core.model import NO_BALLOT, Acceptance, Allocation, RegisterState


def first_registers(fleet: Fleet, generation: int, before: Iterable[RegisterState]) -> tuple[RegisterState, ...]:
    """The registers of a blank state of ``generation``; none for generation 0.

    Accepted everywhere, too: a majority that had learnt a value and accepted none would count as one that forgot.
    A task whose last owner, by the state ``before``, needed no lease is not leased from the start: it may still work.
    """
    if not generation:
        return ()
    unleased = {state.task for state in before if _is_unleased(state)}
    values = (task.first_value(generation * GENERATION_STEP, is_new=task.name not in unleased) for task in fleet.tasks)
    return tuple(
        RegisterState(task=value.task, accepted=Acceptance(ballot=NO_BALLOT, value=value), learnt=value)
        for value in values
    )


def _is_unleased(state: RegisterState) -> bool:
    values: list[Allocation] = [] if state.learnt is None else [state.learnt]
    values += [] if state.accepted is None else [state.accepted.value]
    newest = max(values, key=lambda value: value.revision, default=None)
    return newest is not None and not newest.leased and newest.revision > 0
