"""Rehearsals at the door: what a node does to itself at an operator's wish, and when it refuses.

Knows: the guard rails that the owner of a task can see. Does not know: the order of the steps
(`zsched.tools.rehearsal.programme`), how a daemon ends or a link is cut (`zsched.runtime.strikes`).

A node ends itself, or its links, only for an operator: one at its own operator socket, or, in a secured fleet, one
whose certificate zenoh has let through to the key of commands.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

from zsched.core.node.orders import unfit
from zsched.core.node.stages import Handler, Stages
from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.messages import CommandOutcome, CommandResult
from zsched.core.values.model import Allocation, PeerState, TaskId, told_by
from zsched.core.values.profile import WorkerState
from zsched.core.values.promises import promises
from zsched.core.values.quorum import majority
from zsched.core.values.rehearsal import RehearsalsTold, Step, Strike
from zsched.core.values.todo import ToDo

_ENDS: Final = (Step.DAEMON, Step.LINK)
"""What ends the node itself, for a while or until somebody starts it again."""
_DONE: Final = {
    Step.WORKER: "the worker of {task} here is killed",
    Step.DAEMON: "this daemon is killed",
    Step.LINK: "the links of this node are cut for {cut_s:g} s",
}


def _on_strike(node: Stages, event: ev.StrikeCommanded, todo: ToDo, now: float) -> None:
    """Check the guard rails, tell what comes, and do it."""
    strike = event.command
    refusal = _refusal(node, event, now)
    if refusal:
        _answer(event.request, CommandOutcome.INVALID, refusal, todo)
        return
    if not strike.is_plan:
        text = f"{told_by(strike.asked)} rehearses: {_DONE[strike.step].format(task=strike.task, cut_s=strike.cut_s)}"
        epoch = node.registers[strike.task].value.epoch
        todo.add(do.RecordStory(stage="executor", text=text, task=strike.task, epoch=epoch, by=strike.asked.by))
    if strike.step in _ENDS:
        todo.add(do.StrikeDaemon(request=event.request, strike=strike, fleet=node.fleet))
        return
    if not strike.is_plan:
        node.killed_at[strike.task] = now
        todo.add(do.RestartWorker(task=strike.task, reason=f"killed by {strike.asked.by}, who rehearses"))
    can = "it can be drained" if strike.step is Step.DRAIN else "its worker can be killed"
    _answer(event.request, CommandOutcome.OK, can if strike.is_plan else "it is killed", todo)


def _refusal(node: Stages, event: ev.StrikeCommanded, now: float) -> str:
    """Why this is not done; empty: it may be."""
    strike = event.command
    if strike.task not in node.registers:
        return f"no task {strike.task!r}"
    if node.registers[strike.task].value.owner != node.me:
        return f"{node.me} does not own {strike.task}"
    is_operator = event.is_near or node.fleet.security is not None
    if strike.step in _ENDS and not is_operator:
        return (
            f"this fleet is not secured, so only an operator at {node.me} itself may end its daemon or its links: "
            "run it there, with --connect to another node"
        )
    others = [name for name, state in node.membership.states().items() if state is PeerState.SUSPECT]
    if others:
        return f"{', '.join(sorted(others))} is suspect: one fault at a time"
    if node.is_draining:
        return f"{node.me} drains"
    if strike.step is Step.DRAIN:
        return _flagged(node) or _no_leave(node, now)
    if strike.step in _ENDS:
        return _no_leave(node, now) or _no_end(node)
    return _alone(node, strike.task, now) or _no_kill(node, strike, now)


def _no_leave(node: Stages, now: float) -> str:
    """Why its tasks must not leave this node: each of them needs another place."""
    return next((why for task in node.owned() if (why := _alone(node, task, now))), "")


def _flagged(node: Stages) -> str:
    """The order that an operator has given about this node already."""
    if node.me not in node.flags.closed:
        return ""
    return f"{node.me} {'is ' if node.me in node.flags.drained else ''}{node.flags.closed[node.me]}"


def _no_end(node: Stages) -> str:
    """Why this node must not go: the electors need their majority."""
    electors = node.fleet.electors
    alive = [name for name in electors if name != node.me and node.membership.state(name) is PeerState.ALIVE]
    if node.me in electors and len(alive) < majority(len(electors)):
        return f"{node.me} is an elector, and the {len(alive)} others that are alive are no majority of {len(electors)}"
    return ""


def _alone(node: Stages, task: TaskId, now: float) -> str:
    """Why nobody else could do the task; empty: somebody could."""
    value: Allocation = node.registers[task].value
    if value.paused:
        return f"{task} is paused: a dead owner is not replaced; `zsched resume {task}` first"
    if value.is_bound:
        return f"{task} is pinned to {value.home} (hard): nobody else may have it"
    whys = {name: unfit(node, value, name, now) for name in node.fleet.task(task).candidates if name != node.me}
    if all(whys.values()):
        told = "; ".join(f"{name}: {why}" for name, why in whys.items()) or "it has no other candidate"
        return f"no other candidate is fit for {task}: {told}"
    return ""


def _no_kill(node: Stages, strike: Strike, now: float) -> str:
    worker = node.fleet.task(strike.task).worker
    if not worker.command:
        return "somebody else starts the worker (the task has no `command`), and might not start it again"
    if node.worker_states.get(strike.task) is not WorkerState.READY:
        return "its worker is not ready"
    killed_s = now - node.killed_at.get(strike.task, -math.inf)
    if killed_s < worker.failure_window_s:
        return (
            f"its worker was killed {killed_s:.0f} s ago: {worker.max_failures} failures within "
            f"{worker.failure_window_s:g} s would make this node ineligible"
        )
    return ""


def _on_kept(node: Stages, event: ev.RehearsalKept, todo: ToDo, _now: float) -> None:
    """Keep what was found, and tell it in the history."""
    command = event.command
    if command.task not in node.registers:
        _answer(event.request, CommandOutcome.INVALID, f"no task {command.task!r}", todo)
        return
    epoch = node.registers[command.task].value.epoch
    text = f"rehearsed by {told_by(command.asked)}: {command.told}"
    todo.add(
        do.RecordStory(stage="executor", text=text, task=command.task, epoch=epoch, rehearsal=command.name),
        do.StoreRehearsal(request=event.request, rehearsal=command),
    )


def _on_asked(node: Stages, event: ev.RehearsalsAsked, todo: ToDo, _now: float) -> None:
    command = event.command
    if command.task and command.task not in node.registers:
        detail = f"no task {command.task!r}; there are {', '.join(sorted(node.registers)) or 'none'}"
        _answer(event.request, CommandOutcome.INVALID, detail, todo)
        return
    promised = promises(node.fleet, node.fleet.task(command.task)) if command.task else ()
    told = RehearsalsTold(node=node.me, timing=node.fleet.timing.name, promised=promised)
    todo.add(do.AnswerRehearsals(request=event.request, told=told, name=command.name))


def _answer(request: int, outcome: CommandOutcome, detail: str, todo: ToDo) -> None:
    todo.add(do.AnswerCommand(request=request, result=CommandResult(outcome=outcome, detail=detail)))


HANDLERS: Final[Mapping[type[Any], Handler]] = {
    ev.StrikeCommanded: _on_strike,
    ev.RehearsalKept: _on_kept,
    ev.RehearsalsAsked: _on_asked,
}
