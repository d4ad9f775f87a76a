"""VOTE, an operator's change: the answer when it has ended.

Knows: commands, outcomes in words. Does not know: rounds (`zsched.core.register.register`), how an answer travels.
"""

from __future__ import annotations

from zsched.core.values import instructions as do
from zsched.core.values.change import Ended, SetLeased, told_end
from zsched.core.values.messages import CommandOutcome, CommandResult
from zsched.core.values.model import Allocation
from zsched.core.values.todo import ToDo


def refuse_gone(ended: Ended, todo: ToDo) -> None:
    """A change has ended whose task has left the fleet: tell the operator who waits for it."""
    if not isinstance(ended.change, SetLeased) and ended.change.request is not None:
        _refuse(ended.change.request, CommandOutcome.INVALID, f"{ended.task} has left the fleet", todo)


def answer_end(ended: Ended, value: Allocation, todo: ToDo, electors: int) -> None:
    """Tell the operator who waits for a change how it has ended; ``value`` is the present one, of so many electors."""
    if not isinstance(ended.change, SetLeased) and ended.change.request is not None:
        kind, detail = told_end(ended.outcome, electors)
        result = CommandResult(outcome=kind, detail=f"{ended.task}: {detail}", revision=value.revision)
        todo.add(do.AnswerCommand(request=ended.change.request, result=result))


def _refuse(request: int, outcome: CommandOutcome, detail: str, todo: ToDo) -> None:
    todo.add(do.AnswerCommand(request=request, result=CommandResult(outcome=outcome, detail=detail)))
