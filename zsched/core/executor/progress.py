"""EXECUTOR, beside the handover: finds workers that hang although inputs flow (`output_deadline_s`).

Knows: the counters of every robot's relay, when a worker was last given time. Does not know: processes, streams, zenoh.

Inputs and outputs pass through the robots' relays, never through the owner's. They look the same for a worker with our
library and for any other zenoh program. So each robot reports in its profile whether a task answers it
(`zsched.core.executor.rhythm`), and the owner's daemon combines these reports (`HangJudge`).

A robot that sees the worker come back (it was restarted in place) forgets how long it has waited for the life before:
on a busy machine that complaint would reach the owner behind the new life's first answers, and end that, too.

A robot that was out of reach and is back has waited for a link, not for the worker. Its complaints count again after
links have had time to heal (`zsched.core.scheduler.probation`) and the worker has had time to answer.

A node that stood still (suspended machine, stopped daemon) starts all waits again, as a robot and as an owner: its
clock went on while neither it nor its worker could run.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from collections.abc import Set as AbstractSet

from zsched.core.executor.handover import Executor
from zsched.core.executor.rhythm import COUNT_S, Progress
from zsched.core.gateway.gateway import Gateway
from zsched.core.scheduler.probation import LIMIT_S
from zsched.core.values.fleet import TaskSpec
from zsched.core.values.in_force import InForce
from zsched.core.values.instructions import RecordStory, RestartWorker
from zsched.core.values.model import NodeId, TaskId
from zsched.core.values.plan import StreamCount
from zsched.core.values.profile import Profile, TaskProgress, WorkerState
from zsched.core.values.todo import ToDo

MARGIN_S = 1.5
"""A complaint may be this much older than the answer that ends it: `COUNT_S` and a profile's way."""


class HangJudge:
    """The owner's view: does a worker here hang? One robot that is served speaks for the worker."""

    def __init__(self) -> None:
        self._given_time_at: dict[TaskId, float] = {}
        """Since when a worker owes an answer: it became ready, or was ended by us."""

    def note_worker(self, task: TaskId, state: WorkerState, now: float) -> None:
        """A worker's state has changed; one that only lost its token still owes an answer."""
        if state is WorkerState.READY:
            self._given_time_at[task] = now
        elif state is not WorkerState.STARTING:
            self._given_time_at.pop(task, None)

    def begin_again(self, task: TaskId, now: float) -> None:
        """A worker that owes an answer gets its whole time again."""
        if task in self._given_time_at:
            self._given_time_at[task] = now

    def hangs(
        self,
        spec: TaskSpec,
        executor: Executor,
        profiles: Iterable[Profile],
        now: float,
        unproven: AbstractSet[NodeId] = frozenset(),
    ) -> str:
        """Why this node's worker counts as hung; empty when it does not.

        Args:
            spec: the task, owned by this node.
            executor: carries it out here.
            profiles: fresh profiles of the robots.
            now: monotonic seconds.
            unproven: robots whose complaints may come from their links. A report of being served counts all the same.
        """
        deadline_s = spec.worker.output_deadline_s
        ready_at = self._given_time_at.get(spec.name)
        if deadline_s is None or ready_at is None:
            return ""
        if now < max(ready_at, executor.started_at) + deadline_s + MARGIN_S:
            return ""
        said = [
            one.is_served
            for profile in profiles
            for one in profile.progress
            if (one.task, one.epoch) == (spec.name, executor.epoch) and (one.is_served or profile.node not in unproven)
        ]
        if not said or any(said):
            return ""
        del self._given_time_at[spec.name]  # one complaint ends one life
        return f"no output for {deadline_s:g} s while inputs flow"


class HangWatch:
    """Both views of one node: as an owner of the tasks that say `output_deadline_s`, as a robot of all."""

    def __init__(self, in_force: InForce) -> None:
        self._in_force = in_force
        self.progress = Progress(in_force)
        self._judge = HangJudge()
        self._back_at: dict[NodeId, float] = in_force.by_node()
        """{robot: when it was heard again after a silence}."""

    def _has_deadline(self, task: TaskId) -> bool:
        return self._in_force.tasks[task].worker.output_deadline_s is not None

    def absorb(self, counts: tuple[StreamCount, ...], executors: Mapping[TaskId, Executor], now: float) -> None:
        """Our relay has counted."""
        self.progress.absorb(counts, executors, now)

    def note_worker(self, task: TaskId, state: WorkerState, now: float) -> None:
        """A worker of this node has changed."""
        self._judge.note_worker(task, state, now)

    def on_ready_again(self, task: TaskId) -> None:
        """Our relay lacked the owner's worker, and has it again: maybe another one, which is not to be ended for it."""
        if self._has_deadline(task):
            self.progress.begin_again(task)

    def excuse(self, task: TaskId) -> None:
        """The owner's worker is away or another one, or the way to it was: by its rhythm it owes nothing so far."""
        if not self._has_deadline(task):
            self.progress.begin_again(task)

    def note_lag(self, lag_s: float, now: float) -> None:
        """This node stood still for this many seconds; a pause of half a deadline or more starts all waits again."""
        for spec in self._in_force.fleet.tasks:
            if lag_s >= max(spec.worker.output_deadline_s or 0.0, COUNT_S) / 2:
                self.progress.begin_again(spec.name, now)
                self._judge.begin_again(spec.name, now)

    def on_back(self, node: NodeId, now: float) -> None:
        """A peer that was suspect or gone is heard again."""
        if node in self._in_force.robots:
            self._back_at[node] = now

    def _unproven(self, spec: TaskSpec, now: float) -> frozenset[NodeId]:
        excused_s = LIMIT_S + (spec.worker.output_deadline_s or 0.0) + MARGIN_S
        return frozenset(node for node, at in self._back_at.items() if now < at + excused_s)

    def reports(self, now: float) -> tuple[TaskProgress, ...]:
        """The reports for our profile."""
        return self.progress.reports(now)

    def look(
        self,
        owned: Iterable[TaskId],
        executors: Mapping[TaskId, Executor],
        gateway: Gateway,
        todo: ToDo,
        now: float,
    ) -> None:
        """A robot's profile came: restart our workers that hang; of a foreign worker only report it."""
        for spec in [self._in_force.tasks[task] for task in owned if self._has_deadline(task)]:
            profiles = [
                profile for robot in self._in_force.robots if (profile := gateway.fresh(robot, now)) is not None
            ]
            reason = self._judge.hangs(spec, executors[spec.name], profiles, now, self._unproven(spec, now))
            if not reason:
                continue
            if spec.worker.command:
                todo.add(RestartWorker(task=spec.name, reason=reason))
            else:
                reason += "; it is not ours to restart"
            text = f"worker hangs: {reason}"
            todo.add(RecordStory(stage="executor", text=text, task=spec.name, epoch=executors[spec.name].epoch))
