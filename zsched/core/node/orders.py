"""Operators' orders at the door: a task is moved, paused, pinned or tuned, through its register.

Knows: which order is refused, with which words, and the change that it becomes. Does not know: how a change is agreed
(`zsched.core.vote.agreement`), what follows from it (`zsched.core.scheduler.judge`).

Every order is checked by what this node knows. The register is what decides: an order names the revision that it was
made for, and a change that came first makes it a conflict.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from zsched.core.node.stages import Handler, Stages
from zsched.core.scheduler.eligibility import Doubts
from zsched.core.scheduler.scoring import score
from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.change import Change, MoveOwner, Retune, SetHold
from zsched.core.values.messages import CommandOutcome, CommandResult, Hold, HoldTask, MoveTask, TuneTask
from zsched.core.values.model import Allocation, NodeId, Pause, PeerState, Pin, TaskId, told_by
from zsched.core.values.todo import ToDo
from zsched.core.values.veto import Filter
from zsched.core.values.words import shown

Refusal = tuple[CommandOutcome, str]
_SO_ALREADY: Final = "it is so already"


def _on_move(node: Stages, event: ev.MoveCommanded, todo: ToDo, now: float) -> None:
    """Hand a task over to the named candidate; nobody votes about it."""
    command = event.command
    refusal = _refused(node, command.task, command.base_revision) or _no_move(node, command, now)
    if refusal is not None or command.is_plan:
        outcome, detail = refusal or (CommandOutcome.OK, f"{command.node} can have it")
        _answer(node, event.request, command.task, outcome, detail, todo)
        return
    value = node.registers[command.task].value
    change = MoveOwner(
        base_revision=value.revision,
        owner=command.node,
        reason=f"moved by {told_by(command.asked)}",
        asked=command.asked,
        request=event.request,
    )
    node.agreement.propose(command.task, change, todo, now)


def _no_move(node: Stages, command: MoveTask, now: float) -> Refusal | None:
    """Why the task cannot be handed over to that node now."""
    value, target = node.registers[command.task].value, command.node
    if command.origin is not None and command.origin != value.owner:
        return CommandOutcome.CONFLICT, f"its owner is {value.owner or 'nobody'}, not {command.origin}"
    refusal = _no_place(node, command.task, target)
    if refusal is not None:
        return refusal
    if target == value.owner:
        return CommandOutcome.UNCHANGED, _SO_ALREADY
    if value.home is not None and target != value.home:
        detail = f"it is pinned to {value.home}: pin it to {target}, or `zsched unpin {command.task}` first"
        return CommandOutcome.INVALID, detail
    why = unfit(node, value, target, now)
    return (CommandOutcome.INVALID, f"{target} cannot have it: {why}") if why else None


def _no_place(node: Stages, task: TaskId, target: NodeId) -> Refusal | None:
    candidates = node.fleet.task(task).candidates
    if target in candidates:
        return None
    return CommandOutcome.INVALID, f"{target!r} is no candidate; there are {', '.join(candidates)}"


def unfit(node: Stages, value: Allocation, target: NodeId, now: float) -> str:
    """Why a candidate cannot have the task by what this node knows of it; empty: it can."""
    if target in node.flags.closed:
        closed = node.flags.closed[target]
        return f"it is {closed}" if target in node.flags.drained else f"it {closed}"
    state = node.membership.state(target)
    if target != node.me and state is not PeerState.ALIVE:
        return f"it is {state}" if state is not PeerState.UNKNOWN else "it was never heard"
    spec = node.fleet.task(value.task).under(value.tuning)
    # Margins keep the task from what it would leave again by itself; an operator may send it there.
    left = frozenset() if value.owner is None else frozenset({value.owner})
    doubts = Doubts(left=left, unfit=node.unfit(value.task, now))
    vector = score(spec, value, node.me, node.gateway, node.membership.states(), now, doubts=doubts)
    veto = vector.vetoes.get(target)
    if veto is not None and (node.rounds.is_voter or veto.filter is not Filter.LINK):
        return veto.why
    reach = {utility.candidate: utility.reachable for utility in vector.utilities}
    is_far = node.rounds.is_voter and not reach.get(target, True)
    return f"{node.me} does not reach it" if is_far else ""


def _on_hold(node: Stages, event: ev.HoldCommanded, todo: ToDo, now: float) -> None:
    """Pause or pin a task, or end that."""
    command = event.command
    refusal = _refused(node, command.task, command.base_revision)
    change = None if refusal is not None else _hold_change(node, command, event.request)
    if isinstance(change, SetHold):
        node.agreement.propose(command.task, change, todo, now)
    else:
        assert refusal is not None or change is not None
        outcome, detail = refusal or change or (CommandOutcome.INVALID, "")
        _answer(node, event.request, command.task, outcome, detail, todo)


def _hold_change(node: Stages, command: HoldTask, request: int) -> SetHold | Refusal:
    """The orders that the task has afterwards, or why not."""
    value = node.registers[command.task].value
    pause, pin, who, revision = value.pause, value.pin, told_by(command.asked), value.revision + 1
    if command.hold is Hold.PAUSE:
        pause, reason = Pause(asked=command.asked, revision=revision, for_s=command.for_s), f"paused by {who}"
    elif command.hold is Hold.RESUME:
        if not value.paused:
            return CommandOutcome.UNCHANGED, "it is not paused"
        pause, reason = None, f"resumed by {who}"
    elif command.hold is Hold.UNPIN:
        if not value.pinned:
            return CommandOutcome.UNCHANGED, "it is not pinned"
        pin, reason = None, f"unpinned by {who}"
    else:
        home = command.node or value.owner
        if home is None:
            return CommandOutcome.INVALID, "it has no owner: name the node to pin it to"
        refusal = _no_place(node, command.task, home)
        if refusal is not None:
            return refusal
        pin = Pin(node=home, asked=command.asked, revision=revision, is_hard=command.is_hard, for_s=command.for_s)
        reason = f"pinned to {home} by {who}"
    return SetHold(
        base_revision=value.revision, pause=pause, pin=pin, reason=reason, asked=command.asked, request=request
    )


def _on_tune(node: Stages, event: ev.TuneCommanded, todo: ToDo, now: float) -> None:
    """Change a task's tuning."""
    command = event.command
    refusal = _refused(node, command.task, command.base_revision)
    if refusal is None:
        refusal = _tuning_refused(node, command)
    if refusal is not None:
        _answer(node, event.request, command.task, *refusal, todo)
        return
    change: Change = Retune(
        base_revision=command.base_revision, tuning=command.tuning, asked=command.asked, request=event.request
    )
    node.agreement.propose(command.task, change, todo, now)


def _tuning_refused(node: Stages, command: TuneTask) -> Refusal | None:
    """Why a tuning is not taken: it is in force, or its signals do not fit the file's."""
    if command.tuning == node.registers[command.task].value.tuning:
        return CommandOutcome.UNCHANGED, _SO_ALREADY
    spec = node.fleet.task(command.task)
    nu, rho = command.tuning.nu_dbm, command.tuning.rho_dbm
    low, high = spec.limits.nu_dbm if nu is None else nu, spec.limits.rho_dbm if rho is None else rho
    if low >= high:
        return CommandOutcome.INVALID, f"nu_dbm ({low:g}) must be below rho_dbm ({high:g})"
    return None


def _refused(node: Stages, task: TaskId, base_revision: int | None) -> Refusal | None:
    """Why an order about this task is not taken, whatever it says."""
    if task not in node.registers:
        return CommandOutcome.INVALID, f"no task {task!r}; tasks: {', '.join(sorted(node.registers))}"
    revision = node.registers[task].value.revision
    if base_revision not in (None, revision):
        return CommandOutcome.CONFLICT, f"revision is {shown(revision)}, not {shown(base_revision)}"
    return None


def _answer(node: Stages, request: int, task: TaskId, outcome: CommandOutcome, detail: str, todo: ToDo) -> None:
    revision = node.registers[task].value.revision if task in node.registers else None
    result = CommandResult(outcome=outcome, detail=detail, revision=revision)
    todo.add(do.AnswerCommand(request=request, result=result))


HANDLERS: Final[Mapping[type[Any], Handler]] = {
    ev.MoveCommanded: _on_move,
    ev.HoldCommanded: _on_hold,
    ev.TuneCommanded: _on_tune,
}
