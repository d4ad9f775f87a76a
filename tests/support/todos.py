"""One call into a stage, and what it leaves to do (`zsched.core.values.todo`), and what the node does with ends."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from zsched.core.values.fleet import Fleet
from zsched.core.values.instructions import Instruction
from zsched.core.values.todo import ToDo
from zsched.core.vote.agreement import Agreement


def todo_of(call: Callable[..., None], *args: Any) -> ToDo:
    """What ``call`` leaves to do: its last argument is the time, the one before it the `ToDo`."""
    todo = ToDo()
    call(*args[:-1], todo, args[-1])
    return todo


def agreed(call: Callable[..., None], *args: Any) -> ToDo:
    """The same of a method of `Agreement`, or of its acceptor, which ends no change.

    Those who wait for changes that have ended are told, as the node does.
    """
    todo = todo_of(call, *args)
    agreement: Agreement = call.__self__  # type: ignore[attr-defined] # a bound method
    for ended in todo.ended:
        agreement.on_ended(ended, todo)
    return todo


def under(agreement: Agreement, fleet: Fleet, now: float) -> ToDo:
    """Another fleet is in force."""
    agreement._in_force.take(fleet)
    return agreed(agreement.on_fleet, now)


def done(call: Callable[..., None], *args: Any) -> tuple[Instruction, ...]:
    """What a method of `Executor` has this machine do."""
    todo = ToDo()
    is_timed = call.__name__ in ("execute", "on_flipped", "tick", "set_lease", "isolate", "rejoin")
    call(*args[:-1], todo, args[-1]) if is_timed else call(*args, todo)
    assert not todo.send
    return tuple(todo.apply)
