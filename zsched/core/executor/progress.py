"""EXECUTOR, beside the handover: finds workers that hang although inputs flow (`output_deadline_s`).

Knows: the counters of every robot's relay, when a worker was last given time. Does not know: processes, streams, zenoh.

Inputs and outputs pass through the robots' relays, never through the owner's. They look the same for a worker with our
library and for any other zenoh program. So each robot reports in its profile whether a task answers it (`Progress`),
and the owner's daemon combines these reports (`HangJudge`).

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

from zsched.core.executor.handover import Executor, Phase
from zsched.core.executor.rhythm import Rhythms
from zsched.core.gateway.gateway import Gateway
from zsched.core.instructions import RecordStory, RestartWorker
from zsched.core.scheduler.probation import LIMIT_S
from zsched.core.todo import ToDo
from zsched.core.values.fleet import Fleet, TaskSpec
from zsched.core.values.model import NodeId, TaskId
from zsched.core.values.plan import Direction, StreamCount
from zsched.core.values.profile import Profile, TaskProgress, WorkerState
from zsched.core.values.struct import Struct

COUNT_S = 1.0
"""Period of the relays' counters, so a report is at most this old."""
MARGIN_S = 1.5
"""A complaint may be this much older than the answer that ends it: `COUNT_S` and a profile's way."""
_INPUTS, _OUTPUTS = "in", "out"
"""The directions in stream names (`zsched.core.route.route`)."""


class _Seen(Struct):
    """What one robot has seen of one task."""

    epoch: int
    taken: int
    given: int
    taken_at: float | None = None
    """When an input last went to the owner; ``None``: not in this epoch."""
    given_at: float | None = None
    waits_since: float | None = None
    """When the first input behind the newest output was seen; ``None`` while nothing waits."""


class Progress:
    """A robot's view: does the owner's worker return anything for its inputs?"""

    def __init__(self, specs: Iterable[TaskSpec]) -> None:
        self._seen: dict[TaskId, _Seen] = {}
        self.adopt(tuple(specs))

    def adopt(self, specs: tuple[TaskSpec, ...]) -> None:
        """Watch these tasks from now on; what was seen of the others is forgotten."""
        self._deadlines = {spec.name: spec.worker.output_deadline_s for spec in specs}
        self._has_outputs = {
            spec.name: any(rule.direction is Direction.OUTPUT for rule in spec.rules) for spec in specs
        }
        self._seen = {task: seen for task, seen in self._seen.items() if task in self._deadlines}

    def absorb(self, counts: tuple[StreamCount, ...], executors: Mapping[TaskId, Executor], now: float) -> None:
        """Take the relay's counters in."""
        for task, deadline_s in self._deadlines.items():
            executor = executors[task]
            if deadline_s is None or not executor.has_streams:
                continue
            if executor.phase is not Phase.SETTLED or executor.is_local:
                self._seen.pop(task, None)  # during a handover nobody owes anything
                continue
            self._note(task, executor.epoch, counts, now)

    def _note(self, task: TaskId, epoch: int, counts: tuple[StreamCount, ...], now: float) -> None:
        taken, given = self._sums(task, counts)
        seen = self._seen.get(task)
        is_new = seen is None or seen.epoch != epoch or taken < seen.taken or given < seen.given
        if seen is None or is_new:
            self._seen[task] = _Seen(epoch=epoch, taken=taken, given=given)
            return
        if given > seen.given:
            seen.given_at, seen.waits_since = now, None
        if taken > seen.taken:
            seen.taken_at = now
            if given == seen.given and seen.waits_since is None:
                seen.waits_since = now
        seen.taken, seen.given = taken, given

    def _sums(self, task: TaskId, counts: tuple[StreamCount, ...]) -> tuple[int, int]:
        """(inputs, outputs) so far; a task without outputs counts its worker's acknowledgements, if there are any."""
        inputs = [count for count in counts if count.stream.startswith(f"{task}/{_INPUTS}/")]
        outputs = [count for count in counts if count.stream.startswith(f"{task}/{_OUTPUTS}/")]
        taken = sum(count.messages for count in inputs)
        if self._has_outputs[task]:
            return taken, sum(count.messages for count in outputs)
        if any(count.acknowledged is None for count in inputs):
            return 0, 0  # nobody can tell
        return taken, sum(count.acknowledged or 0 for count in inputs)

    def begin_again(self, task: TaskId, now: float) -> None:
        """Start the wait of every open input again, now."""
        seen = self._seen.get(task)
        if seen is not None and seen.waits_since is not None:
            seen.waits_since = now

    def on_new_life(self, task: TaskId) -> None:
        """The owner's worker is back: what the one before owed is not this one's."""
        seen = self._seen.get(task)
        if seen is not None:
            seen.waits_since = None  # the next counters tell whether it owes something

    def reports(self, now: float) -> tuple[TaskProgress, ...]:
        """This robot's reports: served, or waiting for longer than the deadline while inputs flow."""
        found = []
        for task, seen in sorted(self._seen.items()):
            limit_s = max(self._deadlines[task] or 0.0, 2 * COUNT_S)
            if seen.waits_since is None:
                if seen.given_at is not None and now - seen.given_at <= limit_s:
                    found.append(TaskProgress(task=task, epoch=seen.epoch, is_served=True))
                continue
            is_flowing = seen.taken_at is not None and now - seen.taken_at <= limit_s
            if is_flowing and now - seen.waits_since >= (self._deadlines[task] or 0.0):
                found.append(TaskProgress(task=task, epoch=seen.epoch, is_served=False))
        return tuple(found)


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
    """Both views of one node, over all tasks that say `output_deadline_s`, and the rhythm of all others."""

    def __init__(self, fleet: Fleet) -> None:
        self._progress = Progress(())
        self.rhythms = Rhythms()
        self._judge = HangJudge()
        self._back_at: dict[NodeId, float] = {}
        """{robot: when it was heard again after a silence}."""
        self._specs: dict[TaskId, TaskSpec] = {}
        self.adopt(fleet, {}, 0.0)

    def adopt(self, fleet: Fleet, workers: Mapping[TaskId, WorkerState], now: float) -> None:
        """Take the tasks with a deadline and the robots from ``fleet``.

        Args:
            fleet: the fleet file.
            workers: {task: state} of the workers here; a ready one that was not watched gets its whole time from now.
            now: monotonic seconds.
        """
        known = self._specs
        self._specs = {spec.name: spec for spec in fleet.tasks if spec.worker.output_deadline_s is not None}
        self._voters = fleet.voters
        self._progress.adopt(tuple(self._specs.values()))
        self.rhythms.adopt(fleet.tasks)
        for task in [task for task in known if task not in self._specs]:
            self._judge.note_worker(task, WorkerState.STOPPED, now)
        for task in [task for task in self._specs if task not in known and task in workers]:
            self._judge.note_worker(task, workers[task], now)
        self._back_at = {robot: at for robot, at in self._back_at.items() if robot in self._voters}

    def absorb(self, counts: tuple[StreamCount, ...], executors: Mapping[TaskId, Executor], now: float) -> None:
        """Our relay has counted."""
        self.rhythms.absorb(counts, executors, now)
        if self._specs:
            self._progress.absorb(counts, executors, now)

    def note_worker(self, task: TaskId, state: WorkerState, now: float) -> None:
        """A worker of this node has changed."""
        if task in self._specs:
            self._judge.note_worker(task, state, now)

    def on_ready_again(self, task: TaskId) -> None:
        """Our relay lacked the owner's worker, and has it again."""
        self._progress.on_new_life(task)

    def note_lag(self, lag_s: float, now: float) -> None:
        """This node stood still for this many seconds; a pause of half a deadline or more starts all waits again."""
        if lag_s >= COUNT_S / 2:
            self.rhythms.begin_again()
        for task, spec in self._specs.items():
            if lag_s >= max(spec.worker.output_deadline_s or 0.0, COUNT_S) / 2:
                self._progress.begin_again(task, now)
                self._judge.begin_again(task, now)

    def on_back(self, node: NodeId, now: float) -> None:
        """A peer that was suspect or gone is heard again."""
        if self._specs and node in self._voters:
            self._back_at[node] = now

    def _unproven(self, spec: TaskSpec, now: float) -> frozenset[NodeId]:
        excused_s = LIMIT_S + (spec.worker.output_deadline_s or 0.0) + MARGIN_S
        return frozenset(node for node, at in self._back_at.items() if now < at + excused_s)

    def reports(self, now: float) -> tuple[TaskProgress, ...]:
        """The reports for our profile."""
        return self._progress.reports(now)

    def look(
        self,
        owned: Iterable[TaskId],
        executors: Mapping[TaskId, Executor],
        gateway: Gateway,
        todo: ToDo,
        now: float,
    ) -> None:
        """A robot's profile came: restart our workers that hang; of a foreign worker only report it."""
        for spec in [self._specs[task] for task in owned if task in self._specs]:
            profiles = [profile for robot in self._voters if (profile := gateway.fresh(robot, now)) is not None]
            reason = self._judge.hangs(spec, executors[spec.name], profiles, now, self._unproven(spec, now))
            if not reason:
                continue
            if spec.worker.command:
                todo.add(RestartWorker(task=spec.name, reason=reason))
            else:
                reason += "; it is not ours to restart"
            text = f"worker hangs: {reason}"
            todo.add(RecordStory(stage="executor", text=text, task=spec.name, epoch=executors[spec.name].epoch))
