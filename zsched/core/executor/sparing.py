"""Whether a node may be away for a while without a task lacking an owner: its daemon begins anew, say.

Knows: which other candidates live, and what their profiles say of their workers. Does not know: why the node wants to
go, how long it waits (`zsched.runtime.reopening`), who gets the task (SCHEDULER).
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping
from enum import StrEnum

from zsched.core.scheduler.eligibility import may_get
from zsched.core.values.fleet import TaskSpec
from zsched.core.values.model import Allocation, NodeId, TaskId
from zsched.core.values.profile import Profile, WorkerState
from zsched.core.values.struct import Struct


class Sparing(StrEnum):
    """How long it is worth to wait for somebody who could have a task."""

    FREE = "free"  # somebody could have it now, or nobody but this node ever can
    AWAY = "away"  # those who could have it are away: perhaps they come back
    STARTING = "starting"  # somebody who could have it lives, and will be ready


class Lack(Struct, frozen=True, kw_only=True):
    """A task that would have no owner for a while."""

    task: TaskId
    sparing: Sparing
    why: str
    """For the status."""


def lacking(
    specs: Iterable[TaskSpec],
    values: Mapping[TaskId, Allocation],
    me: NodeId,
    others: Mapping[NodeId, Profile | None],
    closed: Container[NodeId] = (),
) -> tuple[Lack, ...]:
    """The tasks that would have no owner if ``me`` went now, though not if it waited.

    Args:
        specs: the tasks of the fleet.
        values: {task: its allocation}.
        me: the node that wants to go.
        others: {other node that lives: its fresh profile of its present life; ``None``: none has come}.
        closed: nodes that may take no task.
    """
    found, able = [], {name: profile for name, profile in others.items() if name not in closed}
    for spec in specs:
        owner = values[spec.name].owner
        if owner == me:
            sparing, why = _of_own(spec, me, able)
        elif owner is not None and me in spec.candidates:
            sparing, why = _of_other(owner, others)
        else:
            continue
        if sparing is not Sparing.FREE:
            found.append(Lack(task=spec.name, sparing=sparing, why=why))
    return tuple(found)


def _of_own(spec: TaskSpec, me: NodeId, others: Mapping[NodeId, Profile | None]) -> tuple[Sparing, str]:
    names = [name for name in spec.candidates if name != me]
    living = {name: others[name] for name in names if name in others}
    states = {name: _state(spec, one) for name, one in living.items() if one is None or not one.draining}
    if not names or any(may_get(spec, state) for state in states.values()):
        return Sparing.FREE, ""
    awaited = sorted(name for name, state in states.items() if _will_be_ready(spec, state))
    if awaited:
        return Sparing.STARTING, f"no worker but ours is ready; {awaited[0]}'s is {states[awaited[0]] or 'not known'}"
    missing = [name for name in names if name not in states]
    return (Sparing.AWAY, f"{missing[0]} cannot have it now") if missing else (Sparing.FREE, "")


def _of_other(owner: NodeId, others: Mapping[NodeId, Profile | None]) -> tuple[Sparing, str]:
    """This node may be who gets the task of an owner that goes."""
    if owner not in others:
        return Sparing.AWAY, f"{owner} owns it and is not heard"
    profile = others[owner]
    is_going = profile is not None and profile.draining
    return (Sparing.STARTING, f"{owner} gives it away") if is_going else (Sparing.FREE, "")


def _state(spec: TaskSpec, profile: Profile | None) -> WorkerState | None:
    load = None if profile is None else profile.worker(spec.name)
    return None if load is None else load.state


def _will_be_ready(spec: TaskSpec, state: WorkerState | None) -> bool:
    """Whether it starts by itself; a profile before the first one that names the worker says nothing yet."""
    return bool(spec.worker.command) and state is not WorkerState.FAILED
