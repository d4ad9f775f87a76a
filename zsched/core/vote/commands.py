"""VOTE, an operator's change of a task: which change it asks for, and the answer when that has ended.

Knows: commands, outcomes in words. Does not know: rounds (`zsched.core.register.register`), how an answer travels.
"""

from __future__ import annotations

from collections.abc import Mapping

from zsched.core import events as ev
from zsched.core import instructions as do
from zsched.core.register.task_register import TaskRegister
from zsched.core.todo import ToDo
from zsched.core.values.change import Ended, Retune, RoundOutcome, SetLeased
from zsched.core.values.messages import CommandOutcome, CommandResult
from zsched.core.values.model import Allocation, TaskId, Weights
from zsched.core.values.struct import replace
from zsched.core.values.words import shown, told_of_silence

_ENDED = {
    RoundOutcome.COMMITTED: (CommandOutcome.OK, "committed by a majority of the electors"),
    RoundOutcome.CONFLICT: (CommandOutcome.CONFLICT, "another change came first"),
    RoundOutcome.UNCHANGED: (CommandOutcome.UNCHANGED, "it is so already"),
    RoundOutcome.NO_QUORUM: (CommandOutcome.NO_QUORUM, ""),
    RoundOutcome.UNKNOWN: (CommandOutcome.UNKNOWN, "the electors fell silent"),
}


def wanted_retune(event: ev.WeightsCommanded, registers: Mapping[TaskId, TaskRegister], todo: ToDo) -> Retune | None:
    """The change that an operator's new weights mean; ``None``: the answer is given already."""
    command, request = event.command, event.request
    register = registers.get(command.task)
    if register is None:
        known = ", ".join(sorted(registers))
        _refuse(request, CommandOutcome.INVALID, f"no task {command.task!r}; tasks: {known}", todo)
        return None
    try:
        weights = Weights(cpu=command.cpu, memory=command.memory, network=command.network, gauges=command.gauges)
    except ValueError as error:
        _refuse(request, CommandOutcome.INVALID, str(error), todo)
        return None
    value = register.value
    if command.base_revision not in (None, value.revision):
        detail = f"revision is {shown(value.revision)}, not {shown(command.base_revision)}"
        _refuse(request, CommandOutcome.CONFLICT, detail, todo)
    elif weights == value.tuning.weights:
        _refuse(request, CommandOutcome.UNCHANGED, _ENDED[RoundOutcome.UNCHANGED][1], todo)
    else:
        tuning = replace(value.tuning, weights=weights)
        return Retune(base_revision=value.revision, tuning=tuning, request=request, asked=command.asked)
    return None


def refuse_gone(ended: Ended, todo: ToDo) -> None:
    """A change has ended whose task has left the fleet: tell the operator who waits for it."""
    if not isinstance(ended.change, SetLeased) and ended.change.request is not None:
        _refuse(ended.change.request, CommandOutcome.INVALID, f"{ended.task} has left the fleet", todo)


def answer_end(ended: Ended, value: Allocation, todo: ToDo, electors: int) -> None:
    """Tell the operator who waits for a change how it has ended; ``value`` is the present one, of so many electors."""
    if not isinstance(ended.change, SetLeased) and ended.change.request is not None:
        kind, detail = _ENDED[ended.outcome]
        told = f"{ended.task}: {detail or told_of_silence(electors)}"
        result = CommandResult(outcome=kind, detail=told, revision=value.revision)
        todo.add(do.AnswerCommand(request=ended.change.request, result=result))


def _refuse(request: int, outcome: CommandOutcome, detail: str, todo: ToDo) -> None:
    todo.add(do.AnswerCommand(request=request, result=CommandResult(outcome=outcome, detail=detail)))
