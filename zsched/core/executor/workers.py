"""EXECUTOR, beside the handover: the states of this node's workers, as supervisor and tokens report them.

Knows: which tasks have a worker here. Does not know: processes, tokens, who owns what.
"""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Set as AbstractSet

from zsched.core.values import events as ev
from zsched.core.values.fleet import Fleet, runs_worker
from zsched.core.values.instructions import RecordStory
from zsched.core.values.model import NodeId, TaskId, as_reason
from zsched.core.values.profile import Profile, Renewal, WorkerState
from zsched.core.values.struct import Struct, field
from zsched.core.values.words import Trouble, told_of_worker

NONE_RESTS: Mapping[TaskId, str] = {}
TROUBLE_S = 60.0
"""Status shows a callback's error for this long after the last one."""


def failed_workers(profile: Profile) -> set[TaskId]:
    """The tasks whose worker on that node has failed for good."""
    return {load.task for load in profile.workers if load.state is WorkerState.FAILED}


def given_away(profile: Profile) -> set[TaskId]:
    """The tasks that the owner gives away, because its worker is to start again (`zsched.core.executor.renewing`)."""
    return {load.task for load in profile.workers if load.renewal is Renewal.LEAVES}


class Workers(Struct):
    """{task: state} of every worker that this node keeps, and {task: (trouble, why)} of those that are not ready."""

    states: dict[TaskId, WorkerState]
    reasons: dict[TaskId, tuple[Trouble, str]] = field(default_factory=dict)
    _errors: dict[TaskId, tuple[str, float]] = field(default_factory=dict)
    """{task: (the newest error of a worker, when it came)}."""
    _mistakes: dict[TaskId, str] = field(default_factory=dict)
    """{task: a mistake of a ready worker that lasts as long as it lives}."""
    _outdated: dict[TaskId, str] = field(default_factory=dict)
    """{task: why a ready worker should be started again}."""

    _leaving: set[TaskId] = field(default_factory=set)
    """The tasks of which this node keeps no worker any more, while the one that it had is at work."""
    _unwatched: set[TaskId] = field(default_factory=set)
    """Those of them whose worker somebody else runs: it goes on, and nobody reports its end."""

    def on_fleet(self, fleet: Fleet, me: NodeId, busy: AbstractSet[TaskId]) -> None:
        """Another fleet is in force: keep the workers of its tasks here.

        Args:
            fleet: it.
            me: this node.
            busy: the tasks whose worker here has not ended its work: it is told of until it has stopped, one that
                somebody else runs until it has ended its work (`let_go`).
        """
        kind = fleet.node(me).kind
        kept = {task.name for task in fleet.tasks if runs_worker(task, me, kind)}
        self._leaving = {task for task in self.states if task not in kept and task in busy}
        self._unwatched = {task.name for task in fleet.tasks if task.name in self._leaving and not task.worker.command}
        for task in [task for task in self.states if task not in kept | self._leaving]:
            self._forget(task)
        for task in sorted(kept - self.states.keys()):
            self.states[task] = WorkerState.STOPPED

    @property
    def has_unwatched(self) -> bool:
        """Whether `let_go` may have something to do."""
        return bool(self._unwatched)

    def let_go(self, busy: AbstractSet[TaskId]) -> None:
        """Tell no more of somebody else's workers that this node keeps no more, where they have ended their work."""
        for task in sorted(self._unwatched - busy):
            self._forget(task)

    def _forget(self, task: TaskId) -> None:
        self._leaving.discard(task)
        self._unwatched.discard(task)
        del self.states[task]
        for told in (self.reasons, self._errors, self._mistakes, self._outdated):
            told.pop(task, None)

    @classmethod
    def of(cls, fleet: Fleet, me: NodeId) -> Workers:
        """Before anything is started or seen."""
        kind = fleet.node(me).kind
        return cls({task.name: WorkerState.STOPPED for task in fleet.tasks if runs_worker(task, me, kind)})

    def on_changed(self, event: ev.WorkerChanged) -> RecordStory | None:
        """Note a worker's new state; ``None`` when nothing changed or the worker is not ours."""
        if event.task not in self.states:
            return None
        if event.state is not WorkerState.READY:
            self._errors.pop(event.task, None)
            self._mistakes.pop(event.task, None)
        if event.state is WorkerState.READY:
            self.reasons.pop(event.task, None)
        elif event.reason:
            self.reasons[event.task] = (event.trouble, as_reason(event.reason))
        is_same, self.states[event.task] = self.states[event.task] is event.state, event.state
        if event.task in self._leaving and event.state is WorkerState.STOPPED:
            self._forget(event.task)
        if is_same:
            return None
        text = f"worker {told_of_worker(event.state, event.trouble, event.reason).removeprefix('is ')}"
        return RecordStory(stage="executor", text=text, task=event.task)

    def on_troubled(self, event: ev.WorkerTroubled, now: float) -> RecordStory | None:
        """A worker that is ready says that its callbacks raise, or that it makes a mistake; or one has begun cold."""
        if event.is_cold and event.task in self.states:
            text = as_reason(event.text)
            self._errors[event.task] = (text, now)
            return RecordStory(stage="executor", text=f"the worker {text}", task=event.task)
        if self.states.get(event.task) is not WorkerState.READY:
            return None
        if not event.count:
            self._mistakes[event.task] = as_reason(event.text)
        else:
            times = "once" if event.count == 1 else f"{event.count} times"
            self._errors[event.task] = (as_reason(f"callback raised {times}: {event.text}"), now)
        return None

    def on_outdated(self, event: ev.WorkerOutdated) -> None:
        """A worker that somebody else started should be started again, or has been."""
        if event.reason and event.task in self.states:
            self._outdated[event.task] = as_reason(event.reason)
        else:
            self._outdated.pop(event.task, None)

    def told(self, now: float, resting: Mapping[TaskId, str] = NONE_RESTS) -> Mapping[TaskId, tuple[Trouble, str]]:
        """{task: why its worker is not ready, or what is wrong with a ready one}.

        ``resting``: {task whose worker may not work: why}; what else is wrong with one is said instead.
        """
        if not resting and not self._errors and not self._outdated and not self._mistakes:
            return self.reasons
        self._errors = {task: one for task, one in self._errors.items() if now - one[1] <= TROUBLE_S}
        outdated = {task: text for task, text in self._outdated.items() if self.states[task] is WorkerState.READY}
        errors = {task: text for task, (text, _) in self._errors.items()}
        told = {**resting, **outdated, **self._mistakes, **errors}
        rests = {task: Trouble.RESTS if task in resting else Trouble.NONE for task in told}
        return {**{task: (rests[task], text) for task, text in told.items()}, **self.reasons}
