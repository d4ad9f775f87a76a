"""A changed worker that waits for a look: which candidates run it first, and what a plan says of that.

Knows: which worker goes first, what can wait and what cannot. Does not know: how a change is agreed
(`zsched.commands.act.apply`), how a node runs the worker of before (`zsched.core.values.fleet.TaskSpec.worker_on`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from zsched.commands.base.common import CliError, Json
from zsched.config.difference import Change, Effect, difference
from zsched.config.drivers import DRIVER_KEYS
from zsched.core.values.exits import EXIT_FAILED, EXIT_USAGE
from zsched.core.values.fleet import Fleet, TaskSpec, WorkerSpec
from zsched.core.values.model import MAX_REASON, NodeId
from zsched.core.values.struct import Struct, replace

HELD = tuple(f"worker.{key}" for key in ("command", "env", *DRIVER_KEYS))
"""What of a task may wait: the keys of its worker's process that no other goes by; a driver's make a command."""


class Wave(Struct, frozen=True, kw_only=True):
    """A change of the document whose workers are to wait."""

    old: Fleet
    new: Fleet
    texts: tuple[str, str]
    """Of the two."""
    status: Json
    electors: tuple[NodeId, ...]
    """That are agreed."""
    revision: int
    """The fleet's, which the change makes."""


def kept_rollouts(rollouts: Sequence[Json], fleet: Fleet) -> tuple[Json, ...]:
    """Those that wait on by another document: their task is in it, with another worker than the one of before."""
    tasks = {task.name: task for task in fleet.tasks}
    return tuple(one for one in rollouts if one["task"] in tasks and _said(one) != _held(tasks[one["task"]].worker))


def _said(rollout: Json) -> tuple[tuple[str, ...], tuple[tuple[str, ...], ...]]:
    return tuple(rollout["command"]), tuple(tuple(pair) for pair in rollout.get("env", ()))


def _held(worker: WorkerSpec) -> tuple[tuple[str, ...], tuple[tuple[str, ...], ...]]:
    return worker.command, worker.env


def begun(wave: Wave, count: int, kept: Sequence[Json], *, by: str, reason: str) -> tuple[Json, ...]:
    """The rollouts that begin: of each task with another command or environment the first ``count`` candidates go on.

    Args:
        wave: what changes.
        count: how many candidates of each task; at least 1.
        kept: rollouts that wait already; a worker that changes once more goes on to wait with its own first ones.
        by: the operator, user@node.
        reason: why.

    Raises:
        CliError: nothing could wait, or something else of the change restarts workers.
    """
    before = {task.name: task for task in wave.old.tasks}
    changed = [
        task for task in wave.new.tasks if task.name in before and _held(before[task.name].worker) != _held(task.worker)
    ]
    if not changed:
        raise CliError(EXIT_USAGE, "--pause-after: no command or environment of a worker changes here; leave it out")
    _check_only_these(wave, before, changed)
    waiting = {str(one["task"]) for one in kept}
    return tuple(
        {
            "task": task.name,
            "first": sorted(_first(wave, task, count)),
            "command": list(before[task.name].worker.command),
            "env": [list(pair) for pair in before[task.name].worker.env],
            "reason": reason,
            "by": by[:MAX_REASON],
            "revision": wave.revision,
        }
        for task in changed
        if task.name not in waiting
    )


def _check_only_these(wave: Wave, before: dict[str, TaskSpec], changed: Sequence[TaskSpec]) -> None:
    """Refuse what would restart the workers that are to wait.

    Raises:
        CliError: as said.
    """
    for task in changed:
        if not task.worker.command or not before[task.name].worker.command:
            raise CliError(EXIT_FAILED, f"--pause-after: zsched starts the workers of {task.name} before or after only")
    names = {task.name for task in changed}
    held = tuple(
        replace(
            task, worker=replace(task.worker, command=before[task.name].worker.command, env=_env(before[task.name]))
        )
        if task.name in names
        else task
        for task in wave.new.tasks
    )
    changes = difference(wave.old, replace(wave.new, tasks=held), wave.texts, electors=wave.electors)
    others = [one.path for one in changes if one.effect is Effect.WORKERS]
    if others:
        advice = f"apply {'it' if len(others) == 1 else 'them'} apart, before or after"
        raise CliError(EXIT_FAILED, f"--pause-after: {', '.join(others)} would restart all workers at once; {advice}")


def _env(task: TaskSpec) -> tuple[tuple[str, str], ...]:
    return task.worker.env


def _first(wave: Wave, task: TaskSpec, count: int) -> list[NodeId]:
    """The candidates that go first: those that could get the task now, by name, its owner last.

    Raises:
        CliError: nobody is there to go first, or nobody would be left to wait.
    """
    nodes = {str(node["name"]): node for node in wave.status["nodes"]}
    owner = next((one["owner"] for one in wave.status["tasks"] if one["name"] == task.name), None)
    able = [name for name in task.candidates if name in nodes and _is_able(nodes[name])]
    first = sorted(able, key=lambda name: (name == owner, name))[:count]
    if not first:
        raise CliError(EXIT_FAILED, f"--pause-after: no candidate of {task.name} is alive to go first")
    if set(first) >= set(task.candidates):
        number = len(task.candidates)
        told = "1 candidate" if number == 1 else f"{number} candidates"
        raise CliError(EXIT_USAGE, f"--pause-after {count}: {task.name} has {told}: nobody would be left to wait")
    return first


def _is_able(node: Json) -> bool:
    return node["state"] == "alive" and not node.get("draining") and not node.get("flags")


def told_in(change: Change, rollouts: Sequence[Json]) -> Change:
    """The change with what its rollout means for it."""
    for one in rollouts:
        places = [f"tasks.{one['task']}.{key}" for key in HELD]
        if change.effect is Effect.WORKERS and any(change.path.startswith(place) for place in places):
            text = f"{' and '.join(one['first'])} first; the others wait for `zsched task promote {one['task']}`"
            return replace(change, consequence=text, danger=None)
    return change


def promoted(rollouts: Sequence[Json], names: Sequence[str], fleet: Fleet) -> Iterator[Change]:
    """What follows when these tasks wait no more."""
    for one in rollouts:
        if one["task"] in names:
            others = [name for name in fleet.task(str(one["task"])).candidates if name not in one["first"]]
            yield Change(
                path=f"tasks.{one['task']}.worker",
                before=f"on {', '.join(one['first'])}",
                after="everywhere",
                effect=Effect.WORKERS,
                consequence=f"workers of {one['task']} restart one after another: {', '.join(others)}, the owner last",
            )
