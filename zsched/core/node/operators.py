"""Operators at the door: status, explanations, workers to restart, and the order to stop.

Knows: which stage each command concerns. Does not know: how the status is put together (`zsched.core.node.status`), how
a change is agreed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from zsched.core.node.stages import Handler, Stages
from zsched.core.node.status import build_explanation, build_snapshot
from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.messages import CommandOutcome, CommandResult
from zsched.core.values.model import Asked, TaskId, told_by
from zsched.core.values.profile import WorkerState
from zsched.core.values.todo import ToDo


def _on_status(node: Stages, event: ev.StatusAsked, todo: ToDo, now: float) -> None:
    todo.add(do.AnswerStatus(request=event.request, snapshot=build_snapshot(node, now)))


def _record(node: Stages, task: TaskId, asked: Asked | None, what: str, todo: ToDo) -> None:
    """Tell the history who has ordered it, and why."""
    who = "an operator" if asked is None else told_by(asked)
    epoch, by = node.executors[task].epoch, "" if asked is None else asked.by
    todo.add(do.RecordStory(stage="executor", text=f"{who} {what}", task=task, epoch=epoch, by=by))


def _on_explanation(node: Stages, event: ev.ExplanationAsked, todo: ToDo, now: float) -> None:
    task = event.command.task
    if task not in node.executors:
        detail = f"no task {task!r}; there are {', '.join(node.executors) or 'none'}"
        result = CommandResult(outcome=CommandOutcome.INVALID, detail=detail)
        todo.add(do.AnswerCommand(request=event.request, result=result))
    else:
        todo.add(do.AnswerExplanation(request=event.request, explanation=build_explanation(node, task, now)))


def _on_restart(node: Stages, event: ev.RestartCommanded, todo: ToDo, now: float) -> None:
    """Stop and start our own worker, where one of ours runs or has failed; that is mended, whatever it was."""
    task = event.command.task
    state = node.worker_states.get(task)
    refusal = _why_no_restart(node, task, state)
    outcome, detail = CommandOutcome.INVALID, refusal
    if not refusal:
        _record(node, task, event.command.asked, "has its worker here started again", todo)
        if state is WorkerState.FAILED:
            node.rounds.forgive(task, node.me, now)
        todo.add(do.RenewWorker(task=task))
        outcome, detail = CommandOutcome.OK, f"its worker is started again, it was {state}"
    todo.add(do.AnswerCommand(request=event.request, result=CommandResult(outcome=outcome, detail=detail)))


def _why_no_restart(node: Stages, task: TaskId, state: WorkerState | None) -> str:
    if task not in node.executors:
        return f"no task {task!r}"
    if state is None:
        return f"{node.me} has no worker of {task}"
    if not node.fleet.task(task).worker.command:
        return "somebody else starts it (the task has no `command`): start it again there"
    return "its worker does not run" if state is WorkerState.STOPPED else ""


def _on_lines(_node: Stages, event: ev.LinesAsked, todo: ToDo, _now: float) -> None:
    todo.add(do.AnswerLines(request=event.request, task=event.command.task, after=event.command.after))


def _on_history(_node: Stages, event: ev.HistoryAsked, todo: ToDo, _now: float) -> None:
    todo.add(do.AnswerHistory(request=event.request, cursor=event.command.cursor))


def _on_certificate(_node: Stages, event: ev.CertificateSent, todo: ToDo, _now: float) -> None:
    todo.add(do.TakeCertificate(request=event.request, certificate=event.command.certificate))


def _on_dropped(node: Stages, event: ev.FrameDropped, _todo: ToDo, now: float) -> None:
    name = f"dropped_{event.kind}_{event.reason}"
    node.counters[name] += event.count
    node.dropped_at[name] = now


def _on_link_refused(node: Stages, event: ev.LinkRefused, _todo: ToDo, now: float) -> None:
    node.refused_keys.on_refused(event.key, now)


def _on_commanded(node: Stages, event: ev.Commanded, todo: ToDo, _now: float) -> None:
    """Tell who has given a command, whatever becomes of it."""
    executor = node.executors.get(event.task)
    epoch = 0 if executor is None else executor.epoch
    text = f"{event.what} came, signed by {event.by}"
    todo.add(do.RecordStory(stage="vote", text=text, task=event.task, epoch=epoch))


def _on_problem(node: Stages, event: ev.ProblemReported, _todo: ToDo, _now: float) -> None:
    kind, _, subject = event.source.partition("/")
    node.set_problem(kind, event.problem, subject)


def _on_stop(node: Stages, _event: ev.StopRequested, todo: ToDo, _now: float) -> None:
    """Drain: the profile says so, and the robots move what this node owns."""
    node.is_draining = True
    todo.must_decide |= bool(node.owned())


HANDLERS: Final[Mapping[type[Any], Handler]] = {
    ev.StatusAsked: _on_status,
    ev.ExplanationAsked: _on_explanation,
    ev.RestartCommanded: _on_restart,
    ev.LinesAsked: _on_lines,
    ev.HistoryAsked: _on_history,
    ev.CertificateSent: _on_certificate,
    ev.FrameDropped: _on_dropped,
    ev.LinkRefused: _on_link_refused,
    ev.Commanded: _on_commanded,
    ev.ProblemReported: _on_problem,
    ev.StopRequested: _on_stop,
}
