"""EXECUTOR, beside the handover: the states of this node's workers, as supervisor and tokens report them.

Knows: which tasks have a worker here. Does not know: processes, tokens, who owns what.
"""

from __future__ import annotations

from dataclasses import dataclass

from zsched.core import events as ev
from zsched.core.fleet import Fleet, OnIsolation, TaskSpec
from zsched.core.instructions import RecordStory
from zsched.core.model import NodeId, NodeKind, Profile, TaskId, WorkerState
from zsched.core.plan import ReadyWhen


def runs_worker(task: TaskSpec, node: NodeId, kind: NodeKind) -> bool:
    """Whether ``node`` keeps a worker of the task: candidates do, and robots that work alone when they are cut off."""
    is_alone = kind is NodeKind.ROBOT and task.on_isolation is OnIsolation.LOCAL
    return node in task.candidates or is_alone


def failed_workers(profile: Profile) -> set[TaskId]:
    """The tasks whose worker on that node has failed for good."""
    return {load.task for load in profile.workers if load.state is WorkerState.FAILED}


@dataclass(slots=True)
class Workers:
    """{task: state} of every worker that this node keeps."""

    states: dict[TaskId, WorkerState]

    @classmethod
    def of(cls, fleet: Fleet, me: NodeId) -> Workers:
        """Before anything is started; a foreign worker that shows itself only by matching counts as ready."""
        states = {}
        for task in fleet.tasks:
            if runs_worker(task, me, fleet.node(me).kind):
                is_foreign = not task.worker.command and task.worker.ready_when is ReadyWhen.MATCHING
                states[task.name] = WorkerState.READY if is_foreign else WorkerState.STOPPED
        return cls(states)

    def on_changed(self, event: ev.WorkerChanged) -> RecordStory | None:
        """Note a worker's new state; ``None`` when it is no news, or no worker of ours."""
        if self.states.get(event.task, event.state) is event.state:
            return None
        self.states[event.task] = event.state
        text = f"worker {event.state}{': ' if event.reason else ''}{event.reason}"
        return RecordStory(stage="executor", text=text, task=event.task)
