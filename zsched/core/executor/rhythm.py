"""EXECUTOR, beside the handover: whether an owner has ceased to answer one robot, by the task's own rhythm.

Knows: the counters of this robot's relay. Does not know: what a worker is, why it does not answer, who is better.

A worker may hang, and a way may carry beats and let nothing large through: either way inputs flow and answers end. The
library acknowledges each input, so there the oldest one under way tells; of any other program the outputs do. A task
that has hardly answered yet, or has no outputs, is never judged. To a robot an owner that has ceased to answer is one
that its streams do not reach (docs/decisions/0114).

Where the file says how soon a task answers (`output_deadline_s`) that counts in place of its rhythm, and is reported to
the owner (`zsched.core.executor.progress`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final

from zsched.core.executor.handover import Executor, Phase
from zsched.core.values.absence import FORGIVEN_RATIO
from zsched.core.values.fleet import TaskSpec
from zsched.core.values.in_force import InForce
from zsched.core.values.model import TaskId
from zsched.core.values.plan import Direction, StreamCount
from zsched.core.values.profile import TaskProgress
from zsched.core.values.struct import Struct

COUNT_S: Final = 1.0
"""Period of the relays' counters, so a report is at most this old."""
LEAST_S: Final = 3.0
"""However quickly a task answers, it may be silent for so long..."""
HUNG_TIMES: Final = 16.0
"""...and for so many times as long as its answers come apart on the mean."""
ENOUGH: Final = 8
"""So many outputs tell how a program answers that acknowledges nothing."""


class Rhythm(Struct):
    """How one robot is answered, whoever has the task: all of its outputs, or one input's acknowledgements."""

    taken: int = 0
    given: int = 0
    at: float | None = None
    """When these were counted; ``None``: the next count is a first one."""
    answers: int = 0
    flowed_s: float = 0.0
    """For how long inputs or answers flowed while so many answers came."""
    taken_at: float = 0.0
    given_at: float | None = None
    """When an answer of this owner was counted last."""
    waits_since: float | None = None
    """When an input that has no answer yet was seen; ``None``: none waits."""
    is_acknowledged: bool = False
    mark: int = 0
    """Of acknowledged inputs: once so many are done, that one has its answer."""
    longest_s: float = 0.0
    """The longest wait that an output has ended, whoever owned the task: it answers now and then."""
    fled_s: float = 0.0
    """How long an owner was waited for that was left then: if the next one does no better, the fault is elsewhere."""

    def count(self, taken: int, given: int, in_flight: int | None, now: float) -> None:
        """The relay has counted; ``in_flight``: inputs that are not acknowledged, where the worker does that."""
        before, at = (self.taken, self.given), self.at
        self.taken, self.given, self.at = taken, given, now
        if at is None or taken < before[0] or given < before[1]:
            self.waits_since = self.given_at = None
            return
        self.taken_at = now if taken > before[0] else self.taken_at
        self.is_acknowledged = in_flight is not None
        if in_flight is not None:
            if taken - in_flight >= self.mark or self.waits_since is None:
                self.mark, self.waits_since = taken, now if in_flight else None
        elif given > before[1]:
            waited_s = 0.0 if self.waits_since is None else now - self.waits_since
            self.longest_s, self.waits_since = max(self.longest_s, self.fled_s + waited_s), None
            self.fled_s = 0.0
        elif taken > before[0] and self.waits_since is None:
            self.waits_since = now
        if given > before[1]:
            self.answers, self.given_at = self.answers + given - before[1], now
            self.fled_s = max(self.fled_s - FORGIVEN_RATIO * (now - at), 0.0)
        if (taken, given) != before and self.overdue_s(now) is None:
            self.flowed_s += now - at

    def leave(self, now: float) -> None:
        """The task has another owner, or is about to."""
        self.fled_s = self.overdue_s(now) or self.fled_s
        self.waits_since = self.given_at = self.at = None

    def waited_s(self, now: float, limit_s: float) -> float | None:
        """For how long an input has waited while others came, if that is the limit at least."""
        if self.waits_since is None or now - self.waits_since < limit_s:
            return None
        return now - self.waits_since if now - self.taken_at <= max(limit_s, 2.0 * COUNT_S) else None

    def overdue_s(self, now: float) -> float | None:
        """For how long no answer has come that should have, while inputs flow; ``None``: not too long."""
        enough, times = (1, 2.0) if self.is_acknowledged else (ENOUGH, HUNG_TIMES)
        if self.waits_since is None or self.answers < enough or self.taken_at == self.waits_since:
            return None
        gap_s = (self.flowed_s - (now - self.waits_since)) / self.answers
        return self.waited_s(now, max(LEAST_S, HUNG_TIMES * gap_s, 2.0 * self.longest_s, times * self.fled_s))


class Progress:
    """One robot's view of all tasks: does the owner answer?"""

    def __init__(self, in_force: InForce) -> None:
        self._in_force = in_force
        self._known: dict[TaskId, tuple[int, dict[str, Rhythm]]] = in_force.by_task()
        """{task: (epoch, {stream, or empty: its rhythm})}."""

    def absorb(self, counts: tuple[StreamCount, ...], executors: Mapping[TaskId, Executor], now: float) -> None:
        """Take the relay's counters in; during a handover nobody owes anything."""
        for task, spec in self._in_force.tasks.items():
            executor = executors[task]
            epoch, known = self._known.get(task, (executor.epoch, dict[str, Rhythm]()))
            is_steady = executor.has_streams and executor.phase is Phase.SETTLED and not executor.is_local
            if not is_steady or epoch != executor.epoch:
                for rhythm in known.values():
                    rhythm.leave(now)
            self._known[task] = (executor.epoch, known)
            for name, taken, given, in_flight in _streams(spec, counts) if is_steady else ():
                known.setdefault(name, Rhythm()).count(taken, given, in_flight, now)

    def begin_again(self, task: TaskId, now: float | None = None) -> None:
        """What is open waits from ``now`` on; ``None``: another life of the worker owes nothing so far."""
        for rhythm in self._known.get(task, (0, {}))[1].values():
            rhythm.waits_since = None if rhythm.waits_since is None else now

    def overdue_s(self, task: TaskId, epoch: int, now: float) -> float | None:
        """For how long the owner of an epoch has answered nothing here that it should have; ``None``: not too long.

        Not of a task that says how soon it answers.
        """
        spec, (counted, known) = self._in_force.tasks.get(task), self._known.get(task, (epoch, {}))
        if spec is None or counted != epoch or spec.worker.output_deadline_s is not None:
            return None
        return max((waited_s for one in known.values() if (waited_s := one.overdue_s(now)) is not None), default=None)

    def reports(self, now: float) -> tuple[TaskProgress, ...]:
        """This robot's reports of the tasks that say how soon they answer: served, or waiting while inputs flow."""
        found = []
        for task, (epoch, known) in sorted(self._known.items()):
            deadline_s, rhythm = self._in_force.tasks[task].worker.output_deadline_s, known.get("")
            if deadline_s is None or rhythm is None:
                continue
            is_answered = rhythm.waits_since is None and rhythm.given_at is not None
            is_served = is_answered and now - (rhythm.given_at or 0.0) <= max(deadline_s, 2.0 * COUNT_S)
            if is_served or rhythm.waited_s(now, deadline_s) is not None:
                found.append(TaskProgress(task=task, epoch=epoch, is_served=is_served))
        return tuple(found)


def _streams(spec: TaskSpec, counts: tuple[StreamCount, ...]) -> Iterator[tuple[str, int, int, int | None]]:
    """(name, inputs, answers, inputs under way) of what tells something."""
    inputs = [count for count in counts if count.stream.startswith(f"{spec.name}/in/")]
    acknowledged = [(count, count.acknowledged) for count in inputs if count.acknowledged is not None]
    has_outputs = any(rule.direction is Direction.OUTPUT for rule in spec.rules)
    if spec.worker.output_deadline_s is None and acknowledged:
        for count, given in acknowledged:
            yield count.stream, count.messages, given, count.in_flight or 0
        return
    taken, outputs = sum(count.messages for count in inputs), (f"{spec.name}/out/",)
    if has_outputs:
        yield "", taken, sum(count.messages for count in counts if count.stream.startswith(outputs)), None
    elif len(acknowledged) == len(inputs):
        yield "", taken, sum(given for _, given in acknowledged), None
