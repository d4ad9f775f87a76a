"""EXECUTOR, beside the handover: whether an owner has ceased to answer one robot, by the task's own rhythm.

Knows: the counters of this robot's relay. Does not know: what a worker is, why it does not answer, who is better.

A worker may hang, and a way may carry beats and let nothing large through: either way inputs flow and answers end. The
library acknowledges each input, so there the oldest one under way tells; of any other program the outputs do. A task
that has not answered yet, or has no outputs, is never judged. To a robot an owner that has ceased to answer is one that
its streams do not reach (docs/decisions/0114).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Final

from zsched.core.absence import FORGIVEN_RATIO
from zsched.core.executor.handover import Executor, Phase
from zsched.core.values.fleet import TaskSpec
from zsched.core.values.model import TaskId
from zsched.core.values.plan import Direction, StreamCount
from zsched.core.values.struct import Struct

LEAST_S: Final = 3.0
"""However quickly a task answers, it may be silent for so long..."""
HUNG_TIMES: Final = 16.0
"""...and for so many times as long as its answers come apart on the mean."""


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
    waits_since: float | None = None
    """When an input that has no answer yet was seen; ``None``: none waits."""
    mark: int = 0
    """Of acknowledged inputs: once so many are done, that one has its answer."""
    longest_s: float = 0.0
    """The longest wait that an output of the same owner has ended: the task answers now and then."""
    fled_s: float = 0.0
    """How long an owner was waited for that was left then: if the next one does no better, the fault is elsewhere."""

    def count(self, taken: int, given: int, in_flight: int | None, now: float) -> None:
        """The relay has counted; ``in_flight``: inputs that are not acknowledged, where the worker does that."""
        before, at = (self.taken, self.given), self.at
        self.taken, self.given, self.at = taken, given, now
        if at is None or taken < before[0] or given < before[1]:
            self.waits_since = None
            return
        self.taken_at = now if taken > before[0] else self.taken_at
        if in_flight is not None:
            if taken - in_flight >= self.mark or self.waits_since is None:
                self.mark, self.waits_since = taken, now if in_flight else None
        elif given > before[1]:
            waited_s = 0.0 if self.waits_since is None else now - self.waits_since
            self.longest_s, self.waits_since = max(self.longest_s, waited_s), None
        elif taken > before[0] and self.waits_since is None:
            self.waits_since = now
        if given > before[1]:
            self.answers += given - before[1]
            self.fled_s = max(self.fled_s - FORGIVEN_RATIO * (now - at), 0.0)
        if (taken, given) != before and self.overdue_s(now) is None:
            self.flowed_s += now - at

    def begin_again(self) -> None:
        """What is open waits from now on."""
        self.waits_since = None

    def leave(self, now: float) -> None:
        """The task has another owner, or is about to."""
        self.fled_s = self.overdue_s(now) or self.fled_s
        self.waits_since = self.at = None

    def overdue_s(self, now: float) -> float | None:
        """For how long no answer has come that should have, while inputs flow; ``None``: not too long."""
        if self.waits_since is None or not self.answers:
            return None
        waited_s = now - self.waits_since
        gap_s = (self.flowed_s - waited_s) / self.answers
        limit_s = max(LEAST_S, HUNG_TIMES * gap_s, 2.0 * self.longest_s, 2.0 * self.fled_s)
        is_flowing = self.waits_since < self.taken_at > now - limit_s
        return waited_s if waited_s >= limit_s and is_flowing else None


class Rhythms:
    """This robot's, of all tasks but those that say themselves how soon they answer (`output_deadline_s`)."""

    def __init__(self) -> None:
        self._known: dict[TaskId, tuple[int, dict[str, Rhythm]]] = {}
        """{task: (epoch, {stream, or empty: its rhythm})}."""
        self._has_outputs: dict[TaskId, bool] = {}

    def adopt(self, specs: Iterable[TaskSpec]) -> None:
        """Watch these tasks from now on."""
        self._has_outputs = {
            spec.name: any(rule.direction is Direction.OUTPUT for rule in spec.rules)
            for spec in specs
            if spec.worker.output_deadline_s is None
        }
        self._known = {task: known for task, known in self._known.items() if task in self._has_outputs}

    def absorb(self, counts: tuple[StreamCount, ...], executors: Mapping[TaskId, Executor], now: float) -> None:
        """Take the relay's counters in."""
        for task in self._has_outputs:
            executor = executors[task]
            epoch, known = self._known.get(task, (executor.epoch, dict[str, Rhythm]()))
            is_steady = executor.has_streams and executor.phase is Phase.SETTLED and not executor.is_local
            if not is_steady or epoch != executor.epoch:
                for rhythm in known.values():
                    rhythm.leave(now)
            self._known[task] = (executor.epoch, known)
            for name, taken, given, in_flight in self._streams(task, counts) if is_steady else ():
                known.setdefault(name, Rhythm()).count(taken, given, in_flight, now)

    def _streams(self, task: TaskId, counts: tuple[StreamCount, ...]) -> Iterator[tuple[str, int, int, int | None]]:
        """(name, inputs, answers, inputs under way) of what tells something."""
        inputs = [count for count in counts if count.stream.startswith(f"{task}/in/")]
        acknowledged = [(count, count.acknowledged) for count in inputs if count.acknowledged is not None]
        for count, given in acknowledged:
            yield count.stream, count.messages, given, count.in_flight or 0
        if not acknowledged and self._has_outputs[task]:
            outputs = sum(count.messages for count in counts if count.stream.startswith(f"{task}/out/"))
            yield "", sum(count.messages for count in inputs), outputs, None

    def begin_again(self, task: TaskId | None = None) -> None:
        """All that is open waits from now on: the worker is another one, or (of all tasks) this machine stood still."""
        for name in self._known if task is None else (task,):
            for rhythm in self._known.get(name, (0, {}))[1].values():
                rhythm.begin_again()

    def overdue_s(self, task: TaskId, epoch: int, now: float) -> float | None:
        """For how long the owner of an epoch has answered nothing here that it should have; ``None``: not too long."""
        counted, known = self._known.get(task, (epoch, {}))
        waits_s = (one.overdue_s(now) for one in known.values() if counted == epoch)
        return max((waited_s for waited_s in waits_s if waited_s is not None), default=None)
